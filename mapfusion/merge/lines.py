"""Fusion of the lines of several maps: each stretch is the mean of all maps that have it, by their evidence.

The maps come in a fixed order. The first one's lines are the references. Those of the next are paired with them
stretch by stretch (:mod:`mapfusion.stretches`); what has no partner becomes a reference itself, linked to the line it
goes on from. Only at the end does each station move to the weighted mean of everything that was found beside it, so
that the order of the maps matters to where the stations stand along the line, hardly to where the line lies.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise

import numpy as np

from mapfusion.arrays import Bool, Float, Integer
from mapfusion.chains import LineEnd, chain_lines
from mapfusion.elements import ElementKind, MapElement, united_origins
from mapfusion.formats.identities import element_name
from mapfusion.geometry import arc_length, tangents
from mapfusion.merge.config import MergeConfig
from mapfusion.merge.contribution import Contribution, certainty, doubt, information
from mapfusion.merge.tiles import MergedLine
from mapfusion.stretches import Pairing, Samples, equal_runs, pair, sample_lines, settle

SPACING = 1.0
"""Distance between the stations of a reference, metres; other maps are sampled twice as densely."""

STEP_LENGTH = 10.0
"""Length over which the step between two linked stretches is spread, metres."""

SHORTEST_LOOP = 20
"""Lines of fewer stations are not closed where their ends meet."""

LINK_REACH = 2.5
"""Largest distance between a reference's end and the place where a line leaves it to go on, metres."""


@dataclass
class _References:
    """Stations of all references, one array entry each, and the sums of the samples beside them."""

    points: Float = field(default_factory=lambda: np.empty((0, 2)))
    line: Integer = field(default_factory=lambda: np.empty(0, dtype=np.int64))
    weight: Float = field(default_factory=lambda: np.empty(0))
    offset: Float = field(default_factory=lambda: np.empty((0, 2)))
    odds: Float = field(default_factory=lambda: np.empty(0))
    evidence: list[MergedLine] = field(default_factory=list)
    """One per line; only its counts and times are used."""
    links: list[tuple[float, tuple[LineEnd, LineEnd]]] = field(default_factory=list)
    """Gap in metres and two ends that are one line in some map."""

    def samples(self) -> Samples:
        direction = np.empty_like(self.points)
        station = np.empty(len(self.points))
        for start, stop in self.spans():
            direction[start:stop] = tangents(self.points[start:stop])
            station[start:stop] = arc_length(self.points[start:stop])
        return Samples(self.points, direction, self.line, station, np.full(len(self.points), SPACING))

    def spans(self) -> list[tuple[int, int]]:
        """First row and past the last of each line."""
        edges = np.searchsorted(self.line, np.arange(len(self.evidence) + 1))
        return list(zip(edges[:-1].tolist(), edges[1:].tolist(), strict=True))

    def append(self, points: Float, weight: Float, odds: float, evidence: MergedLine) -> int:
        number = len(self.evidence)
        count = len(points)
        self.points = np.concatenate([self.points, points])
        self.line = np.concatenate([self.line, np.full(count, number)])
        self.weight = np.concatenate([self.weight, weight])
        self.offset = np.concatenate([self.offset, np.zeros((count, 2))])
        self.odds = np.concatenate([self.odds, np.full(count, odds)])
        self.evidence.append(evidence)
        return number


def fuse_lines(kind: ElementKind, contributions: Sequence[Contribution], config: MergeConfig) -> list[MergedLine]:
    """Fuse the dividers or boundaries of several maps of one place: those lines that more likely exist than not.

    The contributions, one per map, come in an order that does not depend on how the maps were given.
    """
    references = _References()
    hits = [_contribute(references, kind, contribution, config) for contribution in contributions]
    count = len(references.points)
    if not count:
        return []
    weight = np.maximum(references.weight, 1e-9)
    points = references.points + references.offset / weight[:, None]
    odds = references.odds.copy()
    for contribution, hit in zip(contributions, hits, strict=True):
        seen = np.concatenate([hit, np.zeros(count - len(hit), dtype=bool)])
        odds[~seen] -= doubt(contribution, points[~seen], config)
    lines = [
        replace(
            known,
            points=points[start:stop],
            values=np.column_stack([1.0 / weight[start:stop], odds[start:stop]]),
        )
        for (start, stop), known in zip(references.spans(), references.evidence, strict=True)
    ]
    links = [ends for _, ends in sorted(references.links)]
    chains = chain_lines(lines, links, MergedLine.reversed, _blended, _closed)
    return [part for chain in chains for part in _alive(chain.line, config)]


def _contribute(references: _References, kind: ElementKind, contribution: Contribution, config: MergeConfig) -> Bool:
    """Add the lines of one map; returns which stations it has seen, ``(n,)`` over those known afterwards."""
    elements = [element for element in contribution.elements if element.length >= config.min_length]
    samples = sample_lines([element.points for element in elements], SPACING / 2)
    pairing = pair(samples, references.samples(), config.match_distance)
    hit = np.zeros(len(references.points), dtype=bool)
    worth = np.empty(len(samples))
    sure = np.empty(len(samples))
    for number, element in enumerate(elements):
        first, stop = samples.bounds(number)
        worth[first:stop] = np.interp(
            samples.station[first:stop], arc_length(element.points), information(element, config)
        )
        sure[first:stop] = certainty(element, config)
    _average(references, samples, pairing, worth, sure, hit)
    ends = references.spans()
    for number, element in enumerate(elements):
        first, stop = samples.bounds(number)
        nodes: list[tuple[int, int, int, int]] = []  # line, row it is entered at and left at, last sample
        states = settle(pairing.found[first:stop].astype(np.int64), round(config.min_new / SPACING * 2))
        for start, end, found in equal_runs(states):
            rows = slice(first + start, first + end)
            if found:
                nodes.extend(_visited(references, pairing, rows, element, contribution.source))
                continue
            number_of_stations = max(round((end - start - 1) / 2), 1) + 1
            place = np.linspace(rows.start, rows.stop - 1, number_of_stations)
            take = np.round(place).astype(np.int64)
            evidence = MergedLine(
                kind,
                np.empty((0, 2)),
                np.empty((0, 2)),
                {contribution.source: element.observations},
                element.first_seen,
                element.last_seen,
                element.origins,
                element_name(element),
                element.paint,
            )
            base = len(references.points)
            line = references.append(samples.points[take], worth[take], float(sure[rows.start]), evidence)
            ends.append((base, base + len(take)))
            nodes.append((line, base, base + len(take) - 1, 0))
        _link(references, nodes, ends)
    return np.concatenate([hit, np.ones(len(references.points) - len(hit), dtype=bool)])


def _average(references: _References, samples: Samples, pairing: Pairing, worth: Float, sure: Float, hit: Bool) -> None:
    """Add to each station the mean of what one map has beside it, and mark the stations in ``hit``."""
    rows = np.flatnonzero(pairing.found)
    station, count = pairing.partner[rows], len(hit)
    times = np.bincount(station, minlength=count).astype(np.float64)
    columns = np.column_stack([-pairing.offset[rows], worth[rows], sure[rows]])
    if not len(rows):
        return
    sums = np.stack([np.bincount(station, weights=columns[:, k], minlength=count) for k in range(4)], axis=1)
    hit[:] = times > 0
    mean = np.divide(sums, times[:, None], out=np.zeros_like(sums), where=hit[:, None])
    # a station between two that were hit was passed by, too
    inner = np.flatnonzero(~hit[1:-1] & hit[:-2] & hit[2:]) + 1
    inner = inner[(references.line[inner - 1] == references.line[inner + 1])]
    mean[inner] = (mean[inner - 1] + mean[inner + 1]) / 2
    hit[inner] = True
    references.weight += mean[:, 2]
    references.offset += mean[:, :2] * mean[:, 2:3]
    references.odds += mean[:, 3]


def _visited(
    references: _References, pairing: Pairing, rows: slice, element: MapElement, source: int
) -> list[tuple[int, int, int, int]]:
    """Note which references a stretch of an element runs along, in order, and count the sighting there."""
    partner = pairing.partner[rows]
    partner = partner[partner >= 0]
    nodes = []
    for start, stop, line in equal_runs(references.line[partner]):
        nodes.append((line, int(partner[start]), int(partner[stop - 1]), stop - start))
        known = references.evidence[line]
        known.observations[source] = max(known.observations.get(source, 0), element.observations)
        known.first_seen = min(known.first_seen, element.first_seen)
        known.last_seen = max(known.last_seen, element.last_seen)
        known.origins = united_origins([known.origins, element.origins])
        known.paint = known.paint or element.paint
    return nodes


def _link(references: _References, nodes: list[tuple[int, int, int, int]], ends: list[tuple[int, int]]) -> None:
    """Link references that one element runs along one after the other, end to end."""
    for before, after in pairwise(nodes):
        if before[0] == after[0]:
            continue
        leave, enter = _end_near(ends[before[0]], before[2]), _end_near(ends[after[0]], after[1])
        if leave is None or enter is None:
            continue
        end, outward = _end(references.points, ends[before[0]], leave)
        start, backward = _end(references.points, ends[after[0]], enter)
        gap = float(np.linalg.norm(start - end))
        if gap < 2 * LINK_REACH and outward @ backward < -0.5:
            references.links.append((gap, ((before[0], leave), (after[0], enter))))


def _end(points: Float, span: tuple[int, int], end: int) -> tuple[Float, Float]:
    """Return one end of a reference and the unit direction that leads out of it."""
    last = span[0] if end == 0 else span[1] - 1
    inner = min(span[0] + 3, span[1] - 1) if end == 0 else max(span[1] - 4, span[0])
    direction = points[last] - points[inner]
    return points[last], direction / max(float(np.linalg.norm(direction)), 1e-9)


def _end_near(span: tuple[int, int], row: int) -> int | None:
    """Return which end of a reference a station is close to: 0, -1 or None."""
    reach = LINK_REACH / SPACING
    if row - span[0] <= reach and row - span[0] <= span[1] - 1 - row:
        return 0
    return -1 if span[1] - 1 - row <= reach else None


def _closed(line: MergedLine) -> MergedLine | None:
    """Return a line led back to its start, None where it is too short for that."""
    return line.closed() if len(line.points) >= SHORTEST_LOOP else None


def _blended(before: MergedLine, after: MergedLine, _link: int) -> MergedLine:
    """Put two lines end to end; a step across them is spread over both, the less certain one moves more."""
    points = after.points
    direction = before.points[-1] - before.points[max(len(before.points) - 4, 0)]
    # stations of the second that lie beside the first would fold the line back
    ahead = (points[: min(4, len(points) - 2)] - before.points[-1]) @ direction > 0.0
    skip = int(np.argmax(ahead)) if ahead.any() else len(ahead)
    points, values = points[skip:], after.values[skip:]
    tangent = points[min(3, len(points) - 1)] - points[0]
    tangent = tangent / max(float(np.linalg.norm(tangent)), 1e-9)
    gap = points[0] - before.points[-1]
    step = gap - (gap @ tangent) * tangent
    share = before.values[-1, 0] / (before.values[-1, 0] + values[0, 0])
    decay_before = np.exp(-np.linalg.norm(before.points - before.points[-1], axis=1) / STEP_LENGTH)
    decay_after = np.exp(-np.linalg.norm(points - points[0], axis=1) / STEP_LENGTH)
    return before.with_evidence_of(
        after,
        np.concatenate(
            [before.points + share * decay_before[:, None] * step, points - (1 - share) * decay_after[:, None] * step]
        ),
        np.concatenate([before.values, values]),
    )


def _alive(line: MergedLine, config: MergeConfig) -> list[MergedLine]:
    """Return the stretches that more likely exist than not, short gaps bridged."""
    states = settle((line.values[:, 1] > 0.0).astype(np.int64), round(config.max_gap / SPACING))
    return [
        replace(line, points=line.points[a:b], values=line.values[a:b])
        for a, b, alive in equal_runs(states)
        if alive and b - a >= 2
    ]
