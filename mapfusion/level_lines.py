"""Level lines of a grid (marching squares), vectorised."""

from __future__ import annotations

import numpy as np
import shapely

from mapfusion.arrays import Float, Rows

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


def level_polygons(values: Float, level: float) -> list[shapely.Polygon]:
    """Outline where a grid exceeds a level.

    Args:
        values: ``(rows, columns)``; outside the grid counts as below the level.
        level: value of the outline.

    Returns:
        Polygons with vertices in grid coordinates, ``(0, 0)`` at the centre of the first cell; outer rings only,
        largest first.
    """
    grid = np.pad(values, 1, constant_values=min(float(values.min()), 0.0)) - level
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
