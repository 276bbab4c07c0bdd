"""Errors of the short-term forecasts, beside those of trivial baselines.

An element that is tracked at t is compared, point by point, with the truth that its track finds at t + 1 and t + 2.
Three forecasts compete: the network's (at t + 2 continued at constant velocity, since it looks one instant ahead),
*constant position* (the polyline of t as it is), and *ego motion only* (the polyline of t moved by the ego motion
from t - 1 to t again, and clipped to the ROI). None of them knows the pose at t + 1.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import shapely

from mapfusion.arrays import Float
from mapfusion.elements import ElementKind, RegionOfInterest
from mapfusion.geometry import clip_line, inverse_pose, resample, transform_points
from mapfusion.ground import region
from predmapnet.evaluation.chamfer_distance import POINTS_PER_LINE, chamfer_matrix, match_greedily, resample_all
from predmapnet.evaluation.frames import EvaluationFrame

HORIZONS = (1, 2)
"""Instants ahead."""
FORECASTERS = ("forecast", "constant_position", "ego_motion")
POINTS = 20
MATCH_DISTANCE = 1.5
"""Metres, chamfer; the truth that a track finds at the later instant."""


@dataclass(frozen=True)
class ForecastErrors:
    """Mean point-wise distance of each forecast to the truth, ``(n, 3)`` metres per horizon; columns FORECASTERS."""

    errors: tuple[Float, ...]

    def figures(self) -> dict[str, object]:
        """Mean and median per horizon and forecaster, as written to JSON; None without a single forecast."""
        figures: dict[str, object] = {}
        for horizon, errors in zip(HORIZONS, self.errors, strict=True):
            entry: dict[str, float | int | None] = {"count": len(errors)}
            for column, name in enumerate(FORECASTERS):
                values = errors[:, column]
                entry[f"{name}_mean_m"] = float(values.mean()) if len(values) else None
                entry[f"{name}_median_m"] = float(np.median(values)) if len(values) else None
            figures[f"t+{horizon}"] = entry
        return figures


def forecast_errors(frames: Sequence[EvaluationFrame]) -> ForecastErrors:
    """Measure all forecasts of one scene; its first frame has no past ego motion and is left out."""
    collected: tuple[list[list[float]], ...] = tuple([] for _ in HORIZONS)
    targets = [*map(_targets, frames), *({} for _ in range(max(HORIZONS)))]
    for now in range(1, len(frames)):
        predicted = frames[now].predicted
        if predicted.forecasts is None:
            continue
        motion = inverse_pose(predicted.ego_to_global) @ frames[now - 1].predicted.ego_to_global
        for row in np.flatnonzero(predicted.track_ids >= 0):
            if len(predicted.forecasts[row]) == 0:
                continue
            kind = ElementKind(int(predicted.kinds[row]))
            line = resample(predicted.polylines[row], POINTS)
            forecast = resample(predicted.forecasts[row], POINTS)
            for horizon, errors in zip(HORIZONS, collected, strict=True):
                target = targets[now + horizon].get((kind, int(predicted.track_ids[row])))
                if target is not None:
                    moved = _moved(line, np.linalg.matrix_power(motion, horizon), kind, predicted.roi)
                    candidates = (line + horizon * (forecast - line), line, moved)
                    errors.append([pointwise_error(points, target, kind.is_ring) for points in candidates])
    return ForecastErrors(tuple(np.array(errors).reshape(-1, len(FORECASTERS)) for errors in collected))


def pool_forecasts(parts: Sequence[ForecastErrors]) -> ForecastErrors:
    """Put the scenes together."""
    empty = np.zeros((0, len(FORECASTERS)))
    return ForecastErrors(
        tuple(np.concatenate([empty, *(part.errors[column] for part in parts)]) for column in range(len(HORIZONS)))
    )


def pointwise_error(points: Float, target: Float, ring: bool) -> float:
    """Mean distance of corresponding points ``(n, 2)``, metres, for the best direction (and start, if it is a ring).

    Both have equally many points at equal distances; a ring repeats the first one at the end.
    """
    orders = np.stack([target, target[::-1]])
    if ring:
        opened = orders[:, :-1]
        orders = np.concatenate([np.roll(opened, shift, axis=1) for shift in range(opened.shape[1])])
        points = points[:-1]
    return float(np.linalg.norm(orders - points, axis=2).mean(axis=1).min())


def _targets(frame: EvaluationFrame) -> dict[tuple[int, int], Float]:
    """The truth that each track finds, ``(20, 2)``, by kind and track id."""
    predicted, truth = frame.predicted, frame.truth
    rows = np.flatnonzero(predicted.track_ids >= 0)
    lines = resample_all([predicted.polylines[row] for row in rows], POINTS_PER_LINE)
    truths = resample_all(truth.polylines, POINTS_PER_LINE)
    matrix = chamfer_matrix(lines, predicted.kinds[rows], truths, truth.kinds, limit=MATCH_DISTANCE)
    found = match_greedily(matrix, predicted.scores[rows], (MATCH_DISTANCE,))[:, 0]
    return {
        (int(predicted.kinds[row]), int(predicted.track_ids[row])): resample(truth.polylines[match], POINTS)
        for row, match in zip(rows, found, strict=True)
        if match >= 0
    }


def _moved(line: Float, motion: Float, kind: ElementKind, roi: RegionOfInterest) -> Float:
    """Move a polyline into the next ego frame and clip it to the ROI; unclipped if nothing of it stays inside."""
    moved = transform_points(motion, line)
    if kind.is_ring:
        inside = shapely.get_parts(shapely.intersection(shapely.make_valid(shapely.Polygon(moved)), region(roi)))
        polygons = [part for part in inside if part.geom_type == "Polygon" and not part.is_empty]
        parts = [shapely.get_coordinates(polygon.exterior) for polygon in polygons]
    else:
        parts = clip_line(moved, roi)
    if not parts:
        return moved
    longest = max(parts, key=lambda part: float(np.linalg.norm(np.diff(part, axis=0), axis=1).sum()))
    return resample(longest, POINTS)
