"""Chamfer distances between all predictions and truths of a frame, compiled with numba."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numba import njit
from numpy.typing import NDArray

from mapfusion.arrays import Float, Integer

POINTS_PER_LINE = 200
"""Points at equal distances along a line between which the official distance is measured."""


def resample_all(polylines: Sequence[Float], count: int) -> Float:
    """Place ``count`` points at equal distances along each line ``(k, 2)``, both ends included: ``(n, count, 2)``.

    The same as :func:`mapfusion.geometry.resample` line by line, for the thousands of lines of an evaluation.
    """
    if not polylines:
        return np.zeros((0, count, 2))
    offsets = np.zeros(len(polylines) + 1, dtype=np.int64)
    np.cumsum([len(points) for points in polylines], out=offsets[1:])
    points = np.ascontiguousarray(np.concatenate(polylines), dtype=np.float64)
    resampled: Float = _resample(points, offsets, count)
    return resampled


def chamfer_matrix(
    predicted: Float, predicted_kinds: Integer, truths: Float, truth_kinds: Integer, limit: float = np.inf
) -> Float:
    """Mean of the two directed mean nearest-point distances, for all pairs of one kind, metres: ``(n, m)``.

    Lines are ``(n, p, 2)`` and ``(m, p, 2) float64``. Infinite for pairs of different kinds and for those beyond
    ``limit``, which are not computed to the end.
    """
    matrix: Float = _chamfer_matrix(
        np.ascontiguousarray(predicted.transpose(0, 2, 1)),
        np.asarray(predicted_kinds, dtype=np.int64),
        np.ascontiguousarray(truths.transpose(0, 2, 1)),
        np.asarray(truth_kinds, dtype=np.int64),
        limit,
    )
    return matrix


def match_greedily(matrix: Float, scores: Float, thresholds: Sequence[float]) -> NDArray[np.int64]:
    """Assign predictions to truths as the official chamfer AP does.

    Predictions choose in descending score (ties in row order). Each looks only at its nearest truth (the first of
    equally near ones); where that one is taken already, the prediction stays unmatched.

    Args:
        matrix: ``(n, m)`` distances, infinite where a pair cannot match.
        scores: ``(n,)``.
        thresholds: ``t`` distances; a pair matches at ``distance <= threshold``.

    Returns:
        ``(n, t) int64``: row of the matched truth, -1 for a false positive.
    """
    matched = np.full((len(scores), len(thresholds)), -1, dtype=np.int64)
    if matrix.shape[0] == 0 or matrix.shape[1] == 0:
        return matched
    order = np.argsort(-scores, kind="stable")
    nearest = matrix.argmin(axis=1)[order]
    distance = matrix[order, nearest]
    for column, threshold in enumerate(thresholds):
        rows = np.flatnonzero(distance <= threshold)
        # In score order, the first candidate of each truth wins it.
        truth, first = np.unique(nearest[rows], return_index=True)
        matched[order[rows[first]], column] = truth
    return matched


@njit(cache=True)
def _resample(points: Float, offsets: Integer, count: int) -> Float:  # pragma: no cover - compiled
    lines = len(offsets) - 1
    out = np.empty((lines, count, 2))
    for line in range(lines):
        first, last = offsets[line], offsets[line + 1] - 1
        total = 0.0
        for vertex in range(first, last):
            total += np.hypot(points[vertex + 1, 0] - points[vertex, 0], points[vertex + 1, 1] - points[vertex, 1])
        vertex, walked, step = first, 0.0, 0.0
        if last > first:
            step = np.hypot(points[first + 1, 0] - points[first, 0], points[first + 1, 1] - points[first, 1])
        for station in range(count):
            distance = total * station / (count - 1)
            while vertex + 2 <= last and walked + step <= distance:
                walked += step
                vertex += 1
                step = np.hypot(points[vertex + 1, 0] - points[vertex, 0], points[vertex + 1, 1] - points[vertex, 1])
            fraction = min((distance - walked) / step, 1.0) if step > 0.0 else 0.0
            follower = min(vertex + 1, last)
            for axis in range(2):
                start = points[vertex, axis]
                out[line, station, axis] = start + fraction * (points[follower, axis] - start)
    return out


@njit(cache=True, fastmath={"nnan", "nsz"})
def _chamfer_matrix(
    predicted: Float, predicted_kinds: Integer, truths: Float, truth_kinds: Integer, limit: float
) -> Float:  # pragma: no cover - compiled
    count = predicted.shape[2]
    matrix = np.full((len(predicted), len(truths)), np.inf)
    column_best = np.empty(count)
    for row in range(len(predicted)):
        x, y = predicted[row, 0], predicted[row, 1]
        for column in range(len(truths)):
            if predicted_kinds[row] != truth_kinds[column]:
                continue
            truth_x, truth_y = truths[column, 0], truths[column, 1]
            # The gap between the bounding boxes is a lower bound of every nearest-point distance.
            gap_x = max(x.min() - truth_x.max(), truth_x.min() - x.max(), 0.0)
            gap_y = max(y.min() - truth_y.max(), truth_y.min() - y.max(), 0.0)
            if np.hypot(gap_x, gap_y) > limit + 1e-6:
                continue
            column_best[:] = np.inf
            forward = 0.0
            for point in range(count):
                best = np.inf
                for other in range(count):
                    square = (x[point] - truth_x[other]) ** 2 + (y[point] - truth_y[other]) ** 2
                    best = min(best, square)
                    column_best[other] = min(column_best[other], square)
                forward += np.sqrt(best)
                if forward > 2.0 * count * (limit + 1e-6):
                    break  # half of the distance is already beyond the limit
            else:
                backward = 0.0
                for other in range(count):
                    backward += np.sqrt(column_best[other])
                matrix[row, column] = (forward + backward) / (2.0 * count)
    return matrix
