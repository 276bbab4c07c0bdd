"""Report of a merge: the treatment of each map, and short names for map files."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mapfusion.merge.choice import Choice
from mapfusion.merge.corrections import Correction


@dataclass(frozen=True)
class MapStatus:
    """Treatment of one input map.

    Attributes:
        name: of the map.
        correction: how its poses were corrected.
        partners: how many others it was aligned with.
        note: why it was not aligned, empty if it was.
        apart: True for a map that contradicts the others: its elements are in the result as they are, not fused.
    """

    name: str
    correction: Correction
    partners: int
    note: str = ""
    apart: bool = False

    @property
    def shift(self) -> float:
        """Distance by which it was moved, metres."""
        return float(np.linalg.norm(self.correction.shift))


@dataclass(frozen=True)
class MergeReport:
    """Report of a merge.

    Attributes:
        maps: one entry per map that was taken, by name.
        duplicates: names of maps that are the same as another, and were counted once.
        elements, metres: of the result, by label of the kind.
        tiles: how many were fused.
        notes: of the reader: names of maps, and what was repaired, supplied or left out of each.
        choice: which maps were taken, and what the others would have added; empty if all were.
    """

    maps: tuple[MapStatus, ...]
    duplicates: tuple[str, ...]
    elements: dict[str, int]
    metres: dict[str, float]
    tiles: int
    notes: tuple[tuple[str, str], ...] = ()
    choice: tuple[Choice, ...] = ()


def short_names(paths: Sequence[Path]) -> list[str]:
    """Return names of files: their stems, with as many folders before as it takes to tell them apart.

    The same map in two formats is told apart by the endings; ValueError if the same file is given twice.
    """
    deepest = max((len(path.parts) for path in paths), default=0)
    names: list[str] = []
    for with_ending in (False, True):
        for depth in range(1, deepest + 1):
            lasts = [path.name if with_ending else path.stem for path in paths]
            names = ["/".join((*path.parts[-depth:-1], last)) for path, last in zip(paths, lasts, strict=True)]
            if len(set(names)) == len(names):
                return names
    if not paths:
        return []
    raise ValueError(f"a map is given twice: {', '.join(sorted({n for n in names if names.count(n) > 1}))}")


def notes_of_copies(maps: Iterable[tuple[str, str]]) -> tuple[tuple[str, str], ...]:
    """Return a note for each map that is an edited copy of another.

    The maps are names and digests of what they say of their making, the moment included.
    """
    first: dict[str, str] = {}
    notes = []
    for name, origin in maps:
        other = first.setdefault(origin, name)
        if other != name:
            notes.append((name, f"it is a copy of {other} that was edited; both count, as if two drives had seen it"))
    return tuple(notes)
