"""Forms of ground-truth polylines in the field: simplified, resampled, normalised, permuted."""

from __future__ import annotations

import numpy as np
import shapely

from mapfusion.arrays import Float
from mapfusion.elements import RegionOfInterest
from mapfusion.geometry import resample
from predmapnet.datasets.ground_truth.patch import CLOSED_TOLERANCE, is_closed

POINTS = 20
SIMPLIFICATION = 0.2
"""Tolerance of evaluation polylines, metres."""
NORMALISATION_EPSILON = 1e-5
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


def resampled(points: Float, count: int = POINTS) -> Float:
    """Training form: ``count`` points at equal distances, both ends included.

    Args:
        points: ``(n, 2)``, metres.
        count: number of points.

    Returns:
        ``(count, 2) float64``; a ring keeps first equal to last.
    """
    return resample(points, count)


def normalised(points: Float, roi: RegionOfInterest) -> Float:
    """Coordinates over the region: 0 at its lower left corner, just under 1 at the opposite one.

    Args:
        points: ``(..., 2)``, metres, ego frame.
        roi: the region.

    Returns:
        ``(..., 2) float64``; may leave [0, 1] by rounding.
    """
    return (points + roi.size / 2) / (roi.size + NORMALISATION_EPSILON)


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
