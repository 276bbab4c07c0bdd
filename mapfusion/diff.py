"""Differences between two maps of one place, stretch by stretch, however the lines are cut into elements."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum

import numpy as np
import shapely

from mapfusion.alignment import Alignment, align, landmarks
from mapfusion.arrays import Float, Integer
from mapfusion.elements import ElementKind, GlobalMap, MapElement
from mapfusion.geometry import arc_length
from mapfusion.georeference import InvertibleGeoreference
from mapfusion.ground import coverage, inside
from mapfusion.stretches import Pairing, Samples, equal_runs, pair, sample_lines, settle


class Change(StrEnum):
    """Change of a stretch of a line, or of a crossing."""

    ADDED = "added"
    REMOVED = "removed"
    MOVED = "moved"
    UNCHANGED = "unchanged"
    UNOBSERVED = "unobserved"


ORDER = tuple(Change)

SHORTEST_ADDED = 2.0
"""Shorter stretches do not count as added, metres: where lines are cut otherwise, crumbs find no partner."""


@dataclass(frozen=True)
class DiffConfig:
    """Limits of what counts as a change.

    Attributes:
        tolerance: a stretch that lies within this distance of where it was is unchanged, metres.
        sure: it has moved only if it lies farther off than so many standard deviations of the distance, as far as the
            maps state how well they know each line's place.
        reach: one that lies farther off than this is not the same line any more, metres.
        ring_reach: the same for the centre of a crossing, metres.
        ring_overlap: crossings whose intersection over union is at least this are unchanged.
        spacing: distance between the samples of a line, metres.
        min_length: shorter changes are noise of the ends, metres; they go with their neighbours.
        align: bring the new map onto the old one first where that is certain, so that an offset between two drives
            is not taken for a move of every line.
    """

    tolerance: float = 0.5
    sure: float = 1.96
    reach: float = 2.0
    ring_reach: float = 4.0
    ring_overlap: float = 0.6
    spacing: float = 0.5
    min_length: float = 3.0
    align: bool = True


@dataclass(frozen=True)
class Difference:
    """Stretch of a line, or crossing, with its change.

    Attributes:
        change: of this stretch.
        kind: of the element.
        points: ``(n, 2)`` metres; of the new map for what was added or moved, of the old map otherwise.
        length: metres.
        moved_by: median distance between old and new, metres; NaN where there is no counterpart.
        confidence: of the element it belongs to.
    """

    change: Change
    kind: ElementKind
    points: Float
    length: float
    moved_by: float
    confidence: float


@dataclass(frozen=True)
class MapDiff:
    """Differences between two maps, by change and kind, in the order of the maps.

    ``alignment`` is how the new map was brought onto the old one; not ``certain`` where it was left as it is.
    """

    differences: tuple[Difference, ...]
    alignment: Alignment | None

    def metres(self, change: Change, kind: ElementKind) -> float:
        """Length of one change of one kind, metres."""
        return sum(d.length for d in self.differences if d.change is change and d.kind is kind)

    @property
    def changed(self) -> bool:
        """Whether anything was added, removed or moved."""
        return any(d.change in (Change.ADDED, Change.REMOVED, Change.MOVED) for d in self.differences)

    def count(self, change: Change, kind: ElementKind) -> int:
        """Number of stretches or crossings."""
        return sum(d.change is change and d.kind is kind for d in self.differences)

    def moved_by(self, kind: ElementKind) -> float:
        """Median over the length of what moved, metres; NaN where nothing did."""
        moved = [d for d in self.differences if d.change is Change.MOVED and d.kind is kind]
        if not moved:
            return float("nan")
        order = sorted(moved, key=lambda d: d.moved_by)
        passed = np.cumsum([d.length for d in order])
        return order[int(np.searchsorted(passed, passed[-1] / 2))].moved_by


def diff_maps(
    old: GlobalMap,
    new: GlobalMap,
    plane: InvertibleGeoreference | None = None,
    config: DiffConfig | None = None,
) -> MapDiff:
    """Compare two maps in one metric frame, to which ``plane`` leads from the degrees of the ground that they observed.

    Lines are compared sample by sample along their length; a stretch of the new map is the partner of one
    stretch of the old one only, so that a double line that became a single one shows. What lies farther off than
    :attr:`DiffConfig.tolerance` has moved, unless that is within what the maps state of their own uncertainty. What
    the old map has and the new one lacks is removed where the new map's drive has looked
    (:func:`mapfusion.ground.coverage`), else unobserved.
    """
    config = config or DiffConfig()
    ground = coverage(new, plane)
    alignment = None
    if config.align and len(old) and len(new):
        alignment = align(landmarks(new), landmarks(old))
        if alignment.certain:
            new = new.moved(alignment.apply)
            ground = shapely.transform(ground, alignment.apply)
    differences: list[Difference] = []
    for kind in ElementKind:
        compare = _compare_rings if kind.is_ring else _compare_lines
        differences.extend(compare(kind, old.of_kind(kind), new.of_kind(kind), ground, config))
    differences.sort(key=lambda d: (ORDER.index(d.change), int(d.kind)))
    return MapDiff(tuple(differences), alignment)


def _compare_lines(
    kind: ElementKind,
    old: Sequence[MapElement],
    new: Sequence[MapElement],
    ground: shapely.Geometry,
    config: DiffConfig,
) -> list[Difference]:
    before = sample_lines([element.points for element in old], config.spacing)
    after = sample_lines([element.points for element in new], config.spacing)
    forward = pair(before, after, config.reach)
    backward = pair(after, before, config.reach)
    variance = _variance(old, before) + np.append(_variance(new, after), 0.0)[forward.partner]
    limit = np.maximum(config.tolerance, config.sure * np.sqrt(variance))
    near = np.nan_to_num(forward.distance, nan=np.inf) <= limit
    states = np.full(len(before), ORDER.index(Change.UNOBSERVED))
    states[inside(ground, before.points)] = ORDER.index(Change.REMOVED)
    states[forward.found] = ORDER.index(Change.MOVED)
    states[near] = ORDER.index(Change.UNCHANGED)
    found = _stretches(kind, old, before, forward, states, config)
    # of the new map only stretches without a partner in the old one
    states = np.where(backward.found, -1, ORDER.index(Change.ADDED))
    return found + _stretches(kind, new, after, backward, states, config)


def _variance(elements: Sequence[MapElement], samples: Samples) -> Float:
    """Return the variance across the line at each sample, ``(n,)``, m²; 0 where the map does not state it."""
    variance = np.zeros(len(samples))
    for line, element in enumerate(elements):
        if element.deviation is not None:
            rows = slice(*samples.bounds(line))
            variance[rows] = np.interp(samples.station[rows], arc_length(element.points), element.deviation) ** 2
    return variance


def _stretches(
    kind: ElementKind,
    elements: Sequence[MapElement],
    samples: Samples,
    pairing: Pairing,
    states: Integer,
    config: DiffConfig,
) -> list[Difference]:
    """Cut lines where their state changes; states below 0 are left out."""
    result = []
    for line, element in enumerate(elements):
        first, stop = samples.bounds(line)
        steady = settle(states[first:stop], round(config.min_length / config.spacing))
        for start, end, state in equal_runs(steady):
            if state < 0:
                continue
            change = ORDER[state]
            if change is Change.ADDED and samples.spacing[first + start : first + end].sum() < SHORTEST_ADDED:
                continue
            rows = slice(first + start, first + min(end + 1, stop - first))
            if rows.stop - rows.start < 2:
                rows = slice(max(rows.start - 1, first), rows.stop)
            own = slice(first + start, first + end)
            distances = pairing.distance[own]
            counterpart = change in (Change.MOVED, Change.UNCHANGED) and bool(np.isfinite(distances).any())
            points = samples.points[rows] + (pairing.offset[rows] if change is Change.MOVED else 0.0)
            result.append(
                Difference(
                    change,
                    kind,
                    shapely.get_coordinates(shapely.simplify(shapely.LineString(points), 0.02)),
                    float(samples.spacing[own].sum()),
                    float(np.nanmedian(distances)) if counterpart else float("nan"),
                    element.confidence,
                )
            )
    return result


def _compare_rings(
    kind: ElementKind,
    old: Sequence[MapElement],
    new: Sequence[MapElement],
    ground: shapely.Geometry,
    config: DiffConfig,
) -> list[Difference]:
    before, after = [_polygon(element) for element in old], [_polygon(element) for element in new]
    overlap, distance = _ring_matches(before, after, config.ring_reach)
    taken_old: dict[int, int] = {}
    taken_new: set[int] = set()
    for i, j in sorted(overlap, key=lambda key: (-overlap[key], distance[key])):
        if i not in taken_old and j not in taken_new:
            taken_old[i] = j
            taken_new.add(j)
    result = []
    for i, element in enumerate(old):
        partner = taken_old.get(i)
        if partner is None:
            seen = shapely.intersection(before[i], ground).area >= 0.5 * before[i].area
            change, shift, shown = (Change.REMOVED if seen else Change.UNOBSERVED), float("nan"), element
        else:
            shift = distance[i, partner]
            limit = max(config.tolerance, config.sure * float(np.hypot(_spread(element), _spread(new[partner]))))
            same = shift <= limit or overlap[i, partner] >= config.ring_overlap
            change, shown = (Change.UNCHANGED, element) if same else (Change.MOVED, new[partner])
        result.append(Difference(change, kind, shown.points, shown.extent[0], shift, shown.confidence))
    missing = (element for j, element in enumerate(new) if j not in taken_new)
    return result + [
        Difference(Change.ADDED, kind, element.points, element.extent[0], float("nan"), element.confidence)
        for element in missing
    ]


def _spread(ring: MapElement) -> float:
    """Return how well the place of a crossing is known, metres; 0 where the map does not state it."""
    return 0.0 if ring.deviation is None else float(np.median(ring.deviation))


def _polygon(element: MapElement) -> shapely.Geometry:
    return shapely.make_valid(shapely.Polygon(element.points))


def _ring_matches(
    before: Sequence[shapely.Geometry], after: Sequence[shapely.Geometry], reach: float
) -> tuple[dict[tuple[int, int], float], dict[tuple[int, int], float]]:
    """Return intersection over union and distance of the centres of all crossings that may be the same."""
    overlap: dict[tuple[int, int], float] = {}
    distance: dict[tuple[int, int], float] = {}
    if not before or not after:
        return overlap, distance
    rows, others = shapely.STRtree(after).query(before, predicate="dwithin", distance=reach)
    for i, j in zip(rows.tolist(), others.tolist(), strict=True):
        shift = float(shapely.distance(before[i].centroid, after[j].centroid))
        union = float(before[i].union(after[j]).area)
        share = float(before[i].intersection(after[j]).area) / union if union else 0.0
        if shift <= reach or share >= 0.3:
            overlap[i, j], distance[i, j] = share, shift
    return overlap, distance
