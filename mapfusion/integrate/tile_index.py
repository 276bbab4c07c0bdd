"""Index of elements by square tiles, so that a frame touches only its surroundings."""

from __future__ import annotations

import numpy as np

from mapfusion.arrays import Float, Integer

TILE_SIZE = 32.0
"""Side of a tile, metres."""


def _key(cells: Integer) -> Integer:
    return (cells[..., 0] << 32) + cells[..., 1]


class TileIndex:
    """Ids of elements by the tiles that they have a point in."""

    def __init__(self) -> None:
        self._elements: dict[int, set[int]] = {}
        self._tiles: dict[int, set[int]] = {}

    def put(self, element: int, points: Float) -> None:
        """File an element under the tiles of its points ``(n, 2)``, replacing what was known of it."""
        tiles = set(_key(np.floor(points / TILE_SIZE).astype(np.int64)).tolist())
        known = self._tiles.setdefault(element, set())
        if tiles == known:
            return
        for tile in known - tiles:
            self._leave(tile, element)
        for tile in tiles - known:
            self._elements.setdefault(tile, set()).add(element)
        self._tiles[element] = tiles

    def extend(self, element: int, points: Float) -> None:
        """File an element that is known already under the tiles of further points ``(n, 2)``."""
        tiles = set(_key(np.floor(points / TILE_SIZE).astype(np.int64)).tolist())
        for tile in tiles - self._tiles[element]:
            self._elements.setdefault(tile, set()).add(element)
            self._tiles[element].add(tile)

    def remove(self, element: int) -> None:
        """Forget an element."""
        for tile in self._tiles.pop(element):
            self._leave(tile, element)

    def near(self, low: Float, high: Float) -> list[int]:
        """Return the ids with a point in a tile that touches the box ``low`` to ``high``, ascending."""
        first, last = np.floor(low / TILE_SIZE).astype(np.int64), np.floor(high / TILE_SIZE).astype(np.int64)
        x, y = np.meshgrid(np.arange(first[0], last[0] + 1), np.arange(first[1], last[1] + 1))
        keys = _key(np.stack([x.ravel(), y.ravel()], axis=1)).tolist()
        found: set[int] = set().union(*(self._elements.get(key, ()) for key in keys))
        return sorted(found)

    def around(self, points: Float, reach: float) -> set[int]:
        """Return ids with a point in a tile that touches the square of ``reach`` around one of ``(n, 2)`` points."""
        steps = np.linspace(-reach, reach, int(2 * reach // TILE_SIZE) + 2)
        corners = [points + np.array([x, y]) for x in steps for y in steps]
        tiles = set(_key(np.floor(np.concatenate(corners) / TILE_SIZE).astype(np.int64)).tolist())
        return set().union(*(self._elements.get(tile, ()) for tile in tiles))

    def _leave(self, tile: int, element: int) -> None:
        members = self._elements[tile]
        members.discard(element)
        if not members:
            del self._elements[tile]
