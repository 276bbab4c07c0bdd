"""Precision-recall curves and average precision from true-positive flags, as MapTR and MapTracker count."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mapfusion.arrays import Float, Integer
from mapfusion.elements import ElementKind

_EPSILON = float(np.finfo(np.float32).eps)


@dataclass(frozen=True)
class PrecisionRecallCurve:
    """Precision over recall of one kind at one threshold, in descending score.

    Attributes:
        threshold: metres.
        scores, precision, recall: ``(n,) float64``, one entry per prediction.
        average_precision: area under the monotone envelope of the curve.
    """

    threshold: float
    scores: Float
    precision: Float
    recall: Float
    average_precision: float


@dataclass(frozen=True)
class KindResult:
    """Average precision of one kind.

    Attributes:
        kind: of the elements.
        curves: one per threshold.
        truths, predictions: numbers of elements.
    """

    kind: ElementKind
    curves: tuple[PrecisionRecallCurve, ...]
    truths: int
    predictions: int

    @property
    def average_precision(self) -> float:
        """Mean over the thresholds."""
        return float(np.mean([curve.average_precision for curve in self.curves]))


@dataclass(frozen=True)
class AveragePrecision:
    """Average precision per kind and threshold.

    Attributes:
        thresholds: metres.
        kinds: one result per :class:`mapfusion.ElementKind`, in its order.
        flags: per frame ``(n, thresholds) int8`` aligned with the predictions: 1 true positive, 0 false positive,
            -1 not counted.
    """

    thresholds: tuple[float, ...]
    kinds: tuple[KindResult, ...]
    flags: tuple[NDArray[np.int8], ...]

    @property
    def mean(self) -> float:
        """The mAP: plain mean over all three kinds; a kind without ground truth counts as 0, as officially."""
        return float(np.mean([kind.average_precision for kind in self.kinds]))

    def figures(self) -> dict[str, object]:
        """Nested figures as written to JSON: ``mAP`` and, per kind, ``AP``, ``AP@0.5``, counts."""
        figures: dict[str, object] = {"mAP": self.mean}
        for result in self.kinds:
            entry: dict[str, float | int] = {"AP": result.average_precision}
            entry |= {f"AP@{curve.threshold}": curve.average_precision for curve in result.curves}
            entry |= {"truths": result.truths, "predictions": result.predictions}
            figures[result.kind.label] = entry
        return figures


@dataclass(frozen=True)
class Matches:
    """Matched predictions of one frame or one map.

    Attributes:
        kinds: ``(n,)`` of the predictions.
        scores: ``(n,)``.
        flags: ``(n, thresholds) int8``: 1 true positive, 0 false positive.
        truths: ``(3,)`` number of true elements per kind.
    """

    kinds: Integer
    scores: Float
    flags: NDArray[np.int8]
    truths: Integer


def accumulate_matches(matches: Sequence[Matches], thresholds: Sequence[float]) -> AveragePrecision:
    """Collect the matches of all frames or maps into average precisions; their order decides equal scores."""
    truths = np.sum([np.zeros(len(ElementKind), dtype=np.int64), *(part.truths for part in matches)], axis=0)
    return accumulate(
        [part.kinds for part in matches],
        [part.scores for part in matches],
        [part.flags for part in matches],
        truths.tolist(),
        thresholds,
    )


def precision_recall(
    scores: Float, true_positive: NDArray[np.bool_], truths: int, threshold: float
) -> PrecisionRecallCurve:
    """Sort by score (stable) and accumulate.

    Args:
        scores: ``(n,)``, in the order that decides ties.
        true_positive: ``(n,) bool``.
        truths: number of ground-truth elements, found or not.
        threshold: metres, carried along.

    Returns:
        The curve with its average precision: the sum, over the recalls that are reached, of the step in recall
        times the best precision at that recall or beyond.
    """
    order = np.argsort(-scores, kind="stable")
    hits = np.cumsum(true_positive[order], dtype=np.float64)
    counted = np.arange(1, len(order) + 1, dtype=np.float64)
    recall = hits / max(truths, _EPSILON)
    precision = hits / np.maximum(counted, _EPSILON)
    envelope = np.maximum.accumulate(precision[::-1])[::-1]
    area = float(np.sum(np.diff(recall, prepend=0.0) * envelope))
    return PrecisionRecallCurve(threshold, scores[order], precision, recall, area)


def accumulate(
    kinds: Sequence[NDArray[np.int64]],
    scores: Sequence[Float],
    flags: Sequence[NDArray[np.int8]],
    truths: Sequence[int],
    thresholds: Sequence[float],
) -> AveragePrecision:
    """Collect the flags of all frames into average precisions.

    Args:
        kinds: per frame ``(n,)`` kinds of the predictions.
        scores: per frame ``(n,)``.
        flags: per frame ``(n, thresholds)``: 1 true positive, 0 false positive, -1 not counted.
        truths: number of ground-truth elements per kind.
        thresholds: metres.

    Returns:
        Results for every kind, also for one that never occurs (AP 0).
    """
    all_kinds = np.concatenate([np.zeros(0, dtype=np.int64), *kinds])
    all_scores = np.concatenate([np.zeros(0), *scores])
    all_flags = np.concatenate([np.zeros((0, len(thresholds)), dtype=np.int8), *flags])
    results = []
    for kind in ElementKind:
        counted = (all_kinds == kind) & (all_flags[:, 0] >= 0)
        curves = tuple(
            precision_recall(all_scores[counted], all_flags[counted, column] == 1, truths[kind], float(threshold))
            for column, threshold in enumerate(thresholds)
        )
        results.append(KindResult(kind, curves, truths[kind], int(counted.sum())))
    return AveragePrecision(tuple(float(value) for value in thresholds), tuple(results), tuple(flags))
