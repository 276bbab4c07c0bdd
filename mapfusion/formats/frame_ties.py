"""Ties of a metric frame to Earth: places in both, for formats that have metres and no reference system."""

from __future__ import annotations

from typing import Any

import numpy as np

from mapfusion.arrays import Float
from mapfusion.elements import GlobalMap
from mapfusion.georeference import Georeference

MEMBER = "predmapnet"
"""Member of such files that holds the provenance, and of their records that holds an element's properties."""

MARGIN = 10.0
"""Ties lie this far outside the map, metres."""


def ties_of(global_map: GlobalMap, georeference: Georeference) -> list[list[float]]:
    """Return nine places around and within a map: x, y (metres), longitude and latitude (degrees) of each."""
    points = np.concatenate(
        [np.zeros((1, 2)) if not len(global_map) else np.zeros((0, 2)), *(e.points for e in global_map)]
    )
    if not np.isfinite(points).all():
        raise ValueError("a point is not finite: it lies outside the globe")
    low, high = np.floor(points.min(axis=0) - MARGIN), np.ceil(points.max(axis=0) + MARGIN)
    grid = np.stack(np.meshgrid(*np.linspace(low, high, 3).T), axis=-1).reshape(-1, 2)
    ties: list[list[float]] = np.column_stack([grid, georeference.to_wgs84(grid)]).tolist()
    return ties


class TiedFrame:
    """Metric frame that is known by ties: a quadratic surface through them, exact to 3 mm over 10 km.

    Args:
        ties: as of :func:`ties_of`.

    Raises:
        ValueError: no such ties.
    """

    def __init__(self, ties: Any) -> None:
        try:
            table = np.array(ties, dtype=np.float64)
        except (TypeError, ValueError):
            table = np.zeros(0)
        if table.ndim != 2 or table.shape[1] != 4 or len(table) < 6 or not np.isfinite(table).all():
            raise ValueError(
                f"its member '{MEMBER}' has no 'ties' that say where on Earth its metres lie; only maps that this "
                "program wrote have them"
            )
        self._middle, self._origin = table[:, :2].mean(axis=0), table[:, 2:].mean(axis=0)
        self._scale = np.maximum(np.abs(table[:, :2] - self._middle).max(axis=0), 1e-6)
        self._surface = np.linalg.lstsq(self._terms(table[:, :2]), table[:, 2:] - self._origin, rcond=None)[0]

    def _terms(self, points: Float) -> Float:
        x, y = ((points - self._middle) / self._scale).T
        return np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=1)

    def to_wgs84(self, points: Float) -> Float:
        """Map ``(n, 2)`` metres to ``(n, 2)`` longitude and latitude, degrees."""
        return np.asarray(self._terms(points) @ self._surface + self._origin)
