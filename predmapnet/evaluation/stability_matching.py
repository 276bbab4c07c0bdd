"""Instances of the stability metric: which predictions of two frames stand for the same element.

*Anchored* instances are elements of the ground truth that both frames hold; in either frame, the predictions are
assigned to them by a cost of class, box and points. *Paired* instances need no ground truth: the predictions of one
frame are assigned to those of the other by their localisation. Costs are the toolbox's, see
:mod:`predmapnet.evaluation.stability`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from mapfusion.arrays import Float, Integer
from mapfusion.elements import ElementKind
from predmapnet.evaluation.chamfer_distance import resample_all
from predmapnet.evaluation.frames import EvaluationFrame
from predmapnet.evaluation.stability_values import into_current_frame, localisation_matrix

MATCHING_POINTS = 50
MATCHING_RANGE = (30.0, 60.0)
"""Extents of x and y by which costs are normalised, metres; the toolbox has them the wrong way round."""
TRUTH_ORDER = (ElementKind.DIVIDER, ElementKind.PED_CROSSING, ElementKind.BOUNDARY)
"""Order of the truths of a frame in the toolbox, which numbers the instances."""


@dataclass(frozen=True)
class SceneInstances:
    """Instances of one scene.

    Attributes:
        frame_pairs: number of frame pairs.
        pairs: ``(v, 2)`` current and previous frame of each pair that holds an instance.
        pair: ``(m,)`` row of ``pairs`` of each instance, ascending.
        kinds: ``(m,)`` of the truth (anchored) or the predictions (paired).
        predictions: ``(m, 2)`` rows of the predictions in the current and the previous frame; -1 for none.
    """

    frame_pairs: int
    pairs: Integer
    pair: Integer
    kinds: Integer
    predictions: Integer


def anchored_instances(
    frames: Sequence[EvaluationFrame], truth_ids: Sequence[Integer], interval: int
) -> SceneInstances:
    """Find the elements of the ground truth that two frames share, and their predictions.

    Predictions of all classes and scores compete for the truths of a pair, in either frame apart, at the least total
    cost; there is no limit to the cost of a match. An element that clipping cut into ``k`` parts in one frame and
    ``m`` in the other is ``k * m`` instances. ``truth_ids`` are per frame ``(g,)`` ids, unique per kind.
    """
    orders = [np.argsort(np.argsort(TRUTH_ORDER)[frame.truth.kinds], kind="stable") for frame in frames]
    costs = [_costs(frame) for frame in frames]
    parts = []
    for now in range(interval, len(frames)):
        before = now - interval
        rows, columns = _shared(frames, truth_ids, orders, now, before)
        if len(rows):
            found = np.stack([_assign(costs[now], rows), _assign(costs[before], columns)], axis=1)
            parts.append((now, before, frames[now].truth.kinds[rows], found))
    return _collect(max(len(frames) - interval, 0), parts)


def paired_instances(frames: Sequence[EvaluationFrame], interval: int) -> SceneInstances:
    """Match the predictions of two frames to each other, within their class, by the best total localisation.

    Frames without predictions are left out before frames ``interval`` apart are paired.
    """
    held = [row for row, frame in enumerate(frames) if len(frame.predicted)]
    lines = {row: padded_lines(frames[row]) for row in held}
    parts = []
    for now, before in zip(held[interval:], held[:-interval], strict=True):
        current, previous = frames[now].predicted, frames[before].predicted
        kinds, rows = [], []
        for kind in ElementKind:
            own, others = np.flatnonzero(current.kinds == kind), np.flatnonzero(previous.kinds == kind)
            if len(own) and len(others):
                moved = [
                    into_current_frame(lines[before][row], current.ego_to_global, previous.ego_to_global)
                    for row in others
                ]
                matrix = localisation_matrix(*_flat([lines[now][row] for row in own]), *_flat(moved))
                first, second = linear_sum_assignment(-matrix)
                kinds.append(np.full(len(first), int(kind), dtype=np.int64))
                rows.append(np.stack([own[first], others[second]], axis=1))
        if rows:
            parts.append((now, before, np.concatenate(kinds), np.concatenate(rows)))
    return _collect(max(len(held) - interval, 0), parts)


def padded_lines(frame: EvaluationFrame) -> list[Float]:
    """Return the predicted lines of a frame as the toolbox stores them without ground truth.

    Vertices are rounded to float32, and every line ends in copies of its last vertex until it is as long as the
    longest one.
    """
    longest = max((len(line) for line in frame.predicted.polylines), default=0)
    rounded = [line.astype(np.float32).astype(np.float64) for line in frame.predicted.polylines]
    return [np.concatenate([line, np.repeat(line[-1:], longest - len(line), axis=0)]) for line in rounded]


def matching_costs(
    predicted: Float, kinds: Integer, scores: NDArray[np.float32], truths: Float, truth_kinds: Integer
) -> Float:
    """Costs of assigning predictions ``(n, 50, 2)`` to truths ``(g, 50, 2)``: class, box and points, ``(n, g)``.

    Points of truths are normalised twice, as in the toolbox.
    """
    range_ = np.array(MATCHING_RANGE)
    grown = np.exp(scores.astype(np.float64))
    right, wrong = -np.log(grown / (grown + 2) + 1e-8), -np.log(1 / (grown + 2) + 1e-8)
    of_class = np.where(kinds[:, None] == truth_kinds[None, :], right[:, None], wrong[:, None])
    boxes = np.abs(_boxes(predicted)[:, None] - _boxes(truths)[None, :]).sum(axis=2)
    once, twice = _normalised(predicted, range_), _normalised(_normalised(truths, range_), range_)
    near: Float = _point_costs(np.ascontiguousarray(once), np.ascontiguousarray(twice))
    costs: Float = of_class + boxes + near
    return costs


def _costs(frame: EvaluationFrame) -> Float:
    predicted, truth = frame.predicted, frame.truth
    return matching_costs(
        resample_all(predicted.polylines, MATCHING_POINTS),
        predicted.kinds,
        predicted.scores.astype(np.float32),
        resample_all(truth.polylines, MATCHING_POINTS),
        truth.kinds,
    )


def _shared(
    frames: Sequence[EvaluationFrame], truth_ids: Sequence[Integer], orders: Sequence[Integer], now: int, before: int
) -> tuple[Integer, Integer]:
    """Rows of the truths of two frames that are the same element, all combinations, in the toolbox's order."""
    own, others = orders[now], orders[before]
    same = truth_ids[now][own][:, None] == truth_ids[before][others][None, :]
    same &= frames[now].truth.kinds[own][:, None] == frames[before].truth.kinds[others][None, :]
    rows, columns = np.nonzero(same)
    return own[rows], others[columns]


def _assign(costs: Float, columns: Integer) -> Integer:
    """Prediction of each instance, whose truth is a column of ``costs``; -1 where there are too few."""
    found = np.full(len(columns), -1, dtype=np.int64)
    rows, matched = linear_sum_assignment(costs[:, columns])
    found[matched] = rows
    return found


def _collect(frame_pairs: int, parts: Sequence[tuple[int, int, Integer, Integer]]) -> SceneInstances:
    counts = [len(kinds) for _, _, kinds, _ in parts]
    return SceneInstances(
        frame_pairs,
        np.array([part[:2] for part in parts], dtype=np.int64).reshape(-1, 2),
        np.repeat(np.arange(len(parts)), counts),
        np.concatenate([np.zeros(0, dtype=np.int64), *(kinds for _, _, kinds, _ in parts)]),
        np.concatenate([np.zeros((0, 2), dtype=np.int64), *(found for _, _, _, found in parts)]),
    )


def _flat(lines: Sequence[Float]) -> tuple[Float, Integer]:
    return np.concatenate(lines), np.cumsum([0, *(len(line) for line in lines)])


def _normalised(points: Float, range_: Float) -> Float:
    return (points + range_ / 2) / range_


def _boxes(lines: Float) -> Float:
    """Centre and size of each line's box, normalised, ``(n, 4)``."""
    range_ = np.array(MATCHING_RANGE)
    low, high = lines.min(axis=1), lines.max(axis=1)
    return np.concatenate([_normalised((low + high) / 2, range_), (high - low) / range_], axis=1)


@njit(cache=True, fastmath={"nnan", "nsz"})
def _point_costs(predicted: Float, truths: Float) -> Float:  # pragma: no cover - compiled
    """Sum of the two directed mean nearest-point distances of all pairs, ``(n, g)``."""
    count = predicted.shape[1]
    costs = np.zeros((len(predicted), len(truths)))
    nearest = np.empty(count)
    for row in range(len(predicted)):
        for column in range(len(truths)):
            nearest[:] = np.inf
            total = 0.0
            for point in range(count):
                x, y = predicted[row, point, 0], predicted[row, point, 1]
                best = np.inf
                for other in range(count):
                    square = (x - truths[column, other, 0]) ** 2 + (y - truths[column, other, 1]) ** 2
                    best = min(best, square)
                    nearest[other] = min(nearest[other], square)
                total += np.sqrt(best)
            for other in range(count):
                total += np.sqrt(nearest[other])
            costs[row, column] = total / count
    return costs
