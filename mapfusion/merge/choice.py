"""Choice of the maps that add most, where there are more than are needed.

Ground is divided into cells. One that drives have looked at in ``n`` frames together counts as
``1 + EVIDENCE (1 - exp(-n / KNOWN_FRAMES))``, one that none has looked at as 0: new ground adds most, and after that
more frames where few have looked. The sum over all cells is monotone and submodular, so that taking what adds most,
again and again, reaches at least ``1 - 1/e`` of what the best choice of as many maps does (Nemhauser and others, 1978).
"""

from __future__ import annotations

import heapq
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import shapely

from mapfusion.arrays import Float, Integer
from mapfusion.elements import GlobalMap
from mapfusion.ground import inside
from mapfusion.merge.contribution import Looks

CELL = 5.0
"""Side of a cell, metres."""
KNOWN_FRAMES = 3.0
"""Number of frames that bring 63 % of what evidence can add to a cell."""
EVIDENCE = 0.25
"""The most that evidence adds to a cell, as a share of what its first look does."""


@dataclass(frozen=True)
class LookedAt:
    """Ground that a map looked at.

    Attributes:
        cells: ``(n, 2)``, columns and rows of the cells, each once.
        frames: ``(n,)``, how many frames looked at each.
    """

    cells: Integer
    frames: Float


@dataclass(frozen=True)
class Choice:
    """One map of a choice.

    Attributes:
        name: of the map.
        taken: whether it was taken.
        new_ground: that no map taken before it looked at, square metres; of one left out, none of all that were taken.
        adds: that and what its evidence adds, as if it were ground, square metres.
    """

    name: str
    taken: bool
    new_ground: float
    adds: float


def looked_at(global_map: GlobalMap, ground: shapely.Geometry) -> LookedAt:
    """Return the cells whose middles lie on the ground that a map speaks of (:func:`mapfusion.ground.coverage`)."""
    if ground.is_empty:
        return LookedAt(np.empty((0, 2), dtype=np.int64), np.empty(0))
    low, high = np.floor(np.array(ground.bounds).reshape(2, 2) / CELL).astype(np.int64)
    columns, rows = np.meshgrid(*(np.arange(first, last + 1) for first, last in zip(low, high, strict=True)))
    cells = np.column_stack([columns.ravel(), rows.ravel()])
    cells = cells[inside(ground, (cells + 0.5) * CELL)]
    return LookedAt(cells, Looks(global_map).at((cells + 0.5) * CELL))


def choose(names: Sequence[str], looked: Sequence[LookedAt], most: int) -> list[Choice]:
    """Choose the maps that add most.

    Args:
        names: of the maps; of two that add alike, the earlier one is taken.
        looked: at what each map looked.
        most: how many are taken at most, at least one.

    Returns:
        One entry a map: those taken in the order in which they were, then the others, what would add most first.
    """
    cells = np.concatenate([one.cells for one in looked]) if looked else np.empty((0, 2), dtype=np.int64)
    spots, spot_of = np.unique(cells, axis=0, return_inverse=True)
    own = np.split(spot_of.ravel(), np.cumsum([len(one.cells) for one in looked])[:-1])
    seen = np.zeros(len(spots))

    def added(place: int) -> float:
        before = seen[own[place]]
        gain = np.exp(-before / KNOWN_FRAMES) - np.exp(-(before + looked[place].frames) / KNOWN_FRAMES)
        return float((before == 0.0).sum() + EVIDENCE * gain.sum()) * CELL**2

    def entry(place: int, taken: bool) -> Choice:
        return Choice(names[place], taken, float((seen[own[place]] == 0.0).sum()) * CELL**2, added(place))

    # What a map adds only shrinks as others are taken, so an old figure that is not the largest need not be renewed.
    waiting = [(-added(place), place) for place in range(len(names))]
    heapq.heapify(waiting)
    taken: list[Choice] = []
    while waiting and len(taken) < most:
        _, place = heapq.heappop(waiting)
        now = (-added(place), place)
        if waiting and now > waiting[0]:
            heapq.heappush(waiting, now)
            continue
        taken.append(entry(place, True))
        seen[own[place]] += looked[place].frames
    left = sorted((-added(place), place) for _, place in waiting)
    return taken + [entry(place, False) for _, place in left]
