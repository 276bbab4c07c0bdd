"""Ahead and rear mAP: chamfer AP of the half of the region in front of the car, and of the half behind it.

After AMap (arXiv 2512.19150), which shows that memory of what was passed helps behind the car, while planning needs the
road ahead. As publicly described, the region of interest is halved across the direction of travel, and each half is
measured like the whole. The descriptions do not say what happens to an element that crosses the middle: here the truth
and the predictions are both cut at ``x = 0``, as the truth always is at the border of the region, and each piece keeps
the score. A crossing that is cut is the outline of what is left. Published figures may differ in this point.
"""

from __future__ import annotations

from collections.abc import Sequence
from enum import Enum

import numpy as np
import shapely

from mapfusion.arrays import Float, Integer
from mapfusion.elements import ElementKind
from predmapnet.evaluation.chamfer_ap import chamfer_matches
from predmapnet.evaluation.frames import EvaluationFrame, simplify_all
from predmapnet.evaluation.precision_recall import Matches


class Half(Enum):
    """Halves of the region; the value is the sign of x."""

    AHEAD = 1.0
    REAR = -1.0


_FAR = 1e6
"""Metres; only the middle cuts, so that a prediction that leaves the region is measured as it is."""


def half_matches(frame: EvaluationFrame, half: Half, thresholds: Sequence[float]) -> Matches:
    """Match the predictions of one half of a frame; thresholds are chamfer distances, metres."""
    owners, predicted = cut_at_middle(frame.predicted.kinds, frame.predicted.polylines, half)
    true_owners, truths = cut_at_middle(frame.truth.kinds, frame.truth.polylines, half)
    kinds, scores = frame.predicted.kinds[owners], frame.predicted.scores[owners]
    true_kinds = frame.truth.kinds[true_owners]
    return chamfer_matches(kinds, scores, predicted, true_kinds, simplify_all(truths), thresholds)


def cut_at_middle(kinds: Integer, polylines: Sequence[Float], half: Half) -> tuple[Integer, list[Float]]:
    """Cut elements, lines ``(k, 2)`` of the ego frame, at ``x = 0``.

    Returns:
        Row of the element that each piece belongs to, ascending, and the pieces. What lies wholly in the half stays as
        it is; a piece without length on the border is left out.
    """
    low, high = (0.0, _FAR) if half is Half.AHEAD else (-_FAR, 0.0)
    owners: list[int] = []
    pieces: list[Float] = []
    for row, (kind, points) in enumerate(zip(kinds, polylines, strict=True)):
        x = half.value * points[:, 0]
        if x.min() >= 0.0 and x.max() > 0.0:
            parts = [points]
        elif x.max() <= 0.0:
            parts = []
        elif ElementKind(kind).is_ring and len(points) >= 3:
            parts = _cut_ring(points, shapely.box(low, -_FAR, high, _FAR))
        else:
            parts = _cut_line(points, x)
        owners += [row] * len(parts)
        pieces += parts
    return np.array(owners, dtype=np.int64), pieces


def _cut_line(points: Float, depth: Float) -> list[Float]:
    """Return the stretches of a line at positive ``depth``, which is ``(k,)`` and linear between the vertices."""
    before, after = depth[:-1], depth[1:]
    crossed = np.flatnonzero(before * after < 0.0)
    share = (before[crossed] / (before[crossed] - after[crossed]))[:, None]
    borders = points[crossed] + share * (points[crossed + 1] - points[crossed])
    vertices = np.insert(points, crossed + 1, borders, axis=0)
    depths = np.insert(depth, crossed + 1, 0.0)
    steps = np.flatnonzero(np.diff(np.concatenate([[False], depths >= 0.0, [False]])))
    runs = zip(steps[::2], steps[1::2], strict=True)
    return [vertices[first:end] for first, end in runs if (depths[first:end] > 0.0).any()]


def _cut_ring(points: Float, area: shapely.Geometry) -> list[Float]:
    found = shapely.get_parts(shapely.intersection(shapely.make_valid(shapely.Polygon(points)), area))
    # A collection may hold multi-part geometries in turn.
    polygons = [part for each in found for part in shapely.get_parts(each) if part.geom_type == "Polygon"]
    return [shapely.get_coordinates(shapely.get_exterior_ring(polygon)) for polygon in polygons]
