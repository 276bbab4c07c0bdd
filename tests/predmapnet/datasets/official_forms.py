"""Forms of ground-truth polylines in the official files that nothing in the package needs line by line."""

from __future__ import annotations

import numpy as np
import shapely

from mapfusion.arrays import Float
from predmapnet.datasets.ground_truth.patch import CLOSED_TOLERANCE, is_closed
from predmapnet.evaluation.frames import SIMPLIFICATION

PADDING = 1e5
"""Fills the rows of an open line's permutations that do not exist; never the nearest."""


def simplified(points: Float) -> Float:
    """Evaluation form: fewer vertices, at most 0.2 m off, topology kept.

    Args:
        points: ``(n, 2)``, metres.

    Returns:
        ``(k, 2) float64``.
    """
    return np.asarray(shapely.get_coordinates(shapely.simplify(shapely.LineString(points), SIMPLIFICATION)))


def permuted(points: Float) -> Float:
    """All orders of points in which a predicted polyline counts as the same element.

    Args:
        points: ``(n, 2)``, *normalised*; a ring has its first point repeated at the end.

    Returns:
        ``(2 * (n - 1), n, 2) float64``. Open: the line, its reverse, then padding. Ring: every start vertex, forwards
        and then backwards.
    """
    count = len(points)
    if not is_closed(points, CLOSED_TOLERANCE):
        result = np.full((2 * (count - 1), count, 2), PADDING)
        result[0], result[1] = points, points[::-1]
        return result
    ring = points[:-1]
    shifts = (np.arange(count - 1)[None] - np.arange(count - 1)[:, None]) % (count - 1)
    both = np.concatenate([ring[shifts], ring[::-1][shifts]])
    return np.concatenate([both, both[:, :1]], axis=1)
