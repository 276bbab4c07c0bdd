"""Order-aware AP: average precision by the discrete Frechet distance, which sees shortcuts, loops and wrong joins.

Chamfer distances compare sets of points; two lines that run through the same points in another order are equal to them.
The discrete Frechet distance (Eiter and Mannila, 1994) is the shortest leash with which two walkers get along the lines
without turning back. VectorMapNet reports an AP by it beside the chamfer AP, with larger thresholds, because the
distance is a maximum and not a mean.

No public code settles the details, so figures of other tools may differ: here both lines have 100 points at equal
distances, the truth is simplified as for chamfer AP, a line may be walked in either direction, a crossing may also
start at any of its points, and the matching is that of chamfer AP.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numba import njit

from mapfusion.arrays import Bool, Float, Integer
from mapfusion.elements import ElementKind
from predmapnet.evaluation.chamfer_distance import match_greedily, resample_all
from predmapnet.evaluation.frames import EvaluationFrame, simplify_all
from predmapnet.evaluation.precision_recall import Matches

FRECHET_POINTS = 100
FRECHET_THRESHOLDS = (1.0, 2.0, 3.0)
"""Metres, in every region."""


def frechet_matches(frame: EvaluationFrame, thresholds: Sequence[float] = FRECHET_THRESHOLDS) -> Matches:
    """Match the predictions of one frame."""
    predicted = resample_all(frame.predicted.polylines, FRECHET_POINTS)
    truths = resample_all(simplify_all(frame.truth.polylines), FRECHET_POINTS)
    matrix = frechet_matrix(predicted, frame.predicted.kinds, truths, frame.truth.kinds, max(thresholds))
    scores = frame.predicted.scores
    return Matches.of(frame.predicted.kinds, scores, match_greedily(matrix, scores, thresholds), frame.truth.kinds)


def frechet_matrix(
    predicted: Float, predicted_kinds: Integer, truths: Float, truth_kinds: Integer, limit: float
) -> Float:
    """Discrete Frechet distances of all pairs of one kind, in the better direction, metres: ``(n, m)``.

    Lines are ``(n, p, 2)`` and ``(m, p, 2) float64``; a ring repeats its first point at the end. Infinite for pairs of
    different kinds and for those beyond ``limit``, which are not computed to the end.
    """
    rings = np.isin(predicted_kinds, [kind for kind in ElementKind if kind.is_ring])
    matrix: Float = _matrix(predicted, predicted_kinds, truths, truth_kinds, rings, limit)
    return matrix


@njit(cache=True)
def _leash(first: Float, second: Float, most: float, row: Float) -> float:  # pragma: no cover - compiled
    """Square of the discrete Frechet distance of two lines of equally many points; infinite if above ``most``."""
    count = len(first)
    for step in range(count):
        best_of_row = diagonal = np.inf
        for other in range(count):
            apart = (first[step, 0] - second[other, 0]) ** 2 + (first[step, 1] - second[other, 1]) ** 2
            if step == 0:
                reach = apart if other == 0 else max(row[other - 1], apart)
            else:
                before = min(row[other], diagonal)
                if other > 0:
                    before = min(before, row[other - 1])
                reach = max(before, apart)
            diagonal = row[other]
            row[other] = reach
            best_of_row = min(best_of_row, reach)
        if best_of_row > most:
            return np.inf
    return float(row[count - 1])


@njit(cache=True)
def _best_leash(first: Float, second: Float, ring: bool, most: float, row: Float) -> float:  # pragma: no cover
    """Square of the distance for the best direction and start; infinite if above ``most``."""
    count = len(first)
    starts = count - 1 if ring else 1
    best = np.inf
    turned = np.empty_like(second)
    for direction in range(2):
        for start in range(starts):
            head = start if direction == 0 else count - 1 - start
            if (first[0, 0] - second[head, 0]) ** 2 + (first[0, 1] - second[head, 1]) ** 2 > most:
                continue
            for point in range(count):
                place = (start + point) % (count - 1) if ring else point
                turned[point] = second[place] if direction == 0 else second[count - 1 - place]
            if (first[-1, 0] - turned[-1, 0]) ** 2 + (first[-1, 1] - turned[-1, 1]) ** 2 > most:
                continue
            best = min(best, _leash(first, turned, most, row))
            most = min(best, most)
    return best


@njit(cache=True)
def _matrix(
    predicted: Float, predicted_kinds: Integer, truths: Float, truth_kinds: Integer, rings: Bool, limit: float
) -> Float:  # pragma: no cover - compiled
    matrix = np.full((len(predicted), len(truths)), np.inf)
    row = np.empty(predicted.shape[1])
    for first in range(len(predicted)):
        for second in range(len(truths)):
            if predicted_kinds[first] == truth_kinds[second]:
                square = _best_leash(predicted[first], truths[second], rings[first], (limit + 1e-6) ** 2, row)
                matrix[first, second] = np.sqrt(square)
    return matrix
