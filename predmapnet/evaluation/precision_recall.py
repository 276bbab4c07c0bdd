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
    """Precision over recall of one kind at one threshold (metres), one entry per prediction in descending score.

    The average precision is the area under the monotone envelope of the curve.
    """

    threshold: float
    scores: Float
    precision: Float
    recall: Float
    average_precision: float


@dataclass(frozen=True)
class KindResult:
    """Average precision of one kind, with one curve per threshold and the numbers of elements."""

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
        flags: ``(n, thresholds) int8``: 1 true positive, 0 false positive, -1 not counted.
        truths: ``(3,)`` number of true elements per kind.
    """

    kinds: Integer
    scores: Float
    flags: NDArray[np.int8]
    truths: Integer

    @classmethod
    def of(cls, kinds: Integer, scores: Float, matched: Integer, true_kinds: Integer) -> Matches:
        """Return the matches of :func:`~predmapnet.evaluation.chamfer_distance.match_greedily`."""
        return cls(kinds, scores, (matched >= 0).astype(np.int8), np.bincount(true_kinds, minlength=len(ElementKind)))

    @classmethod
    def together(cls, parts: Sequence[Matches], thresholds: int) -> Matches:
        """Return the matches of all parts, one after the other, at so many thresholds."""
        return cls(
            np.concatenate([np.zeros(0, dtype=np.int64), *(part.kinds for part in parts)]),
            np.concatenate([np.zeros(0), *(part.scores for part in parts)]),
            np.concatenate([np.zeros((0, thresholds), dtype=np.int8), *(part.flags for part in parts)]),
            np.sum([np.zeros(len(ElementKind), dtype=np.int64), *(part.truths for part in parts)], axis=0),
        )


def accumulate(matches: Sequence[Matches], thresholds: Sequence[float]) -> AveragePrecision:
    """Collect the matches of all frames or maps into average precisions; their order decides equal scores.

    There is a result for every kind, also for one that never occurs (AP 0).
    """
    every = Matches.together(matches, len(thresholds))
    results = []
    for kind in ElementKind:
        counted, truths = (every.kinds == kind) & (every.flags[:, 0] >= 0), int(every.truths[kind])
        curves = tuple(
            precision_recall(every.scores[counted], every.flags[counted, column] == 1, truths, float(threshold))
            for column, threshold in enumerate(thresholds)
        )
        results.append(KindResult(kind, curves, truths, int(counted.sum())))
    flags = tuple(part.flags for part in matches)
    return AveragePrecision(tuple(float(value) for value in thresholds), tuple(results), flags)


def precision_recall(
    scores: Float, true_positive: NDArray[np.bool_], truths: int, threshold: float
) -> PrecisionRecallCurve:
    """Sort by score (stable) and accumulate.

    The average precision is the sum, over the recalls that are reached, of the step in recall times the best precision
    at that recall or beyond; ``truths`` is the number of true elements, found or not.
    """
    order = np.argsort(-scores, kind="stable")
    hits = np.cumsum(true_positive[order], dtype=np.float64)
    counted = np.arange(1, len(order) + 1, dtype=np.float64)
    recall = hits / max(truths, _EPSILON)
    precision = hits / np.maximum(counted, _EPSILON)
    envelope = np.maximum.accumulate(precision[::-1])[::-1]
    area = float(np.sum(np.diff(recall, prepend=0.0) * envelope))
    return PrecisionRecallCurve(threshold, scores[order], precision, recall, area)
