"""Figures of one drive over a real road, and their table."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass

import numpy as np
import shapely

from mapfusion.arrays import Float
from mapfusion.elements import ElementKind, FrameMap, GlobalMap
from predmapnet.evaluation.chamfer_ap import chamfer_average_precision, thresholds_for
from predmapnet.evaluation.chamfer_distance import (
    POINTS_PER_LINE,
    chamfer_matrix,
    match_greedily,
    resample_all,
)
from predmapnet.evaluation.frames import EvaluationFrame, simplify_all
from predmapnet.evaluation.global_map import THRESHOLDS, global_map_quality, seen_area
from predmapnet.mapping import SceneRun
from predmapnet.scenes import Scene
from tests.mapfusion.calibration import share_inside, standard_errors
from tests.mapfusion.demo_towns import MappedTown

FOUND_WITHIN = 1.0
"""Chamfer distance at which a crossing counts as found, metres."""
BELIEVED = 0.3
"""Score from which a prediction counts for the recall of crossings: that at which a track is kept."""


@dataclass(frozen=True)
class Figures:
    """Figures of one drive; None where a figure does not exist (nothing true, or nothing found).

    Attributes:
        mean_ap: chamfer mAP over three kinds.
        crossing, divider, boundary: AP of each kind, mean over 0.5, 1.0 and 1.5 m.
        crossing_at_half: AP of crossings at 0.5 m.
        lines: mean AP of dividers and boundaries.
        along, across: recall at 1.0 m of crossings whose people walk along the car's heading (over the mouth of a side
            street), and of those over the car's own road.
        precision, recall: of the global map at 1.0 m, length-weighted.
        band: share of true points of mapped lines that the 95 % band of ``deviation`` holds.
        map_crossings, true_crossings: crossings in the global map and in the true one.
        per_frame: elements of each kind per frame that are believed.
        frames: how many were mapped.
        seconds: of mapping.
    """

    mean_ap: float | None
    crossing: float | None
    divider: float | None
    boundary: float | None
    crossing_at_half: float | None
    lines: float | None
    along: float | None
    across: float | None
    precision: float | None
    recall: float | None
    band: float | None
    map_crossings: int
    true_crossings: int | None
    per_frame: Mapping[str, float]
    frames: int
    seconds: float


def measure(scene: Scene, run: SceneRun) -> Figures:
    """Measure one mapped drive against the truth of its scene, if there is one."""
    roi = run.frame_maps[0].roi
    map_crossings = len(run.global_map.of_kind(ElementKind.PED_CROSSING))
    believed = {
        kind.label: float(np.mean([(found.kinds[found.scores >= BELIEVED] == kind).sum() for found in run.frame_maps]))
        for kind in ElementKind
    }
    truths, truth_map = scene.truths(roi), scene.truth_map()
    if truths is None or truth_map is None:
        nothing = dict.fromkeys(list(Figures.__annotations__)[:11])
        return Figures(**nothing, map_crossings=map_crossings, true_crossings=None, per_frame=believed,
                       frames=len(run.frames), seconds=run.seconds)  # fmt: skip
    frames = [
        EvaluationFrame(frame.scene, frame.index, found, truth)
        for frame, found, truth in zip(run.frames, run.frame_maps, truths, strict=True)
    ]
    result = chamfer_average_precision(frames, thresholds_for(roi))
    ap = [kind.average_precision if kind.truths else None for kind in result.kinds]
    along, across = crossing_recall(frames)
    seen = seen_area([frame.ego_to_global for frame in run.frames], roi)
    quality = global_map_quality(run.global_map, truth_map, seen).overall
    metre = THRESHOLDS.index(1.0)
    return Figures(
        mean_ap=result.mean if all(value is not None for value in ap) else None,
        crossing=ap[ElementKind.PED_CROSSING],
        divider=ap[ElementKind.DIVIDER],
        boundary=ap[ElementKind.BOUNDARY],
        crossing_at_half=result.kinds[ElementKind.PED_CROSSING].curves[0].average_precision
        if result.kinds[ElementKind.PED_CROSSING].truths
        else None,
        lines=mean(value for value in ap[1:]),
        along=along,
        across=across,
        precision=_exists(quality.precision[metre]),
        recall=_exists(quality.recall[metre]),
        band=band_share(run.global_map, run.frame_maps, truth_map),
        map_crossings=map_crossings,
        true_crossings=len(truth_map.of_kind(ElementKind.PED_CROSSING)),
        per_frame=believed,
        frames=len(frames),
        seconds=run.seconds,
    )


def crossing_recall(frames: Sequence[EvaluationFrame]) -> tuple[float | None, float | None]:
    """Return the recall at 1.0 m of crossings along the car's heading, and across it; None where there is none.

    A crossing lies along where its longer side, on which people walk, is turned by less than 45 degrees from the
    car's heading.
    """
    found = [0, 0]
    asked = [0, 0]
    for frame in frames:
        truths = [
            line
            for line, kind in zip(simplify_all(frame.truth.polylines), frame.truth.kinds, strict=True)
            if kind == ElementKind.PED_CROSSING
        ]
        rows = (frame.predicted.kinds == ElementKind.PED_CROSSING) & (frame.predicted.scores >= BELIEVED)
        predicted = frame.predicted.select(rows)
        matrix = chamfer_matrix(
            resample_all(predicted.polylines, POINTS_PER_LINE), predicted.kinds,
            resample_all(truths, POINTS_PER_LINE), np.zeros(len(truths), dtype=np.int64), limit=FOUND_WITHIN,
        )  # fmt: skip
        matched = set(match_greedily(matrix, predicted.scores, (FOUND_WITHIN,))[:, 0].tolist())
        for row, ring in enumerate(truths):
            side = int(is_across(ring))
            asked[side] += 1
            found[side] += row in matched
    along, across = (hits / count if count else None for hits, count in zip(found, asked, strict=True))
    return along, across


def is_across(ring: Float) -> bool:
    """Whether the longer side of a crossing, ``(n, 2)`` in the ego frame, runs over the car's own road."""
    corners = shapely.get_coordinates(shapely.Polygon(ring).minimum_rotated_rectangle)[:3]
    sides = np.diff(corners, axis=0)
    walk = sides[np.argmax(np.linalg.norm(sides, axis=1))]
    return bool(abs(walk[1]) > abs(walk[0]))


def band_share(fused: GlobalMap, frame_maps: Sequence[FrameMap], truth: GlobalMap) -> float | None:
    """Return the share of true points within the 95 % band, as ``tests.mapfusion.calibration`` counts them."""
    seen = seen_area([found.ego_to_global for found in frame_maps], frame_maps[0].roi)
    errors = standard_errors(fused, MappedTown("", tuple(frame_maps), truth, seen))
    return share_inside(errors) if len(errors) else None


def mean(values: Iterable[float | None]) -> float | None:
    """Mean of the figures that exist."""
    known = [value for value in values if value is not None]
    return math.fsum(known) / len(known) if known else None


def mean_of(rows: Sequence[Figures]) -> Figures:
    """Mean of each figure over the drives that have it; frames, seconds and crossings add up."""
    columns = {name: [getattr(row, name) for row in rows] for name in list(Figures.__annotations__)[:11]}
    kinds = {kind.label: mean(row.per_frame[kind.label] for row in rows) or 0.0 for kind in ElementKind}
    return Figures(
        **{name: mean(values) for name, values in columns.items()},
        map_crossings=sum(row.map_crossings for row in rows),
        true_crossings=sum(row.true_crossings or 0 for row in rows),
        per_frame=kinds,
        frames=sum(row.frames for row in rows),
        seconds=sum(row.seconds for row in rows),
    )


COLUMNS = {
    "mAP": "mean_ap", "cross": "crossing", "div": "divider", "bound": "boundary", "c@.5": "crossing_at_half",
    "along": "along", "across": "across", "lines": "lines", "P@1": "precision", "R@1": "recall", "band": "band",
}  # fmt: skip
"""Heads of the table's columns, and the figures in them."""
NAME_WIDTH = 46


def table_head() -> str:
    """Return the head of the table."""
    return f"{'':{NAME_WIDTH}}" + "".join(f"{head:>7}" for head in COLUMNS) + f"{'map/true':>10}{'frames':>8}{'s':>7}"


def table_row(name: str, figures: Figures) -> str:
    """Return one line of the table; a figure that does not exist is a dash."""
    values = asdict(figures)
    cells = "".join(f"{'-' if values[key] is None else f'{values[key]:.3f}':>7}" for key in COLUMNS.values())
    crossings = f"{figures.map_crossings}/{'?' if figures.true_crossings is None else figures.true_crossings}"
    return f"{name:{NAME_WIDTH}}{cells}{crossings:>10}{figures.frames:8d}{figures.seconds:7.1f}"


def _exists(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None
