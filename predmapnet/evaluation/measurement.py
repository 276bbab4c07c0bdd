"""All measurements of one scene, and the figures over all scenes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from mapfusion.arrays import Integer
from mapfusion.elements import GlobalMap, RegionOfInterest
from predmapnet.errors import UserError
from predmapnet.evaluation.ahead_rear_ap import Half, half_matches
from predmapnet.evaluation.chamfer_ap import frame_matches, thresholds_for
from predmapnet.evaluation.class_order import kinds_found
from predmapnet.evaluation.consistency_ap import consistency_matches, matched_tracks, with_formed_tracks
from predmapnet.evaluation.forecast import ForecastErrors, forecast_errors, pool_forecasts
from predmapnet.evaluation.frames import EvaluationFrame
from predmapnet.evaluation.frechet_ap import FRECHET_THRESHOLDS, frechet_matches
from predmapnet.evaluation.global_map import GlobalMapQuality, global_map_quality, pool, seen_area
from predmapnet.evaluation.global_map_ap import global_map_matches
from predmapnet.evaluation.identity import IdentityCounts, count_identities, pool_identities
from predmapnet.evaluation.precision_recall import AveragePrecision, Matches, accumulate
from predmapnet.evaluation.raster_ap import (
    RasterAveragePrecision,
    RasterMatches,
    raster_from_matches,
    raster_matches,
)
from predmapnet.evaluation.stability import Stability, scene_instances, stability
from predmapnet.evaluation.stability_matching import SceneInstances
from predmapnet.evaluation.stability_protocol import Protocol
from predmapnet.evaluation.tracks import truth_track_ids


@dataclass(frozen=True)
class SceneMeasurement:
    """Measurements of one scene, element by element; figures come from pooling scenes.

    Attributes:
        frames: the frames that were measured, in order.
        thresholds: chamfer thresholds, metres.
        chamfer: matches, per frame.
        frechet: the same by the order-aware distance.
        ahead, rear: those of each half of the region.
        raster: matches by overlap, per frame.
        tracked, tracked_unanchored: matches of C-mAP with the ids that the predictions carry, and the same without
            asking for consistency.
        formed: those with ids formed from the predictions.
        identity: id switches and track lengths.
        forecast: errors of the forecasts.
        protocol, instances: of the stability.
        kinds: of predictions and of the truth on which they lie, see
            :func:`predmapnet.evaluation.class_order.kinds_found`.
        global_map, global_matches: None where there is no global map or no true one.
        mapping_seconds: wall time of mapping; None where results were read.
        absent_frames: frames that the results lack, measured as empty ones.
        weights_sha256: of the weights that made the maps; None where unknown.
        maps: the map of the drive and the true one; None where there is no true one.
    """

    frames: tuple[EvaluationFrame, ...]
    thresholds: tuple[float, ...]
    chamfer: list[Matches]
    frechet: list[Matches]
    ahead: list[Matches]
    rear: list[Matches]
    raster: list[tuple[RasterMatches, ...]]
    tracked: list[Matches]
    tracked_unanchored: list[Matches]
    formed: list[Matches]
    identity: IdentityCounts
    forecast: ForecastErrors
    protocol: Protocol
    instances: SceneInstances
    kinds: Integer
    global_map: GlobalMapQuality | None
    global_matches: Matches | None
    mapping_seconds: float | None = None
    absent_frames: int = 0
    weights_sha256: str | None = None
    maps: tuple[GlobalMap, GlobalMap] | None = None

    @property
    def name(self) -> str:
        """Name of the scene."""
        return self.frames[0].scene


@dataclass(frozen=True)
class Measurement:
    """All figures over all scenes."""

    scenes: tuple[str, ...]
    frames: tuple[EvaluationFrame, ...]
    chamfer: AveragePrecision
    frechet: AveragePrecision
    ahead: AveragePrecision
    rear: AveragePrecision
    raster: RasterAveragePrecision
    consistency: AveragePrecision
    consistency_unanchored: AveragePrecision
    formed_consistency: AveragePrecision
    identity: IdentityCounts
    forecast: ForecastErrors
    stability: Stability
    global_map: GlobalMapQuality | None
    global_map_ap: AveragePrecision | None
    place_map_ap: AveragePrecision | None
    frames_per_second: float | None
    absent_frames: int
    weights_sha256: str | None

    @property
    def has_tracks(self) -> bool:
        """Whether any prediction carries a track id."""
        return any((frame.predicted.track_ids >= 0).any() for frame in self.frames)

    @property
    def roi(self) -> RegionOfInterest:
        """The region in which everything was measured."""
        return self.frames[0].predicted.roi

    def missing(self) -> list[str]:
        """Return what the figures lack, as sentences for the reader."""
        found = []
        if self.absent_frames:
            found.append(f"{self.absent_frames} of {len(self.frames)} frames are not in the results and count as empty")
        absent = [kind.kind.nouns for kind in self.chamfer.kinds if not kind.truths]
        if absent:
            found.append(
                f"no ground truth of {', '.join(absent)}: counts as 0 in every mean over the kinds but raster's"
            )
        if not self.has_tracks:
            found.append(
                "no track ids: consistency AP is of ids formed afterwards, and elements of a score of at least 0.4 are "
                "fused into the map of the drive by where they lie"
            )
        if self.global_map is None:
            found.append("no true map of some scenes, so no figures of the map of the drive")
        if not len(self.forecast.errors[0]):
            found.append("no forecasts")
        return found

    def figures(self) -> dict[str, Any]:
        """Nested figures as written to JSON: ``chamfer_ap.mAP``, ``global_map.f1@1.0`` and so on.

        ``consistency_ap`` uses the ids that the predictions carry, or formed ones where they carry none; its
        ``ids`` says which.
        """
        formed = self.formed_consistency.figures()
        if self.has_tracks:
            consistency = self.consistency.figures() | {"ids": "tracker"}
            consistency["mAP_without_consistency"] = self.consistency_unanchored.mean
        else:
            consistency = formed | {"ids": "formed"}
        return {
            "scenes": len(self.scenes),
            "frames": len(self.frames),
            "frames_per_second": self.frames_per_second,
            "chamfer_ap": self.chamfer.figures(),
            "ahead_ap": self.ahead.figures(),
            "rear_ap": self.rear.figures(),
            "frechet_ap": self.frechet.figures(),
            "consistency_ap": consistency,
            "consistency_ap_formed_ids": formed,
            "raster_ap": self.raster.figures(),
            "stability": self.stability.figures(),
            "global_map": None if self.global_map is None else self.global_map.figures(),
            "global_map_ap": None if self.global_map_ap is None else self.global_map_ap.figures(),
            "place_map_ap": None if self.place_map_ap is None else _of_places(self.place_map_ap),
            "forecast": self.forecast.figures(),
            "tracks": self.identity.figures(),
        }


def measure_scene(
    frames: Sequence[EvaluationFrame],
    global_map: GlobalMap | None = None,
    truth_map: GlobalMap | None = None,
    mapping_seconds: float | None = None,
    protocol: Protocol = Protocol.ANCHORED,
) -> SceneMeasurement:
    """Measure one scene: all of its frames (at least one) in order, and its maps in one frame where both exist."""
    if not frames:
        raise UserError("There is no frame to measure.")
    roi = frames[0].predicted.roi
    thresholds = thresholds_for(roi)
    truth_ids = truth_track_ids(frames)
    matched = matched_tracks(frames, truth_ids, thresholds)
    formed_frames = with_formed_tracks(frames)
    quality = global_matches = None
    if global_map is not None and truth_map is not None:
        seen = seen_area([frame.predicted.ego_to_global for frame in frames], roi)
        quality = global_map_quality(global_map, truth_map, seen)
        global_matches = global_map_matches(global_map, truth_map, seen, thresholds)
    return SceneMeasurement(
        frames=tuple(frames),
        thresholds=thresholds,
        chamfer=[frame_matches(frame, thresholds) for frame in frames],
        frechet=[frechet_matches(frame) for frame in frames],
        ahead=[half_matches(frame, Half.AHEAD, thresholds) for frame in frames],
        rear=[half_matches(frame, Half.REAR, thresholds) for frame in frames],
        raster=[raster_matches(frame) for frame in frames],
        tracked=consistency_matches(frames, matched),
        tracked_unanchored=consistency_matches(frames, matched, anchored=False),
        formed=consistency_matches(formed_frames, matched_tracks(formed_frames, truth_ids, thresholds)),
        identity=count_identities(frames, truth_ids, [found[:, -1] for found in matched]),
        forecast=forecast_errors(frames),
        protocol=protocol,
        instances=scene_instances(frames, _element_ids(frames, truth_ids), protocol),
        kinds=kinds_found(frames),
        global_map=quality,
        global_matches=global_matches,
        mapping_seconds=mapping_seconds,
    )


def pool_scenes(scenes: Sequence[SceneMeasurement], places: Sequence[Matches] | None = None) -> Measurement:
    """Pool scenes (at least one); their order breaks ties of scores.

    ``places`` are the matches of one global map per location, see :func:`predmapnet.runs.place_maps.place_matches`.
    Raises UserError where they were mapped with different regions of interest or weights.
    """
    if not scenes:
        raise UserError("There is no scene to measure.")
    regions = {frame.predicted.roi for scene in scenes for frame in scene.frames}
    if len(regions) > 1:
        sizes = " and ".join(sorted(f"{roi.length:g} m x {roi.width:g} m" for roi in regions))
        raise UserError(f"The scenes have regions of interest of different sizes ({sizes}); measure them apart.")
    if len({scene.weights_sha256 for scene in scenes}) > 1:
        raise UserError("The scenes were mapped with different weights; measure each method apart.")
    thresholds = scenes[0].thresholds
    frames = [frame for scene in scenes for frame in scene.frames]
    maps = [scene.global_map for scene in scenes if scene.global_map is not None]
    global_matches = [scene.global_matches for scene in scenes if scene.global_matches is not None]
    seconds = [scene.mapping_seconds for scene in scenes if scene.mapping_seconds is not None]

    def pooled(name: str, at: Sequence[float] = thresholds) -> AveragePrecision:
        matches: list[Matches] = [match for scene in scenes for match in getattr(scene, name)]
        return accumulate(matches, at)

    return Measurement(
        scenes=tuple(scene.name for scene in scenes),
        frames=tuple(frames),
        chamfer=pooled("chamfer"),
        frechet=pooled("frechet", FRECHET_THRESHOLDS),
        ahead=pooled("ahead"),
        rear=pooled("rear"),
        raster=raster_from_matches([match for scene in scenes for match in scene.raster]),
        consistency=pooled("tracked"),
        consistency_unanchored=pooled("tracked_unanchored"),
        formed_consistency=pooled("formed"),
        identity=pool_identities([scene.identity for scene in scenes]),
        forecast=pool_forecasts([scene.forecast for scene in scenes]),
        stability=stability([(scene.frames, scene.instances) for scene in scenes], scenes[0].protocol),
        global_map=pool(maps) if len(maps) == len(scenes) else None,
        global_map_ap=accumulate(global_matches, thresholds) if len(global_matches) == len(scenes) else None,
        place_map_ap=None if places is None else accumulate(places, thresholds),
        frames_per_second=len(frames) / sum(seconds) if len(seconds) == len(scenes) else None,
        absent_frames=sum(scene.absent_frames for scene in scenes),
        weights_sha256=scenes[0].weights_sha256,
    )


def _of_places(result: AveragePrecision) -> dict[str, Any]:
    return {"places": len(result.flags), **result.figures()}


def _element_ids(frames: Sequence[EvaluationFrame], track_ids: Sequence[Integer]) -> list[Integer]:
    """Return which elements of the source's map the truths are; their track ids where the source cannot tell."""
    known = all((frame.truth.element_ids >= 0).all() for frame in frames)
    return [frame.truth.element_ids for frame in frames] if known else list(track_ids)
