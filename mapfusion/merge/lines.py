"""Lines of several maps made into one set: each stretch is the mean of all maps that have it, by their evidence.

The maps come in a fixed order. The first one's lines are the references. Those of the next are paired with them
stretch by stretch (:mod:`mapfusion.stretches`); what has no partner becomes a reference itself, linked to the line it
goes on from. Only at the end does each station move to the weighted mean of everything that was found beside it, so
that the order of the maps matters to where the stations stand along the line, hardly to where the line lies.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise

import numpy as np
import shapely
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.special import logit

from mapfusion.diff import settle
from mapfusion.elements import ElementKind, MapElement, united
from mapfusion.geometry import arc_length
from mapfusion.ground import inside
from mapfusion.integrate.matching import tangents
from mapfusion.merge.tiles import Piece
from mapfusion.stretches import Pairing, Samples, pair, runs, sample_lines

Float = NDArray[np.float64]
Integer = NDArray[np.int64]
Bool = NDArray[np.bool_]

SPACING = 1.0
"""Distance between the stations of a reference, metres; other maps are sampled twice as densely."""

BLEND_LENGTH = 10.0
"""A step between two stretches that are linked is spread over this distance, metres."""

SHORTEST_LOOP = 20
"""A line of fewer stations is not closed when its ends meet."""

VIEW_LENGTH = 60.0
"""A car sees about this much of a road at a time, metres."""

LOOK_REACH = 8.0
"""What lies within twice this of an element was looked at as often as it, metres."""

LINK_REACH = 2.5
"""A line goes on from a reference if it leaves it this close to the reference's end, metres."""


@dataclass(frozen=True)
class MergeConfig:
    """What is assumed when maps are merged.

    Attributes:
        match_distance: stretches of different maps are one line if they lie this close, metres.
        min_new: a stretch shorter than this beside a known line is noise, metres.
        default_deviation: of a line whose file states none and that one frame saw, metres.
        default_alike: share in the variance of such a line that is the same in all frames of a drive.
        floor_deviation: no map is trusted to be better than this, since its poses err as a whole, metres.
        miss_log_odds: what each frame takes from a line that the drive lacks though it looked there. Less than in one
            drive, since what hides a line in one frame often hides it in the next.
        miss_limit: the most that one map can take.
        hit_log_odds: the most that each frame of a drive that saw a line can add, whatever confidence the file states.
        log_odds_limit: more evidence than this from one map does not make it surer.
        tile, margin: side of a tile, and how far beyond its sides it looks, metres.
        simplify_tolerance: of the finished lines, metres.
        min_length: shorter lines are left out, metres.
        ring_overlap: intersection over union from which two crossings are one.
        max_partners: a map is aligned with at most this many others, those that share most ground.
        max_gap: gaps in the evidence up to this length are bridged, metres.
    """

    match_distance: float = 1.5
    min_new: float = 2.0
    default_deviation: float = 0.4
    default_alike: float = 0.1
    floor_deviation: float = 0.05
    miss_log_odds: float = 0.15
    miss_limit: float = 2.0
    hit_log_odds: float = 1.0
    log_odds_limit: float = 4.0
    tile: float = 200.0
    margin: float = 40.0
    simplify_tolerance: float = 0.05
    min_length: float = 1.0
    ring_overlap: float = 0.25
    max_partners: int = 12
    max_gap: float = 5.0


class Looks:
    """In how many frames a drive has looked at a place, as far as its map tells: as often as it saw what is near.

    Args:
        elements: all that the map has around.
    """

    def __init__(self, elements: Iterable[MapElement]) -> None:
        points, frames = [np.empty((0, 2))], [np.empty(0)]
        for element in elements:
            samples = shapely.get_coordinates(shapely.segmentize(shapely.LineString(element.points), LOOK_REACH))
            points.append(samples)
            frames.append(np.full(len(samples), frames_per_place(element)))
        self._points, self._frames = np.concatenate(points), np.concatenate(frames)
        self._tree = cKDTree(self._points) if len(self._points) else None

    def at(self, points: Float) -> Float:
        """Return the frames for each of ``(n, 2)`` points, metres; one frame where nothing is near."""
        frames = np.ones(len(points))
        if self._tree is not None and len(points):
            distance, nearest = self._tree.query(points, distance_upper_bound=2.0 * LOOK_REACH)
            near = np.isfinite(distance)
            frames[near] = np.maximum(self._frames[nearest[near]], 1.0)
        return frames


def frames_per_place(element: MapElement) -> float:
    """Return in about how many frames each place of an element was seen: a long one is never seen as a whole."""
    size = float(np.linalg.norm(np.ptp(element.points, axis=0)))
    return element.observations * VIEW_LENGTH / (VIEW_LENGTH + size)


@dataclass(frozen=True)
class Contribution:
    """What one map has in a tile.

    Attributes:
        source: number of the map.
        elements: of one kind, metres, corrected.
        ground: what the map speaks of.
        looks: in how many frames the drive looked where.
    """

    source: int
    elements: Sequence[MapElement]
    ground: shapely.Geometry
    looks: Looks


def information(element: MapElement, config: MergeConfig) -> Float:
    """Inverse variance of a line at its vertices, ``(n,)``, 1 / m²: from the file, or from the number of frames."""
    deviation = element.deviation
    if deviation is None:
        alike = config.default_alike + (1.0 - config.default_alike) / max(element.observations, 1)
        deviation = np.full(len(element.points), config.default_deviation * np.sqrt(alike))
    return np.asarray(1.0 / (deviation**2 + config.floor_deviation**2))


def certainty(element: MapElement, config: MergeConfig) -> float:
    """Log-odds that one map gives an element: by its confidence, no more than its frames can bear out."""
    most = min(config.log_odds_limit, config.hit_log_odds * max(element.observations, 1))
    return float(np.clip(logit(np.clip(element.confidence, 1e-3, 1 - 1e-3)), 0.2, most))


def doubt(contribution: Contribution, points: Float, config: MergeConfig) -> Float:
    """Log-odds that a map takes from what it lacks at ``(n, 2)`` points; more, the oftener its drive looked there."""
    taken = np.minimum(config.miss_log_odds * contribution.looks.at(points), config.miss_limit)
    return np.asarray(taken * inside(contribution.ground, points))


@dataclass
class _References:
    """Stations of all references, one array entry each, and what was found beside them."""

    points: Float = field(default_factory=lambda: np.empty((0, 2)))
    line: Integer = field(default_factory=lambda: np.empty(0, dtype=np.int64))
    weight: Float = field(default_factory=lambda: np.empty(0))
    offset: Float = field(default_factory=lambda: np.empty((0, 2)))
    odds: Float = field(default_factory=lambda: np.empty(0))
    evidence: list[Piece] = field(default_factory=list)
    """One per line; only its counts and times are used."""
    links: list[tuple[float, tuple[int, int], tuple[int, int]]] = field(default_factory=list)
    """Gap in metres and two ends ``(line, 0 or -1)`` that are one line in some map."""

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

    def append(self, points: Float, weight: Float, odds: float, evidence: Piece) -> int:
        number = len(self.evidence)
        count = len(points)
        self.points = np.concatenate([self.points, points])
        self.line = np.concatenate([self.line, np.full(count, number)])
        self.weight = np.concatenate([self.weight, weight])
        self.offset = np.concatenate([self.offset, np.zeros((count, 2))])
        self.odds = np.concatenate([self.odds, np.full(count, odds)])
        self.evidence.append(evidence)
        return number


def fuse_lines(kind: ElementKind, contributions: Sequence[Contribution], config: MergeConfig) -> list[Piece]:
    """Fuse the lines of one kind of several maps of one place.

    Args:
        kind: dividers or boundaries.
        contributions: one per map, in an order that does not depend on how the maps were given.
        config: what is assumed.

    Returns:
        The lines of which it is more likely than not that they exist.
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
    chained = _chain(lines, references.links)
    return [part for line in chained for part in _alive(line, config)]


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
        for start, end, found in runs(states):
            rows = slice(first + start, first + end)
            if found:
                nodes.extend(_visited(references, pairing, rows, element, contribution.source))
                continue
            number_of_stations = max(round((end - start - 1) / 2), 1) + 1
            place = np.linspace(rows.start, rows.stop - 1, number_of_stations)
            take = np.round(place).astype(np.int64)
            evidence = Piece(
                kind,
                np.empty((0, 2)),
                np.empty((0, 2)),
                {contribution.source: element.observations},
                element.first_seen,
                element.last_seen,
                element.origins,
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
    for start, stop, line in runs(references.line[partner]):
        nodes.append((line, int(partner[start]), int(partner[stop - 1]), stop - start))
        known = references.evidence[line]
        known.observations[source] = max(known.observations.get(source, 0), element.observations)
        known.first_seen = min(known.first_seen, element.first_seen)
        known.last_seen = max(known.last_seen, element.last_seen)
        known.origins = united([known.origins, element.origins])
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
            references.links.append((gap, (before[0], leave), (after[0], enter)))


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


def _chain(lines: list[Piece], links: list[tuple[float, tuple[int, int], tuple[int, int]]]) -> list[Piece]:
    """Join linked lines end to end; each end once, the closest first."""
    parts: dict[int, Piece] = dict(enumerate(lines))
    ends: dict[tuple[int, int], tuple[int, int]] = {(i, e): (i, e) for i in parts for e in (0, -1)}
    for _, first, second in sorted(links):
        if first not in ends or second not in ends:
            continue
        (one, end), (two, start) = ends[first], ends[second]
        if one == two:
            if len(parts[one].points) >= SHORTEST_LOOP:
                parts[one] = parts[one].closed()
                del ends[first], ends[second]
            continue
        before = parts[one] if end == -1 else parts[one].reversed()
        after = parts[two] if start == 0 else parts[two].reversed()
        del ends[first], ends[second]
        parts[one] = _blended(before, after)
        del parts[two]
        for key, (part, _) in list(ends.items()):
            if part == one:
                ends[key] = (one, 0)
            elif part == two:
                ends[key] = (one, -1)
    return [parts[key] for key in sorted(parts)]


def _blended(before: Piece, after: Piece) -> Piece:
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
    decay_before = np.exp(-np.linalg.norm(before.points - before.points[-1], axis=1) / BLEND_LENGTH)
    decay_after = np.exp(-np.linalg.norm(points - points[0], axis=1) / BLEND_LENGTH)
    return before.with_evidence_of(
        after,
        np.concatenate(
            [before.points + share * decay_before[:, None] * step, points - (1 - share) * decay_after[:, None] * step]
        ),
        np.concatenate([before.values, values]),
    )


def _alive(line: Piece, config: MergeConfig) -> list[Piece]:
    """Return the stretches that more likely exist than not, short gaps bridged."""
    states = settle((line.values[:, 1] > 0.0).astype(np.int64), round(config.max_gap / SPACING))
    return [
        replace(line, points=line.points[a:b], values=line.values[a:b])
        for a, b, alive in runs(states)
        if alive and b - a >= 2
    ]
