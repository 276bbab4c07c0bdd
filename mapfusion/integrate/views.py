"""Views: how often the car has looked where, the evidence against elements that it did not see there."""

from __future__ import annotations

from typing import TypeAlias

import numpy as np
import shapely
from numpy.typing import NDArray

from mapfusion.arrays import Float
from mapfusion.elements import FrameMap, RegionOfInterest
from mapfusion.ground import ground_within
from mapfusion.integrate.config import IntegratorConfig

TileKey: TypeAlias = tuple[int, int]

TILE_CELLS = 64
"""Cells of one metre along each side of a tile."""


SHADOW_RIM = 0.5
"""Width of the rim of visible ground in which a missing detection means nothing, metres."""


def clearly_visible(frame_map: FrameMap) -> shapely.Geometry | None:
    """Return the ground of a frame that could be seen, clear of its rim, ego frame; None where all of the ROI could."""
    if frame_map.visible is None:
        return None
    ground = shapely.buffer(ground_within(frame_map.visible), -SHADOW_RIM, quad_segs=1)
    shapely.prepare(ground)
    return ground


def view_weight(
    points_ego: Float, roi: RegionOfInterest, config: IntegratorConfig, visible: shapely.Geometry | None = None
) -> Float:
    """Return the weight of a missing detection, 0 to 1, at points ``(..., 2)``, metres, ego frame.

    It is 0 outside the ROI, at its rim, and where nothing could be seen (outside ``visible``; None for no such place).
    """
    x, y = points_ego[..., 0], points_ego[..., 1]
    inside = (np.abs(x) < roi.length / 2 - config.rim) & (np.abs(y) < roi.width / 2 - config.rim)
    if visible is not None:
        inside = inside & shapely.contains_xy(visible, x, y)
    far = (np.hypot(x, y) - config.view_full) / (config.view_far - config.view_full)
    weight = 1.0 - (1.0 - config.view_floor) * np.clip(far, 0.0, 1.0)
    return np.where(inside, weight, 0.0)


class ViewGrid:
    """Sum of the view weights of all frames per cell of one square metre, in tiles that appear on demand."""

    side = TILE_CELLS

    def __init__(self, config: IntegratorConfig) -> None:
        self.config = config
        self.tiles: dict[TileKey, NDArray[np.float32]] = {}

    def add(self, ego_to_global: Float, roi: RegionOfInterest, visible: shapely.Geometry | None = None) -> None:
        """Count one frame that looked at a region, of which ``visible`` (ego frame; None for all) could be seen."""
        rotation, origin = ego_to_global[:2, :2], ego_to_global[:2, 3]
        reach = np.abs(rotation) @ (roi.size / 2)
        low = np.floor(origin - reach).astype(int)
        high = np.floor(origin + reach).astype(int) + 1
        x = np.arange(low[0], high[0]) + 0.5 - origin[0]
        y = np.arange(low[1], high[1]) + 0.5 - origin[1]
        centres = np.stack(
            [
                x[:, None] * rotation[0, 0] + y[None, :] * rotation[1, 0],
                x[:, None] * rotation[0, 1] + y[None, :] * rotation[1, 1],
            ],
            axis=-1,
        )
        weight = view_weight(centres, roi, self.config, visible)
        for row in range(low[0] // TILE_CELLS, (high[0] - 1) // TILE_CELLS + 1):
            for column in range(low[1] // TILE_CELLS, (high[1] - 1) // TILE_CELLS + 1):
                corner = np.array([row, column]) * TILE_CELLS
                start, stop = np.maximum(corner, low), np.minimum(corner + TILE_CELLS, high)
                tile = self.tiles.get((row, column))
                if tile is None:
                    tile = self.tiles[row, column] = np.zeros((TILE_CELLS, TILE_CELLS), dtype=np.float32)
                a, b = start - corner, stop - corner
                c, d = start - low, stop - low
                tile[a[0] : b[0], a[1] : b[1]] += weight[c[0] : d[0], c[1] : d[1]]

    def at(self, points: Float) -> Float:
        """Return the sum of view weights at ``(n, 2)`` points of the global frame: ``(n,) float64``."""
        cells = np.floor(points).astype(np.int64)
        tiles, inside = np.divmod(cells, TILE_CELLS)
        views = np.zeros(len(points))
        for row, column in set(zip(*tiles.T.tolist(), strict=True)):
            tile = self.tiles.get((row, column))
            if tile is not None:
                here = (tiles[:, 0] == row) & (tiles[:, 1] == column)
                views[here] = tile[inside[here, 0], inside[here, 1]]
        return views
