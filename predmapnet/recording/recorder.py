"""Recorder of a run: cameras, tracks, forecasts and the growing map, frame by frame, in Rerun.

Entities carry the names that nuScenes' users know: ``world/ego_vehicle/CAM_FRONT`` and so on. The recording is flat,
as the map is: heights of the car are left out, its roll and pitch too. It begins at the first position of the car,
so that coordinates stay small enough for the 32-bit floats of a viewer. Timelines: ``frame`` and ``timestamp``.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Protocol

import numpy as np
import rerun as rr

from mapfusion.arrays import Float
from mapfusion.colours import KIND_COLOURS, TRUTH_COLOUR, lighter
from mapfusion.elements import ElementKind, FrameMap, GlobalMap, RegionOfInterest
from mapfusion.formats.identities import all_named
from mapfusion.georeference import Georeference
from predmapnet.mapping import MapSnapshot, Step
from predmapnet.recording.bev_panels import BEV_SHAPE, BevPanels
from predmapnet.recording.blueprint import GROWING_MAP, TRUTH, WHOLE_MAP, Content, Extent, scene_blueprint
from predmapnet.recording.car import CAR_COLOUR, log_car
from predmapnet.recording.map_lines import WORLD_COORDINATES, lifted, log_on_earth, map_lines
from predmapnet.recording.pictures import Pictures
from predmapnet.recording.projection import dashes, project_line
from predmapnet.recording.tracks import TrackAges, Tracks, forecast_errors_by_kind
from predmapnet.scenes import Frame, Instant, Rig

APPLICATION = "predmapnet"
MAP_EVERY_FRAMES = 4
STAGES = {
    "images": ("waiting for images", (120, 170, 255)),
    "network": ("network", (255, 140, 120)),
    "integration": ("integration", (160, 230, 160)),
}
"""Stages of a frame: name and colour of each."""


class Drive(Protocol):
    """Drive as far as a recording needs it: a :class:`predmapnet.scenes.Scene`, or results without images."""

    @property
    def rig(self) -> Rig:
        """The car's cameras; none for results without images."""

    def __len__(self) -> int: ...

    def instant(self, index: int) -> Instant:
        """Return time stamp and pose of frame ``index``."""

    def truth_map(self, roi: RegionOfInterest) -> GlobalMap | None:
        """Return the true map of what came into the region, global frame, or None."""


class SceneRecorder:
    """Observer of :func:`predmapnet.mapping.map_scene` that logs to Rerun.

    Args:
        recording: the stream to log into.
        description: of the run, Markdown, shown beside the views.
        live: whether someone watches while the scene is mapped; the viewer then follows the newest frame.
        place: of the global frame on Earth, for a geographic view; None where it is not known or made up.
        track: id of the track whose memory is shown; None picks a confident one.
    """

    def __init__(
        self,
        recording: rr.RecordingStream,
        description: str,
        live: bool = False,
        place: Georeference | None = None,
        track: int | None = None,
    ) -> None:
        self._recording = recording
        self._description = description
        self._live = live
        self._place = place
        self._panels = BevPanels(recording, track)
        self._ages = TrackAges()
        self._logged: dict[str, bytes] = {}
        self._before: FrameMap | None = None

    def begin(self, scene: Drive, roi: RegionOfInterest) -> None:
        """Log what does not change: layout, cameras, the car, its way, the ground truth."""
        rec = self._recording
        way = np.array([scene.instant(index).ego_to_global[:2, 3] for index in range(len(scene))])
        self._origin = way[0]
        self._pictures = Pictures(scene.rig)
        truth = scene.truth_map(roi)
        extent = Extent.of(way - self._origin, float(roi.width))
        self._content = Content(extent, truth is not None, self._place is not None)
        rec.send_blueprint(scene_blueprint(scene.rig, BEV_SHAPE, self._content, self._live))
        self.describe(self._description)
        rec.log("world", WORLD_COORDINATES, static=True)
        log_car(rec, self._pictures.rig, roi)
        self._panels.begin(roi)
        thin, colour = rr.Radius.ui_points(0.8), (*CAR_COLOUR, 90)
        rec.log("world/way", rr.LineStrips3D([lifted(way - self._origin, 0.0)], colors=colour, radii=thin), static=True)
        if self._place is not None:
            on_earth = [self._place.to_wgs84(way)[:, ::-1]]
            rec.log("earth/way", rr.GeoLineStrings(lat_lon=on_earth, colors=CAR_COLOUR, radii=thin), static=True)
        if truth is not None:
            strips = [lifted(element.points - self._origin, -0.04) for element in truth]
            rec.log(TRUTH, rr.LineStrips3D(strips, colors=TRUTH_COLOUR, radii=rr.Radius.ui_points(1.0)), static=True)
        self._style_plots()

    def describe(self, text: str) -> None:
        """Log the description of the run, Markdown; a later one replaces it."""
        self._recording.log("description", rr.TextDocument(text, media_type="text/markdown"), static=True)

    def observe(self, step: Step, snapshot: MapSnapshot) -> None:
        """Log one frame."""
        rec, tracks, before = self._recording, self._ages.tracks_of(step.frame_map), self._before
        if before is None:
            self._fit_layout(step)
        rec.set_time("frame", sequence=step.frame.index)
        rec.set_time("timestamp", timestamp=np.datetime64(step.frame.timestamp, "ns"))
        self._log_pose(step.frame.ego_to_global)
        self._log_cameras(step.frame, tracks)
        self._log_tracks(tracks, before)
        self._panels.log(step.frame_map.segmentation, tracks, before)
        self._log_plots(tracks.frame_map, before, step.milliseconds)
        if step.frame.index % MAP_EVERY_FRAMES == 0:
            self._log_growth(snapshot())
        self._before = tracks.frame_map

    def end(self, global_map: GlobalMap) -> None:
        """Log the finished map: at the last frame, and as a whole for all of them."""
        named = GlobalMap(tuple(all_named(global_map)))
        self._log_growth(named)
        for kind in ElementKind:
            lines = map_lines(named.of_kind(kind), self._origin, width=1.4, height=-0.02)
            self._recording.log(f"{WHOLE_MAP}/{kind.label}", lines, static=True)
        if self._place is not None:
            log_on_earth(self._recording, "earth/map", named, self._place)

    def _style_plots(self) -> None:
        for kind in ElementKind:
            for plot in ("elements", "forecast_error"):
                style = rr.SeriesLines(colors=KIND_COLOURS[kind], names=kind.nouns, widths=2.0)
                self._recording.log(f"plots/{plot}/{kind.label}", style, static=True)
        for stage, (name, colour) in STAGES.items():
            self._recording.log(f"plots/milliseconds/{stage}", rr.SeriesLines(colors=colour, names=name), static=True)

    def _fit_layout(self, step: Step) -> None:
        """Leave out the panels of what this network does not make."""
        forecasts, memory = step.frame_map.forecasts is not None, step.frame_map.history_masks is not None
        if not (forecasts and memory):
            content = replace(self._content, forecasts=forecasts, memory=memory)
            self._recording.send_blueprint(scene_blueprint(step.frame.rig, BEV_SHAPE, content, self._live))

    def _log_pose(self, ego_to_global: Float) -> None:
        yaw = rr.Angle(rad=float(np.arctan2(ego_to_global[1, 0], ego_to_global[0, 0])))
        position = [*(ego_to_global[:2, 3] - self._origin), 0.0]
        turn = rr.RotationAxisAngle((0, 0, 1), yaw)
        self._recording.log("world/ego_vehicle", rr.Transform3D(translation=position, rotation_axis_angle=turn))
        if self._place is not None:
            here = self._place.to_wgs84(ego_to_global[None, :2, 3])[:, ::-1]
            point = rr.GeoPoints(lat_lon=here, colors=CAR_COLOUR, radii=rr.Radius.ui_points(6.0))
            self._recording.log("earth/car", point)

    def _log_cameras(self, frame: Frame, tracks: Tracks) -> None:
        for camera in self._pictures.rig:
            entity = f"world/ego_vehicle/{camera.name}"
            image = frame.images.get(camera.name)
            if image is None:
                self._recording.log(entity, rr.Clear(recursive=True))
                continue
            self._recording.log(entity, self._pictures.encoded(camera.name, image))
            strips, colours, labels = [], [], []
            found = tracks.frame_map
            for kind, points, label in zip(found.kinds, found.polylines, tracks.labels, strict=True):
                parts = project_line(points, camera)
                strips.extend(parts)
                colours.extend([KIND_COLOURS[kind]] * len(parts))
                labels.extend([label] * len(parts))
            lines = rr.LineStrips2D(
                strips,
                colors=colours,
                radii=rr.Radius.ui_points(1.6),
                labels=labels,
                show_labels=False,
                draw_order=50.0,
            )
            self._recording.log(f"{entity}/tracks", lines)

    def _log_tracks(self, tracks: Tracks, before: FrameMap | None) -> None:
        for kind in ElementKind:
            now = tracks.select(tracks.frame_map.kinds == kind)
            lines = rr.LineStrips3D(
                [lifted(points, 0.06) for points in now.frame_map.polylines],
                colors=KIND_COLOURS[kind],
                radii=rr.Radius.ui_points(2.2),
                labels=now.labels,
                show_labels=False,
            )
            self._recording.log(f"world/ego_vehicle/tracks/{kind.label}", lines)
            # What was forecast one frame ago for this instant is given in this instant's ego frame.
            forecasts = (before.select(before.kinds == kind).forecasts or ()) if before is not None else ()
            strips = [lifted(dash, 0.12) for points in forecasts if len(points) > 1 for dash in dashes(points)]
            expected = rr.LineStrips3D(strips, colors=lighter(KIND_COLOURS[kind]), radii=rr.Radius.ui_points(1.1))
            self._recording.log(f"world/ego_vehicle/forecast_for_this_frame/{kind.label}", expected)

    def _log_plots(self, now: FrameMap, before: FrameMap | None, milliseconds: Mapping[str, float]) -> None:
        for kind in ElementKind:
            self._recording.log(f"plots/elements/{kind.label}", rr.Scalars(int((now.kinds == kind).sum())))
        for kind, metres in ({} if before is None else forecast_errors_by_kind(before, now)).items():
            self._recording.log(f"plots/forecast_error/{kind.label}", rr.Scalars(metres))
        for stage in STAGES.keys() & milliseconds.keys():
            self._recording.log(f"plots/milliseconds/{stage}", rr.Scalars(milliseconds[stage]))

    def _log_growth(self, global_map: GlobalMap) -> None:
        """Log the elements that changed since the last time, and clear those that are gone."""
        current: dict[str, bytes] = {}
        for element in all_named(global_map):
            entity = f"{GROWING_MAP}/{element.kind.label}/{element.name}"
            current[entity] = content = element.points.tobytes()
            if self._logged.get(entity) != content:
                lines = map_lines([element], self._origin, width=1.8, shade=0.4)
                self._recording.log(entity, lines)
        for entity in self._logged.keys() - current.keys():
            self._recording.log(entity, rr.Clear(recursive=False))
        self._logged = current
