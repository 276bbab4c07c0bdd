"""Maps of a merge, read when they are needed and kept as long as their neighbours are at work."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path

import shapely

from mapfusion.alignment import Landmarks, landmarks
from mapfusion.elements import GlobalMap
from mapfusion.formats.by_suffix import read_map
from mapfusion.georeference import InvertibleGeoreference
from mapfusion.ground import coverage
from mapfusion.merge.corrections import Correction

CACHED_MAPS = 48
"""Number of maps held in memory at a time; neighbouring tiles need the same ones."""


class MapCache:
    """Cache of maps that are read when they are needed.

    Args:
        maps: themselves, or their files.
        plane: of the merge.
    """

    def __init__(self, maps: Sequence[GlobalMap] | Sequence[Path], plane: InvertibleGeoreference | None) -> None:
        self.maps = maps
        self.plane = plane
        self.corrections: dict[int, Correction] = {}
        self.raw = lru_cache(CACHED_MAPS)(self._read)
        self.landmarks = lru_cache(CACHED_MAPS)(self._landmarks)
        self.corrected = lru_cache(CACHED_MAPS)(self._corrected)

    def _read(self, place: int) -> GlobalMap:
        item = self.maps[place]
        return read_map(item, self.plane) if isinstance(item, Path) else item

    def _landmarks(self, place: int) -> Landmarks:
        return landmarks(self.raw(place))

    def _corrected(self, place: int) -> tuple[GlobalMap, shapely.Geometry]:
        """Return a map and its ground, both corrected."""
        raw = self.raw(place)
        ground = coverage(raw, self.plane)
        correction = self.corrections.get(place)
        if correction is None:
            return raw, ground
        return raw.moved(correction.apply), shapely.transform(ground, correction.apply)
