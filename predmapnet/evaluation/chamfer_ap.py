"""Chamfer AP: the mAP of HDMapNet, VectorMapNet, MapTR and MapTracker.

Every prediction and every (simplified) truth becomes 200 points at equal distances; a pair is as far apart as the
mean of its two directed mean nearest-point distances. Rings are treated as open lines, direction does not matter.
Ties of scores keep frame order and row order (the official code sorts unstably, so its own last digits vary).
"""

from __future__ import annotations

from collections.abc import Sequence

from mapfusion.arrays import Float, Integer
from mapfusion.elements import RegionOfInterest
from predmapnet.evaluation.chamfer_distance import POINTS_PER_LINE, chamfer_matrix, match_greedily, resample_all
from predmapnet.evaluation.frames import EvaluationFrame, simplify_all
from predmapnet.evaluation.precision_recall import AveragePrecision, Matches, accumulate

Thresholds = tuple[float, ...]

STANDARD_THRESHOLDS: Thresholds = (0.5, 1.0, 1.5)
WIDE_THRESHOLDS: Thresholds = (1.0, 1.5, 2.0)


def thresholds_for(roi: RegionOfInterest) -> Thresholds:
    """Chamfer thresholds of the benchmarks, metres: 0.5/1.0/1.5 for 60 x 30 m, 1.0/1.5/2.0 for 100 x 50 m."""
    return WIDE_THRESHOLDS if roi.length > 60.0 else STANDARD_THRESHOLDS


def chamfer_average_precision(
    frames: Sequence[EvaluationFrame], thresholds: Thresholds = STANDARD_THRESHOLDS
) -> AveragePrecision:
    """Average precision of the predictions of all frames together; thresholds are metres, ascending.

    Scenes come in the order of their names and frames in order of time (the order only decides equal scores).
    """
    return accumulate([frame_matches(frame, thresholds) for frame in frames], thresholds)


def frame_matches(frame: EvaluationFrame, thresholds: Thresholds = STANDARD_THRESHOLDS) -> Matches:
    """Match the predictions of one frame."""
    predicted, truth = frame.predicted, frame.truth
    truths = simplify_all(truth.polylines)
    return chamfer_matches(predicted.kinds, predicted.scores, predicted.polylines, truth.kinds, truths, thresholds)


def chamfer_matches(
    kinds: Integer,
    scores: Float,
    lines: Sequence[Float],
    true_kinds: Integer,
    truths: Sequence[Float],
    thresholds: Sequence[float],
) -> Matches:
    """Match predicted lines to true ones of their kind, ``(k, 2)`` each, metres."""
    sampled, true = resample_all(lines, POINTS_PER_LINE), resample_all(truths, POINTS_PER_LINE)
    # A truth beyond the largest threshold can never be matched, wherever exactly it lies.
    matrix = chamfer_matrix(sampled, kinds, true, true_kinds, limit=max(thresholds))
    return Matches.of(kinds, scores, match_greedily(matrix, scores, thresholds), true_kinds)
