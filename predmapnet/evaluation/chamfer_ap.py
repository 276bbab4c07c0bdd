"""Chamfer AP: the mAP of HDMapNet, VectorMapNet, MapTR and MapTracker.

Every prediction and every (simplified) truth becomes 200 points at equal distances; a pair is as far apart as the
mean of its two directed mean nearest-point distances. Rings are treated as open lines, direction does not matter.
Ties of scores keep frame order and row order (the official code sorts unstably, so its own last digits vary).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from mapfusion.elements import ElementKind, RegionOfInterest
from predmapnet.evaluation.chamfer_distance import POINTS_PER_LINE, chamfer_matrix, match_greedily, resample_all
from predmapnet.evaluation.frames import EvaluationFrame, simplify_all
from predmapnet.evaluation.precision_recall import AveragePrecision, accumulate

Thresholds = tuple[float, ...]

STANDARD_THRESHOLDS: Thresholds = (0.5, 1.0, 1.5)
WIDE_THRESHOLDS: Thresholds = (1.0, 1.5, 2.0)


def thresholds_for(roi: RegionOfInterest) -> Thresholds:
    """Chamfer thresholds of the benchmarks, metres: 0.5/1.0/1.5 for 60 x 30 m, 1.0/1.5/2.0 for 100 x 50 m."""
    return WIDE_THRESHOLDS if roi.length > 60.0 else STANDARD_THRESHOLDS


def chamfer_average_precision(
    frames: Sequence[EvaluationFrame], thresholds: Thresholds = STANDARD_THRESHOLDS
) -> AveragePrecision:
    """Average precision of the predictions of all frames together.

    Args:
        frames: scenes in the order of their names, frames in order of time (the order only decides equal scores).
        thresholds: metres, ascending.

    Returns:
        Per kind and threshold; ``mean`` is the mAP.
    """
    flags = [frame_flags(frame, thresholds) for frame in frames]
    return chamfer_from_flags(frames, flags, thresholds)


def chamfer_from_flags(
    frames: Sequence[EvaluationFrame], flags: Sequence[NDArray[np.int8]], thresholds: Thresholds
) -> AveragePrecision:
    """Accumulate the :func:`frame_flags` of frames, which may come from several processes."""
    truths = [sum(int((frame.truth.kinds == kind).sum()) for frame in frames) for kind in ElementKind]
    return accumulate(
        [frame.predicted.kinds for frame in frames],
        [frame.predicted.scores for frame in frames],
        flags,
        truths,
        thresholds,
    )


def frame_flags(frame: EvaluationFrame, thresholds: Thresholds = STANDARD_THRESHOLDS) -> NDArray[np.int8]:
    """Decide which predictions of one frame are true positives.

    Returns:
        ``(n, thresholds) int8``: 1 true positive, 0 false positive.
    """
    predicted = resample_all(frame.predicted.polylines, POINTS_PER_LINE)
    truths = resample_all(simplify_all(frame.truth.polylines), POINTS_PER_LINE)
    # A truth beyond the largest threshold can never be matched, wherever exactly it lies.
    matrix = chamfer_matrix(predicted, frame.predicted.kinds, truths, frame.truth.kinds, limit=max(thresholds))
    matched = match_greedily(matrix, frame.predicted.scores, thresholds)
    return (matched >= 0).astype(np.int8)
