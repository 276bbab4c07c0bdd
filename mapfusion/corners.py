"""Crossings with the four corners that a person would draw, where those fit the outline."""

from __future__ import annotations

import numpy as np
import shapely

from mapfusion.arrays import Float

SAMPLES = 240
"""Number of places along an outline by which its sides are fitted: enough for the short ones of a long crossing."""

ROUNDED = 0.2
"""Share of a side, at each of its ends, that may be rounded off and does not count in its fit."""

ROUNDS = 3
"""Rounds of fitting; sides then stay as they are to a centimetre."""

TOLERANCE = 1.0
"""Largest distance from the outline to the four sides, metres. The corners themselves may stick out further."""

ROUGH = 0.2
"""Largest distance from an outline that has not four corners to the one that is drawn, metres."""

SHARPEST = 0.3
"""Least sine of the angle between two sides, 17 degrees."""

LEAST_OVERLAP = 0.85
"""Least intersection over union of the outline and the quadrilateral."""


def drawn_outline(outline: shapely.Polygon) -> shapely.Polygon:
    """Return the outline of a crossing as a person would draw it: four corners if they fit, else few.

    Detections round corners off. Each side is the line of least squares through the middle part of what of the outline
    lies next to it, beginning with the smallest rectangle around the outline.
    """
    simple = shapely.simplify(outline, ROUGH)
    corners = shapely.get_coordinates(shapely.oriented_envelope(outline))[:-1]
    if len(corners) != 4:
        return simple
    samples = shapely.get_coordinates(
        shapely.line_interpolate_point(outline.exterior, np.linspace(0, 1, SAMPLES, endpoint=False), normalized=True)
    )
    for _ in range(ROUNDS):
        fitted = _fitted(samples, corners)
        if fitted is None:
            return simple
        corners = fitted
    quadrilateral = shapely.Polygon(corners)
    if not quadrilateral.is_valid or quadrilateral.convex_hull.area > 1.001 * quadrilateral.area:
        return simple
    away = shapely.distance(shapely.points(samples), quadrilateral.exterior).max()
    whole = shapely.buffer(outline, 0)  # An outline may cross itself, which intersections do not take.
    common = shapely.intersection(whole, quadrilateral).area
    overlap = common / (whole.area + quadrilateral.area - common)
    return quadrilateral if away <= TOLERANCE and overlap >= LEAST_OVERLAP else simple


def _fitted(samples: Float, corners: Float) -> Float | None:
    """Return the corners ``(4, 2)`` between the four sides, each fitted to the samples beside it; None if they fail."""
    step = np.roll(corners, -1, axis=0) - corners
    length = np.linalg.norm(step, axis=1)
    along = step / np.maximum(length, 1e-9)[:, None]
    away = samples[:, None] - corners
    share = (away * along).sum(axis=2) / np.maximum(length, 1e-9)
    nearest = np.linalg.norm(away - np.clip(share, 0.0, 1.0)[..., None] * step, axis=2).argmin(axis=1)
    inner = (nearest[:, None] == np.arange(4)) & (np.abs(share - 0.5) <= 0.5 - ROUNDED)
    if (inner.sum(axis=0) < 3).any():
        return None
    weight = inner / inner.sum(axis=0)
    middle = weight.T @ samples
    x, y = np.moveaxis(samples[:, None] - middle, 2, 0)
    angle = 0.5 * np.arctan2(2.0 * (weight * x * y).sum(axis=0), (weight * (x * x - y * y)).sum(axis=0))
    direction = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    before, start = np.roll(direction, 1, axis=0), np.roll(middle, 1, axis=0)
    turn = before[:, 0] * direction[:, 1] - before[:, 1] * direction[:, 0]
    if np.abs(turn).min() < SHARPEST:
        return None
    gap = middle - start
    reach = (gap[:, 0] * direction[:, 1] - gap[:, 1] * direction[:, 0]) / turn
    return np.asarray(start + reach[:, None] * before)
