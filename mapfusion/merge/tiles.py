"""Square tiles: lines cut at their sides, and the parts stitched together again."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace

import numpy as np

from mapfusion.arrays import Float
from mapfusion.elements import ElementKind, Origins, united_origins

SEAM = 1.0
"""Distance up to which two ends on the common side of two tiles are one place, metres."""

SEAM_COSINE = np.cos(np.radians(40.0))
"""Cosine of the largest turn of a line across a side."""

ONE_POINT = 0.1
"""Distance up to which two ends are one point, and a larger turn is allowed, metres."""

ON_SIDE = 1e-6
"""Distance up to which a point lies on a side, metres."""


@dataclass(frozen=True, order=True)
class Tile:
    """Square of the plane.

    Attributes:
        row, column: its place; row counts northwards.
        side: metres.
    """

    row: int
    column: int
    side: float = field(default=200.0, compare=False)

    @property
    def low(self) -> Float:
        """Lower left corner ``(2,)``, metres."""
        return np.array([self.column, self.row]) * self.side

    @property
    def high(self) -> Float:
        """Upper right corner ``(2,)``, metres."""
        return self.low + self.side

    def beyond(self, point: Float) -> Tile | None:
        """Return the neighbour on whose common side a point lies, or None for a point inside."""
        for axis, step in ((0, (0, 1)), (1, (1, 0))):
            if abs(point[axis] - self.high[axis]) < ON_SIDE:
                return Tile(self.row + step[0], self.column + step[1], self.side)
            if abs(point[axis] - self.low[axis]) < ON_SIDE:
                return Tile(self.row - step[0], self.column - step[1], self.side)
        return None


def tiles_of(low: Float, high: Float, side: float) -> list[Tile]:
    """Return the tiles that a box touches, row by row."""
    first, last = np.floor(low / side).astype(int), np.floor(high / side).astype(int)
    return [
        Tile(row, column, side)
        for row in range(int(first[1]), int(last[1]) + 1)
        for column in range(int(first[0]), int(last[0]) + 1)
    ]


def cut_line(points: Float, values: Float, low: Float, high: Float) -> list[tuple[Float, Float]]:
    """Return the parts of a line ``(n, 2)`` inside a box, in its order, and of the values ``(n, k)`` along it.

    Ends lie exactly on the box's sides; a line along the upper sides belongs to the next box.
    """
    inside = ((points >= low) & (points < high)).all(axis=1)
    if inside.all():
        return [(points, values)]
    start, step = points[:-1], np.diff(points, axis=0)
    at = [np.arange(len(points), dtype=np.float64)]
    axes: list[tuple[int, float, Float]] = []
    for axis in range(2):
        for border in (float(low[axis]), float(high[axis])):
            with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
                share = (border - start[:, axis]) / step[:, axis]
            rows = np.flatnonzero((share > 0.0) & (share < 1.0))
            at.append(rows + share[rows])
            axes.append((axis, border, at[-1]))
    stations = np.unique(np.concatenate(at))
    table = np.column_stack([points, values])
    dense = np.stack([np.interp(stations, at[0], table[:, k]) for k in range(table.shape[1])], axis=1)
    for axis, border, crossings in axes:
        dense[np.searchsorted(stations, crossings), axis] = border
    middle = (dense[1:, :2] + dense[:-1, :2]) / 2
    within = ((middle >= low) & (middle < high)).all(axis=1)
    edges = np.flatnonzero(np.diff(np.concatenate([[False], within, [False]]).astype(np.int8)))
    return [
        (dense[first : stop + 1, :2], dense[first : stop + 1, 2:])
        for first, stop in zip(edges[::2], edges[1::2], strict=True)
    ]


@dataclass
class MergedLine:
    """Line of the merged map, whole or cut at a tile's side.

    Attributes:
        kind: divider or boundary.
        points: ``(n, 2)``, metres.
        values: ``(n, 2)``: variance across the line, m², and log-odds of existence; of a cut line ``(n, 3)``: with its
            height, metres, NaN where it is not known.
        observations: frames that saw it, by source.
        first_seen, last_seen: nanoseconds.
        origins: names of the sources, and the ids of the tracks in them.
        name: of the element that it follows.
        paint: as of that element, or of the first one that knows it.
    """

    kind: ElementKind
    points: Float
    values: Float
    observations: dict[int, int]
    first_seen: int
    last_seen: int
    origins: Origins = field(default_factory=dict)
    name: str = ""
    paint: str = ""

    def reversed(self) -> MergedLine:
        """Return it run the other way."""
        return replace(self, points=self.points[::-1], values=self.values[::-1])

    def closed(self) -> MergedLine:
        """Return it led back to its start."""
        points, values = np.vstack([self.points, self.points[:1]]), np.vstack([self.values, self.values[:1]])
        return replace(self, points=points, values=values)

    def joined(self, other: MergedLine) -> MergedLine:
        """Return this line with another put to its end, their common point in the middle."""
        points = np.concatenate([self.points, other.points[1:]])
        values = np.concatenate([self.values, other.values[1:]])
        seam = len(self.points) - 1
        points[seam] = (self.points[-1] + other.points[0]) / 2
        values[seam] = (self.values[-1] + other.values[0]) / 2
        return self.with_evidence_of(other, points, values)

    def with_evidence_of(self, other: MergedLine, points: Float, values: Float) -> MergedLine:
        """Return the line that this one and another are parts of."""
        counts = dict(self.observations)
        for source, count in other.observations.items():
            counts[source] = max(counts.get(source, 0), count)
        first, last = min(self.first_seen, other.first_seen), max(self.last_seen, other.last_seen)
        origins, paint = united_origins([self.origins, other.origins]), self.paint or other.paint
        return MergedLine(self.kind, points, values, counts, first, last, origins, self.name or other.name, paint)


class Stitcher:
    """Stitcher of the lines of tile after tile, in ascending order; gives back lines that are whole.

    Holds only what ends at a side whose other tile is still to come.
    """

    def __init__(self, tiles: list[Tile]) -> None:
        self._waiting = set(tiles)
        self._open: list[MergedLine] = []

    def add(self, tile: Tile, lines: list[MergedLine]) -> Iterator[MergedLine]:
        """Take the lines of one tile, cut at its sides, and yield those that no other tile can lengthen."""
        self._waiting.discard(tile)
        for line in lines:
            self._open.append(self._grown(tile, line))
        still_open = []
        for line in self._open:
            if any(self._touches(line.points[end]) for end in (0, -1)):
                still_open.append(line)
            else:
                yield line
        self._open = still_open

    def rest(self) -> Iterator[MergedLine]:
        """Yield the remaining lines, after the last tile."""
        yield from self._open
        self._open = []

    def _grown(self, tile: Tile, line: MergedLine) -> MergedLine:
        """Return a line joined to the open ones that it continues, at either end."""
        for _ in range(2):
            if tile.beyond(line.points[0]) is not None:
                best: tuple[float, int, bool] | None = None
                for place, other in enumerate(self._open):
                    for turned in (False, True):
                        gap = _seam_gap(other.reversed() if turned else other, line)
                        if gap is not None and (best is None or gap < best[0]):
                            best = (gap, place, turned)
                if best is not None:
                    other = self._open.pop(best[1])
                    line = (other.reversed() if best[2] else other).joined(line)
            line = line.reversed()
        return line

    def _touches(self, point: Float) -> bool:
        """Whether a point lies on a side of a tile that is still to come."""
        if not self._waiting:
            return False
        side = next(iter(self._waiting)).side
        low, high = np.floor((point - ON_SIDE) / side).astype(int), np.floor((point + ON_SIDE) / side).astype(int)
        if (low == high).all():
            return False
        return any(Tile(row, column) in self._waiting for row in (low[1], high[1]) for column in (low[0], high[0]))


def _seam_gap(before: MergedLine, after: MergedLine) -> float | None:
    """Return the distance from the end of one line to the start of another that goes on from it, else None."""
    if before.kind is not after.kind:
        return None
    gap = after.points[0] - before.points[-1]
    distance = float(np.hypot(*gap))
    if distance > SEAM or np.abs(gap).min() > ON_SIDE:
        return None
    leave = before.points[-1] - before.points[max(len(before.points) - 4, 0)]
    arrive = after.points[min(3, len(after.points) - 1)] - after.points[0]
    size = float(np.hypot(*leave) * np.hypot(*arrive))
    # a corner may lie on the side itself; a line beside it may not be taken for the other leg
    straight = -0.5 if distance < ONE_POINT else SEAM_COSINE
    return distance if size > 0 and leave @ arrive > straight * size else None
