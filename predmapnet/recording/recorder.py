"""Recorder of a run: cameras, tracks, forecasts and the growing map, frame by frame, in Rerun.

Entities carry the names that nuScenes' users know: ``world/ego_vehicle/CAM_FRONT`` and so on. The recording is flat,
as the map is: heights of the car are left out, its roll and pitch too. It begins at the first position of the car,
so that coordinates stay small enough for the 32-bit floats of a viewer. Timelines: ``frame`` and ``timestamp``.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from mapfusion.arrays import Float
from mapfusion.colours import KIND_COLOURS, TRUTH_COLOUR, darker, lighter
from mapfusion.elements import ElementKind, FrameMap, GlobalMap, MapElement, RegionOfInterest
from predmapnet.datasets.images import read_camera_image
from predmapnet.mapping import MapSnapshot, Step
from predmapnet.recording.blueprint import WORLD_COORDINATES, scene_blueprint
from predmapnet.recording.palette import raster_picture
from predmapnet.recording.projection import bev_pixels, dashes, project_line
from predmapnet.scenes import Camera, Scene

APPLICATION = "predmapnet"
BEV_SHAPE = (200, 400)
"""Rows and columns in which lines of the BEV panel are given; rasters of any size are stretched to it."""
MAP_EVERY_FRAMES = 4
CAR_SIZE_METRES = (4.6, 1.9, 1.6)
STAGES = {"images": "waiting for images", "network": "network", "integration": "integration"}


class SceneRecorder:
    """Observer of :func:`predmapnet.mapping.map_scene` that logs to Rerun.

    Args:
        recording: the stream to log into.
        description: of the run, Markdown, shown beside the views.
        live: whether someone watches while the scene is mapped; the viewer then follows the newest frame.
    """

    def __init__(self, recording: rr.RecordingStream, description: str, live: bool = False) -> None:
        self._recording = recording
        self._description = description
        self._live = live
        self._logged: dict[str, bytes] = {}
        self._forecast: FrameMap | None = None
        self._origin = np.zeros(2)

    def begin(self, scene: Scene, roi: RegionOfInterest) -> None:
        """Log what does not change: layout, cameras, the car, the ground truth."""
        rec = self._recording
        rec.send_blueprint(scene_blueprint(scene.rig, BEV_SHAPE, play=self._live))
        self.describe(self._description)
        rec.log("world", WORLD_COORDINATES, static=True)
        for camera in scene.rig:
            self._log_camera(camera)
        self._log_car(roi)
        for kind in ElementKind:
            colour = KIND_COLOURS[kind]
            style = rr.SeriesLines(colors=colour, names=kind.label, widths=2.0)
            rec.log(f"plots/elements/{kind.label}", style, static=True)
        for stage, colour in zip(STAGES, ((120, 170, 255), (255, 140, 120), (160, 230, 160)), strict=True):
            rec.log(f"plots/milliseconds/{stage}", rr.SeriesLines(colors=colour, names=STAGES[stage]), static=True)
        self._origin = np.asarray(scene.frame(0).ego_to_global[:2, 3])
        truth = scene.truth_map()
        if truth is not None:
            strips = [self._in_world(element.points, height=-0.04) for element in truth]
            lines = rr.LineStrips3D(strips, colors=TRUTH_COLOUR, radii=rr.Radius.ui_points(0.6))
            rec.log("world/ground_truth", lines, static=True)

    def describe(self, text: str) -> None:
        """Log the description of the run, Markdown; a later one replaces it."""
        self._recording.log("description", rr.TextDocument(text, media_type="text/markdown"), static=True)

    def observe(self, step: Step, snapshot: MapSnapshot) -> None:
        """Log one frame."""
        rec, frame_map = self._recording, step.frame_map.tracked
        rec.set_time("frame", sequence=step.frame.index)
        rec.set_time("timestamp", timestamp=np.datetime64(step.frame.timestamp, "ns"))
        rec.log("world/ego_vehicle", self._ego_transform(step.frame.ego_to_global))
        self._log_cameras(step, frame_map)
        self._log_tracks(frame_map)
        self._log_bev(step.frame_map, frame_map)
        self._log_plots(frame_map, step.milliseconds)
        if step.frame.index % MAP_EVERY_FRAMES == 0:
            self._log_map(snapshot())

    def end(self, global_map: GlobalMap) -> None:
        """Log the finished map at the last frame."""
        self._log_map(global_map)

    def _log_camera(self, camera: Camera) -> None:
        entity = f"world/ego_vehicle/{camera.name}"
        pose = rr.Transform3D(translation=camera.camera_to_ego[:3, 3], mat3x3=camera.camera_to_ego[:3, :3])
        lens = rr.Pinhole(
            image_from_camera=camera.intrinsics,
            resolution=(camera.width, camera.height),
            camera_xyz=rr.ViewCoordinates.RDF,
            image_plane_distance=2.2,
            color=(110, 115, 125),
            line_width=0.02,
        )
        self._recording.log(entity, pose, lens, static=True)

    def _log_car(self, roi: RegionOfInterest) -> None:
        length, width, height = CAR_SIZE_METRES
        # The ego origin lies over the rear axle (Argoverse 2) or under the lidar, ahead of it (nuScenes).
        box = rr.Boxes3D(
            centers=[[0.2 * length, 0.0, height / 2]],
            sizes=[CAR_SIZE_METRES],
            colors=(235, 235, 240),
            fill_mode="solid",
        )
        corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1], [-1, -1]]) * roi.size / 2
        border = rr.LineStrips3D([_lift(corners, 0.0)], colors=(70, 74, 84), radii=rr.Radius.ui_points(0.6))
        outline = np.array([[-0.3, -0.5], [0.7, -0.5], [0.7, 0.5], [-0.3, 0.5], [-0.3, -0.5]]) * [length, width]
        self._recording.log("world/ego_vehicle/car", box, static=True)
        self._recording.log("world/ego_vehicle/region_of_interest", border, static=True)
        for name, ring, colour in (
            ("outline", outline, (235, 235, 240)),
            ("region_of_interest", corners, (70, 74, 84)),
        ):
            lines = rr.LineStrips2D([bev_pixels(ring, roi, BEV_SHAPE)], colors=colour, draw_order=60.0)
            self._recording.log(f"bev/car/{name}", lines, static=True)

    def _log_cameras(self, step: Step, frame_map: FrameMap) -> None:
        for camera in step.frame.rig:
            entity = f"world/ego_vehicle/{camera.name}"
            path = step.frame.images.get(camera.name)
            if path is None:
                self._recording.log(entity, rr.Clear(recursive=True))
                continue
            # The file goes in as it is: no loss, no time, and the size that it has on disk.
            distorted = camera.lens is not None
            picture = _compressed(read_camera_image(path, camera)) if distorted else rr.EncodedImage(path=path)
            self._recording.log(entity, picture)
            strips, colours = [], []
            for kind, points in zip(frame_map.kinds, frame_map.polylines, strict=True):
                parts = project_line(points, camera)
                strips.extend(parts)
                colours.extend([KIND_COLOURS[kind]] * len(parts))
            lines = rr.LineStrips2D(strips, colors=colours, radii=rr.Radius.ui_points(1.6), draw_order=50.0)
            self._recording.log(f"{entity}/tracks", lines)

    def _log_tracks(self, frame_map: FrameMap) -> None:
        forecast, self._forecast = self._forecast, frame_map
        for kind in ElementKind:
            now = frame_map.select(frame_map.kinds == kind)
            lines = rr.LineStrips3D(
                [_lift(points, 0.06) for points in now.polylines],
                colors=KIND_COLOURS[kind],
                radii=rr.Radius.ui_points(2.2),
                labels=[
                    f"{kind.label} {track}  {score:.2f}" for track, score in zip(now.track_ids, now.scores, strict=True)
                ],
                show_labels=False,
            )
            self._recording.log(f"world/ego_vehicle/tracks/{kind.label}", lines)
            # What was forecast one frame ago for this instant is given in this instant's ego frame.
            expected = rr.LineStrips3D(
                [_lift(dash, 0.12) for points in _forecasts(forecast, kind) for dash in dashes(points)],
                colors=lighter(KIND_COLOURS[kind]),
                radii=rr.Radius.ui_points(1.1),
            )
            self._recording.log(f"world/ego_vehicle/forecast_for_this_frame/{kind.label}", expected)

    def _log_bev(self, all_elements: FrameMap, tracked: FrameMap) -> None:
        if all_elements.segmentation is not None:
            picture = raster_picture(all_elements.segmentation, np.arange(3))
            self._recording.log("bev/segmentation", _stretched(picture))
        if tracked.history_masks is not None and tracked.history_masks.ndim == 3:
            self._recording.log("bev/history", _stretched(raster_picture(tracked.history_masks, tracked.kinds)))
        lines = rr.LineStrips2D(
            [bev_pixels(points, tracked.roi, BEV_SHAPE) for points in tracked.polylines],
            colors=[lighter(KIND_COLOURS[kind], 0.3) for kind in tracked.kinds],
            radii=rr.Radius.ui_points(0.8),
            draw_order=50.0,
        )
        self._recording.log("bev/tracks", lines)

    def _log_plots(self, frame_map: FrameMap, milliseconds: Mapping[str, float]) -> None:
        for kind in ElementKind:
            count = int((frame_map.kinds == kind).sum())
            self._recording.log(f"plots/elements/{kind.label}", rr.Scalars(count))
        for stage in STAGES:
            self._recording.log(f"plots/milliseconds/{stage}", rr.Scalars(milliseconds[stage]))

    def _log_map(self, global_map: GlobalMap) -> None:
        """Log the elements that changed since the last time, and clear those that are gone."""
        current: dict[str, bytes] = {}
        for entity, element in _named_elements(global_map):
            current[entity] = content = element.points.tobytes()
            if self._logged.get(entity) == content:
                continue
            lines = rr.LineStrips3D(
                [self._in_world(element.points, 0.0)],
                colors=darker(KIND_COLOURS[element.kind]),
                radii=rr.Radius.ui_points(1.8),
                labels=[
                    f"{element.kind.label}  confidence {element.confidence:.2f}, {element.observations} observations"
                ],
                show_labels=False,
            )
            self._recording.log(entity, lines)
        for entity in self._logged.keys() - current.keys():
            self._recording.log(entity, rr.Clear(recursive=False))
        self._logged = current

    def _ego_transform(self, ego_to_global: Float) -> rr.Transform3D:
        yaw = float(np.arctan2(ego_to_global[1, 0], ego_to_global[0, 0]))
        position = [*(ego_to_global[:2, 3] - self._origin), 0.0]
        return rr.Transform3D(
            translation=position, rotation_axis_angle=rr.RotationAxisAngle((0, 0, 1), rr.Angle(rad=yaw))
        )

    def _in_world(self, points: Float, height: float) -> Float:
        return _lift(points - self._origin, height)


def _named_elements(global_map: GlobalMap) -> Iterator[tuple[str, MapElement]]:
    """Name each element by its first track, which stays the same while the element grows."""
    seen: Counter[str] = Counter()
    for element in global_map:
        first = min(element.track_ids, default=0)
        base = f"world/map/{element.kind.label}/{first}"
        seen[base] += 1
        yield (base if seen[base] == 1 else f"{base}_{seen[base]}"), element


def _forecasts(frame_map: FrameMap | None, kind: ElementKind) -> list[Float]:
    if frame_map is None or frame_map.forecasts is None:
        return []
    return [points for points in frame_map.select(frame_map.kinds == kind).forecasts or () if len(points) > 1]


def _lift(points: Float, height: float) -> Float:
    return np.column_stack([points, np.full(len(points), height)])


def _stretched(picture: NDArray[np.uint8]) -> rr.Image | rr.EncodedImage:
    """Enlarge a raster to the size of the BEV panel by whole steps, so that lines and pixels agree."""
    rows = np.arange(BEV_SHAPE[0]) * picture.shape[0] // BEV_SHAPE[0]
    columns = np.arange(BEV_SHAPE[1]) * picture.shape[1] // BEV_SHAPE[1]
    return _compressed(picture[rows][:, columns])


def _compressed(picture: NDArray[np.uint8]) -> rr.Image | rr.EncodedImage:
    return rr.Image(picture).compress(jpeg_quality=90)
