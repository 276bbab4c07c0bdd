"""Rings as grids of signed distances: from a ring to a grid, and from a mean of grids back to an outline."""

from __future__ import annotations

from typing import Any, TypeAlias

import numpy as np
import shapely
from numpy.typing import NDArray

from mapfusion.arrays import Bool, Float, Rows

Grid: TypeAlias = NDArray[np.floating[Any]]

TRUNCATION = 1.5
"""Largest signed distance, metres, so that one wrong ring moves the mean little."""

# Corners of a block: bit 1 at (i, j), 2 at (i + 1, j), 4 at (i + 1, j + 1), 8 at (i, j + 1).
# Sides: 0 between bits 1 and 2, 1 between 2 and 4, 2 between 4 and 8, 3 between 8 and 1.
_SEGMENTS: dict[int, tuple[tuple[int, int], ...]] = {
    1: ((3, 0),),
    2: ((0, 1),),
    3: ((3, 1),),
    4: ((1, 2),),
    5: ((3, 0), (1, 2)),
    6: ((0, 2),),
    7: ((3, 2),),
    8: ((2, 3),),
    9: ((2, 0),),
    10: ((0, 1), (2, 3)),
    11: ((2, 1),),
    12: ((1, 3),),
    13: ((1, 0),),
    14: ((0, 3),),
}


def signed_distance(x: Float, y: Float, ring: Float, counts: Bool | None = None, dtype: type = np.float64) -> Grid:
    """Return the signed distance from cells to a closed ring, metres, positive inside, up to :data:`TRUNCATION`.

    Args:
        x: ``(rows,)``, metres.
        y: ``(columns,)``, metres.
        ring: ``(n + 1, 2)``, closed.
        counts: ``(n,)``, which edges distances are taken to, all if None; the others bound the ring all the same.
        dtype: type of the numbers.
    """
    origin = np.array([x[0], y[0]])
    start, stop = (ring[:-1] - origin).astype(dtype), (ring[1:] - origin).astype(dtype)
    # edges come first, so that the innermost loops are long
    px = (x - origin[0]).astype(dtype)[:, None]
    py = (y - origin[1]).astype(dtype)
    (x0, y0), (x1, y1) = start.T[:, :, None], stop.T[:, :, None]
    # even-odd rule along rows; the abscissa of an edge at height y depends on y alone
    rise = np.where(y1 == y0, dtype(1e-6), y1 - y0)
    crossed = (y0 > py) != (y1 > py)
    abscissa = x0 + (py - y0) / rise * (x1 - x0)
    inside = np.logical_xor.reduce(crossed[:, None] & (px < abscissa[:, None]))
    limit = dtype(TRUNCATION)
    if counts is None:
        counts = np.ones(len(start), dtype=bool)
    if not counts.any():
        return np.asarray(np.where(inside, limit, -limit))
    first, edge = start[counts], (stop - start)[counts]
    square = np.maximum((edge**2).sum(axis=1), dtype(1e-9))[:, None, None]
    ex, ey = edge.T[:, :, None, None]
    dx, dy = px - first[:, 0, None, None], py - first[:, 1, None, None]
    along = ((dx * ex + dy * ey) / square).clip(0, 1)
    nearest = np.sqrt(((dx - along * ex) ** 2 + (dy - along * ey) ** 2).min(axis=0))
    nearest = np.minimum(nearest, limit)
    return np.asarray(np.where(inside, nearest, -nearest))


def positive_areas(values: Float) -> list[shapely.Polygon]:
    """Return the outlines of the areas where a grid is positive (marching squares), outer rings only, largest first.

    ``(0, 0)`` is the centre of the first cell; outside the grid counts as negative.
    """
    grid = np.pad(values, 1, constant_values=min(float(values.min()), 0.0))
    grid = np.where(grid == 0.0, 1e-9, grid)
    inside = grid > 0
    code = inside[:-1, :-1] + 2 * inside[1:, :-1] + 4 * inside[1:, 1:] + 8 * inside[:-1, 1:]
    segments: list[Float] = []
    for case, pairs in _SEGMENTS.items():
        row, column = np.nonzero(code == case)
        if len(row):
            segments.extend(np.stack([_crossing(grid, row, column, side) for side in pair], axis=1) for pair in pairs)
    if not segments:
        return []
    lines = shapely.linestrings(np.concatenate(segments) - 1.0)
    outlines = [shapely.Polygon(polygon.exterior) for polygon in shapely.polygonize(lines).geoms]
    return sorted(outlines, key=lambda polygon: -polygon.area)


def _crossing(grid: Float, row: Rows, column: Rows, side: int) -> Float:
    """Return where the level crosses one side of each block, ``(n, 2)``, computed alike from both neighbours."""
    if side in (0, 2):
        column = column + (side == 2)
        first, second = grid[row, column], grid[row + 1, column]
        return np.stack([row + first / (first - second), column.astype(np.float64)], axis=1)
    row = row + (side == 1)
    first, second = grid[row, column], grid[row, column + 1]
    return np.stack([row.astype(np.float64), column + first / (first - second)], axis=1)
