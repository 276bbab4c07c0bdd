"""Pairing of the lines of two finished maps, stretch by stretch (used by diff and merge)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from mapfusion.arrays import Bool, Float, Integer
from mapfusion.geometry import arc_length, tangents

NEIGHBOURS = 32
"""Number of samples looked at around each; enough for four lines side by side at the usual spacing."""

SHORT_STRETCH = 1.0
"""Common length at which the mean distance counts double, metres: short stretches must lie closer to win."""


LEAST_DISTANCE = 0.05
"""Mean distance below which lines count as equally close, metres; between those, the longer stretch wins."""


SEAM_SAMPLES = 2
"""Number of samples that two lines may share where one ends and the other begins."""


@dataclass(frozen=True)
class Samples:
    """Points at equal distances along lines, as arrays of equal length.

    Attributes:
        points: ``(n, 2) float64``, metres.
        tangents: ``(n, 2) float64``, unit, along the line.
        line: ``(n,) int64``, which line.
        station: ``(n,) float64``, metres from the line's start.
        spacing: ``(n,) float64``, length of line that a sample stands for, metres.
    """

    points: Float
    tangents: Float
    line: Integer
    station: Float
    spacing: Float

    def __len__(self) -> int:
        return len(self.points)

    def bounds(self, line: int) -> tuple[int, int]:
        """Return first row and past the last of a line."""
        first, stop = np.searchsorted(self.line, [line, line + 1])
        return int(first), int(stop)


def sample_lines(lines: Sequence[Float], spacing: float) -> Samples:
    """Sample lines ``(k, 2)``, metres, about every ``spacing`` metres, both ends included."""
    parts: list[tuple[Float, Float, Float, float]] = []
    for line in lines:
        distance = arc_length(line)
        count = max(round(distance[-1] / spacing), 1) + 1
        at = np.linspace(0.0, distance[-1], count)
        points = np.stack([np.interp(at, distance, line[:, axis]) for axis in range(2)], axis=1)
        parts.append((points, tangents(points), at, distance[-1] / count))
    if not parts:
        return Samples(np.empty((0, 2)), np.empty((0, 2)), np.empty(0, dtype=np.int64), np.empty(0), np.empty(0))
    counts = [len(part[0]) for part in parts]
    return Samples(
        np.concatenate([part[0] for part in parts]),
        np.concatenate([part[1] for part in parts]),
        np.repeat(np.arange(len(parts)), counts),
        np.concatenate([part[2] for part in parts]),
        np.repeat([part[3] for part in parts], counts),
    )


@dataclass(frozen=True)
class Pairing:
    """Partner in a second set for each sample of a first.

    Attributes:
        partner: ``(n,) int64``, row of the second set, -1 for none.
        offset: ``(n, 2) float64``, metres, from the sample across to the partner's line; 0 where there is none.
    """

    partner: Integer
    offset: Float

    @property
    def found(self) -> Bool:
        """``(n,)``, which samples have a partner."""
        return np.asarray(self.partner >= 0)

    @property
    def distance(self) -> Float:
        """``(n,)`` lateral distance, metres, NaN where there is no partner."""
        return np.where(self.found, np.linalg.norm(self.offset, axis=1), np.nan)


def pair(first: Samples, second: Samples, reach: float, angle: float = 30.0) -> Pairing:
    """Pair the samples of two maps; where lines run side by side, each takes one of the other map.

    Pairs of lines are served in the order of their mean lateral distance. A stretch of the second map that one line
    of the first has taken is not free for another, so that two parallel lines are not both found in one.

    Args:
        first, second: lines of one kind of two maps.
        reach: largest lateral distance, metres.
        angle: largest angle between directions (either way), degrees.
    """
    partner = np.full(len(first), -1, dtype=np.int64)
    offset = np.zeros((len(first), 2))
    if len(first) and len(second):
        row, other, across = _candidates(first, second, reach, angle)
        _serve(first, second, row, other, across, partner, offset)
    return Pairing(partner, offset)


def _candidates(first: Samples, second: Samples, reach: float, angle: float) -> tuple[Integer, Integer, Float]:
    """Return rows of both sets and the offset between them: the nearest sample of each line beside each sample."""
    step = float(second.spacing.max()) * 0.75
    count = min(NEIGHBOURS, len(second))
    distance, near = cKDTree(second.points).query(
        first.points, k=count, distance_upper_bound=float(np.hypot(reach, step))
    )
    distance, near = distance.reshape(len(first), count), near.reshape(len(first), count)
    row, column = np.nonzero(np.isfinite(distance))
    other = near[row, column].astype(np.int64)
    order = np.lexsort((distance[row, column], second.line[other], row))
    row, other = row[order].astype(np.int64), other[order]
    nearest = (np.diff(row, prepend=-1) != 0) | (np.diff(second.line[other], prepend=-1) != 0)
    row, other = row[nearest], other[nearest]
    gap = second.points[other] - first.points[row]
    tangent = second.tangents[other]
    along = (gap * tangent).sum(axis=1)
    across = gap - along[:, None] * tangent
    cosine = np.abs((first.tangents[row] * tangent).sum(axis=1))
    keep = (np.linalg.norm(across, axis=1) <= reach) & (np.abs(along) <= step) & (cosine >= np.cos(np.radians(angle)))
    return row[keep], other[keep], across[keep]


def _serve(
    first: Samples, second: Samples, row: Integer, other: Integer, across: Float, partner: Integer, offset: Float
) -> None:
    """Fill ``partner`` and ``offset``, pair of lines by pair of lines, the closest first."""
    if not len(row):
        return
    lines = first.line[row] * (int(second.line.max()) + 1) + second.line[other]
    order = np.argsort(lines, kind="stable")
    row, other, across, lines = row[order], other[order], across[order], lines[order]
    starts = np.flatnonzero(np.append(True, np.diff(lines) != 0))
    stops = np.append(starts[1:], len(lines))
    size = np.linalg.norm(across, axis=1)
    common = np.add.reduceat(first.spacing[row], starts)
    mean = np.add.reduceat(size, starts) / (stops - starts)
    score = (mean + LEAST_DISTANCE) * (1.0 + SHORT_STRETCH / np.maximum(common, 1e-6))
    owner = np.full(len(second), -1, dtype=np.int64)
    for group in np.argsort(score, kind="stable"):
        rows, others = row[starts[group] : stops[group]], other[starts[group] : stops[group]]
        line = first.line[rows[0]]
        blocked = (owner[others] != -1) & (owner[others] != line)
        if np.count_nonzero(blocked) <= SEAM_SAMPLES:
            blocked[:] = False
        free = (partner[rows] < 0) & ~blocked
        taken = rows[free]
        partner[taken] = others[free]
        offset[taken] = across[starts[group] : stops[group]][free]
        owner[others[free]] = line


def equal_runs(values: Integer) -> list[tuple[int, int, int]]:
    """Return ``(start, stop, value)`` of the runs of equal values."""
    if not len(values):
        return []
    new = np.append(True, np.diff(values) != 0)
    starts = np.flatnonzero(new)
    stops = np.append(starts[1:], len(values))
    return list(zip(starts.tolist(), stops.tolist(), values[starts].tolist(), strict=True))


def settle(states: Integer, shortest: int) -> Integer:
    """Return states whose runs of fewer than ``shortest`` samples took the state of their longer neighbour.

    The shortest run goes first. A line that is shorter than that as a whole keeps its most frequent state.
    """
    states = states.copy()
    while True:
        found = equal_runs(states)
        short = [run for run in found if run[1] - run[0] < shortest]
        if not short or len(found) == 1:
            return states
        start, stop, _ = min(short, key=lambda run: run[1] - run[0])
        place = [run[0] for run in found].index(start)
        beside = [found[i] for i in (place - 1, place + 1) if 0 <= i < len(found)]
        states[start:stop] = max(beside, key=lambda run: run[1] - run[0])[2]
