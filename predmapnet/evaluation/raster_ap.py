"""Rasterisation AP, the stricter mAP of MapVR: elements are drawn and compared by the overlap of their masks.

Each element is drawn at 8 pixels per metre (lines one pixel wide, crossings filled) and dilated by a 5 x 5 square.
Predictions below a score of 0.05 are dropped and at most the best 100 of a kind and frame count. Matching and
averaging follow COCO: a prediction takes the best truth that is still free, AP is the mean precision at 101 recalls.
The ground truth is not simplified. Nothing is drawn of a line of a single point, so it overlaps with nothing.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np
from numba import njit

from mapfusion.arrays import Float, Integer
from mapfusion.elements import ElementKind, RegionOfInterest
from predmapnet.datasets.ground_truth.raster import Mask, packed_bits, packed_iou
from predmapnet.evaluation.frames import EvaluationFrame

Axes = Literal["mapvr", "ego"]
"""Axes of the canvas: ``mapvr`` has x to the right and y forward, as MapVR draws it; ``ego`` x forward.
Rounding makes a difference in the third digit."""

PIXELS_PER_METRE = 8
DILATION = 5
MINIMUM_SCORE = 0.05
MAXIMUM_DETECTIONS = 100
RECALL_LIMITS = (1, 10, 100)
LINE_THRESHOLDS: Float = np.linspace(0.25, 0.50, 6)
CROSSING_THRESHOLDS: Float = np.linspace(0.50, 0.75, 6)
_RECALLS: Float = np.linspace(0.0, 1.0, 101)


@dataclass(frozen=True)
class RasterMatches:
    """Matches of one kind in one frame.

    Attributes:
        rows: ``(n,)`` rows of the frame's predictions that count, in descending score.
        scores: ``(n,)``.
        iou: ``(n, m)`` overlap with the ``m`` truths of the kind.
        matches: ``(6, n)`` index of the matched truth per threshold, -1 for a false positive.
        frame_iou: overlap of all predictions together with all truths together; 0 if there are none of either.
    """

    rows: Integer
    scores: Float
    iou: Float
    matches: Integer
    frame_iou: float

    @property
    def truths(self) -> int:
        """Number of truths of the kind."""
        return int(self.iou.shape[1])


@dataclass(frozen=True)
class RasterKindResult:
    """Figures of one kind; None where the kind has no ground truth at all.

    Attributes:
        kind: of the elements.
        thresholds: ``(6,)`` overlaps.
        average_precisions: ``(6,)`` one per threshold.
        recalls: highest recall ``(6,)`` by the number of detections that may count per frame (1, 10, 100).
        frame_miou: mean overlap over the frames that hold the kind, predicted or true; None if none does.
    """

    kind: ElementKind
    thresholds: Float
    average_precisions: Float | None
    recalls: dict[int, Float] | None
    frame_miou: float | None

    @property
    def average_precision(self) -> float | None:
        """Mean over the thresholds."""
        return None if self.average_precisions is None else float(np.mean(self.average_precisions))


@dataclass(frozen=True)
class RasterAveragePrecision:
    """Rasterisation AP of all kinds."""

    kinds: tuple[RasterKindResult, ...]

    @property
    def mean(self) -> float | None:
        """The mAP: mean over the kinds that have ground truth; None if none has."""
        present = [kind.average_precision for kind in self.kinds if kind.average_precision is not None]
        return float(np.mean(present)) if present else None

    def figures(self) -> dict[str, object]:
        """Nested figures as written to JSON: ``mAP`` and, per kind, ``AP``, ``AP@0.50``, ``AR``, ``frame_mIoU``."""
        figures: dict[str, object] = {"mAP": self.mean}
        for result in self.kinds:
            entry: dict[str, float | None] = {"AP": result.average_precision}
            if result.average_precisions is not None and result.recalls is not None:
                steps = zip(result.thresholds, result.average_precisions, strict=True)
                entry |= {f"AP@{threshold:.2f}": float(value) for threshold, value in steps}
                entry |= {"AR": float(np.mean(result.recalls[MAXIMUM_DETECTIONS]))}
            figures[result.kind.label] = entry | {"frame_mIoU": result.frame_miou}
        return figures


def raster_average_precision(frames: Sequence[EvaluationFrame], axes: Axes = "mapvr") -> RasterAveragePrecision:
    """Rasterisation AP of the predictions of all frames together, in the order that decides equal scores."""
    return raster_from_matches([raster_matches(frame, axes) for frame in frames])


def raster_matches(frame: EvaluationFrame, axes: Axes = "mapvr") -> tuple[RasterMatches, ...]:
    """Draw one frame and match its predictions, one entry per kind."""
    predicted, truth, roi = frame.predicted, frame.truth, frame.predicted.roi
    results = []
    for kind in ElementKind:
        candidates = np.flatnonzero((predicted.kinds == kind) & (predicted.scores >= MINIMUM_SCORE))
        order = np.argsort(-predicted.scores[candidates], kind="stable")[:MAXIMUM_DETECTIONS]
        rows = candidates[order]
        truths = np.flatnonzero(truth.kinds == kind)
        iou, frame_iou = np.zeros((len(rows), len(truths))), 0.0
        if len(rows) and len(truths):
            drawn = _draw([predicted.polylines[row] for row in rows], kind, roi, axes)
            drawn_truths = _draw([truth.polylines[row] for row in truths], kind, roi, axes)
            iou, frame_iou = _overlaps(drawn, drawn_truths)
        thresholds = CROSSING_THRESHOLDS if kind.is_ring else LINE_THRESHOLDS
        results.append(RasterMatches(rows, predicted.scores[rows], iou, _match(iou, thresholds), frame_iou))
    return tuple(results)


def raster_from_matches(frames: Sequence[tuple[RasterMatches, ...]]) -> RasterAveragePrecision:
    """Accumulate what :func:`raster_matches` found frame by frame, for example in several processes."""
    return RasterAveragePrecision(tuple(_accumulate(kind, [frame[kind] for frame in frames]) for kind in ElementKind))


def _draw(polylines: Sequence[Float], kind: ElementKind, roi: RegionOfInterest, axes: Axes) -> Mask:
    """Draw each element on a canvas of its own: ``(n, rows, columns)`` of 0 and 1."""
    size = roi.size if axes == "ego" else roi.size[::-1]
    columns, rows = np.rint(size * PIXELS_PER_METRE).astype(int)
    masks = np.zeros((len(polylines), rows, columns), dtype=np.uint8)
    square = np.ones((DILATION, DILATION), dtype=np.uint8)
    together = np.concatenate(polylines)
    oriented = together if axes == "ego" else np.stack([-together[:, 1], together[:, 0]], axis=1)
    pixels = np.around((oriented + size / 2) * PIXELS_PER_METRE).astype(np.int32)
    starts = np.cumsum([0, *(len(points) for points in polylines[:-1])])
    # Only the part of the canvas around an element is drawn on and dilated.
    lows = np.maximum(np.minimum.reduceat(pixels, starts) - DILATION, 0)
    highs = np.maximum(np.maximum.reduceat(pixels, starts) + DILATION, 0)
    for mask, line, low, high in zip(masks, np.split(pixels, starts[1:]), lows, highs, strict=True):
        part = mask[low[1] : high[1], low[0] : high[0]]
        if part.size == 0:
            continue
        if kind.is_ring:
            cv2.fillPoly(part, [line - low], color=1)
        else:
            cv2.polylines(part, [line - low], isClosed=False, color=1, thickness=1)
        cv2.dilate(part, square, dst=part)
    return masks


def _overlaps(predicted: Mask, truths: Mask) -> tuple[Float, float]:
    """Overlap of every pair ``(n, m)``, and of the two unions."""
    first, second = packed_bits(predicted.reshape(len(predicted), -1)), packed_bits(truths.reshape(len(truths), -1))
    both = packed_iou(np.bitwise_or.reduce(first)[None], np.bitwise_or.reduce(second)[None])
    return packed_iou(first, second), float(both[0, 0])


@njit(cache=True)
def _match(iou: Float, thresholds: Float) -> Integer:  # pragma: no cover - compiled
    """COCO matching in score order: ``(t, n)`` index of the best truth still free (last among equals), or -1."""
    count, truths = iou.shape
    matches = np.full((len(thresholds), count), -1, dtype=np.int64)
    for step in range(len(thresholds)):
        free = np.ones(truths, dtype=np.bool_)
        for row in range(count):
            best = -1
            for column in range(truths):
                overlap = iou[row, column]
                if free[column] and overlap >= thresholds[step] and (best < 0 or overlap >= iou[row, best]):
                    best = column
            if best >= 0:
                matches[step, row] = best
                free[best] = False
    return matches


def _accumulate(kind: ElementKind, frames: Sequence[RasterMatches]) -> RasterKindResult:
    thresholds = CROSSING_THRESHOLDS if kind.is_ring else LINE_THRESHOLDS
    holding = [frame for frame in frames if len(frame.rows) or frame.truths]
    frame_miou = float(np.mean([frame.frame_iou for frame in holding])) if holding else None
    truths = sum(frame.truths for frame in frames)
    if truths == 0:
        return RasterKindResult(kind, thresholds, None, None, frame_miou)
    scores = np.concatenate([frame.scores for frame in holding])
    order = np.argsort(-scores, kind="stable")
    hits = np.concatenate([frame.matches for frame in holding], axis=1)[:, order] >= 0
    found = np.cumsum(hits, axis=1, dtype=np.float64)
    precision = found / (np.arange(1, len(order) + 1) + np.spacing(1.0))
    envelope = np.maximum.accumulate(precision[:, ::-1], axis=1)[:, ::-1]
    averages = np.zeros(len(thresholds))
    for row in range(len(thresholds)):
        reached = np.searchsorted(found[row] / truths, _RECALLS, side="left")
        reached = reached[reached < len(order)]
        averages[row] = envelope[row, reached].sum() / len(_RECALLS)
    recalls = {
        limit: np.sum([(frame.matches[:, :limit] >= 0).sum(axis=1) for frame in holding], axis=0) / truths
        for limit in RECALL_LIMITS
    }
    return RasterKindResult(kind, thresholds, averages, recalls, frame_miou)
