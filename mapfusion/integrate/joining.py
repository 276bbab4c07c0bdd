"""Joining of elements that are one line: their ends run into each other, and no bare ground was seen between.

A detector that always ends a line at the same place, or two tracks of one line that never were one, leave two lines in
the map where the road has one. They are joined here, when the map is made, so that the evidence stays as it was seen
and the order of frames does not matter.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import cKDTree

from mapfusion.arrays import Float, Integer
from mapfusion.chains import LineEnd, chain_lines
from mapfusion.elements import MapElement, united_origins
from mapfusion.geometry import arc_length
from mapfusion.integrate.config import IntegratorConfig
from mapfusion.integrate.views import ViewGrid
from mapfusion.line_repair import repaired_rows

DIRECTION_LENGTH = 4.0
"""Length over which the direction of an end is taken, metres."""

SHORTEST_CLOSED = 8.0
"""Shorter lines are not closed, metres."""


ONE_VERTEX = 0.3
"""Distance up to which two ends become one vertex of the joined line, metres."""


@dataclass(frozen=True)
class Link:
    """Link of two ends that may be one line; the least cost (metres apart, more where they miss each other) is first.

    ``overlap`` is how far the second one reaches back beside the first, metres.
    """

    cost: float
    ends: tuple[LineEnd, LineEnd]
    overlap: float


@dataclass(frozen=True)
class Ends:
    """Ends of elements (0 the start, -1 the end), as arrays of equal length; crossings and closed lines have none.

    ``tip (n, 2)``, metres, is where each lies, and ``outward (n, 2)`` the unit direction that leads out of it.
    """

    element: Integer
    end: Integer
    kind: Integer
    tip: Float
    outward: Float


def ends_of(elements: Sequence[MapElement]) -> Ends:
    """Return the ends of elements."""
    rows = [
        (number, end)
        for number, element in enumerate(elements)
        if not element.kind.is_ring and (element.points[0] != element.points[-1]).any()
        for end in (0, -1)
    ]
    table = np.array(rows, dtype=np.int64).reshape(-1, 2)
    return Ends(
        table[:, 0],
        table[:, 1],
        np.array([elements[number].kind for number, _ in rows], dtype=np.int64),
        np.array([elements[number].points[end] for number, end in rows]).reshape(-1, 2),
        np.array([_direction(elements[number].points, end) for number, end in rows]).reshape(-1, 2),
    )


def all_ends(several: Sequence[tuple[Sequence[MapElement], Ends]]) -> Ends:
    """Put the ends of several lists of elements together, numbered as if the lists were one."""
    known = [ends for _, ends in several]
    before = np.cumsum([0, *(len(elements) for elements, _ in several)])
    counts = [len(ends.element) for ends in known]
    nothing = ends_of([])
    columns = (
        np.concatenate([getattr(nothing, name), *(getattr(ends, name) for ends in known)])
        for name in ("element", "end", "kind", "tip", "outward")
    )
    element, end, kind, tip, outward = columns
    return Ends(element + np.repeat(before[:-1], counts), end, kind, tip, outward)


def _direction(points: Float, end: int) -> Float:
    """Return the unit direction that leads out of an end."""
    line = points if end == -1 else points[::-1]
    distance = arc_length(line)
    back = max(distance[-1] - DIRECTION_LENGTH, 0.0)
    inner = np.array([np.interp(back, distance, line[:, axis]) for axis in range(2)])
    step = line[-1] - inner
    return np.asarray(step / max(float(np.linalg.norm(step)), 1e-9))


def links_between(elements: Sequence[MapElement], ends: Ends, views: ViewGrid, config: IntegratorConfig) -> list[Link]:
    """Return the pairs of ends that go on in each other, the best first."""
    if len(ends.tip) < 2:
        return []
    first, second = cKDTree(ends.tip).query_pairs(config.join_gap, output_type="ndarray").T
    against = -(ends.outward[first] * ends.outward[second]).sum(axis=1)
    keep = (ends.kind[first] == ends.kind[second]) & (against > np.cos(np.radians(config.join_angle)))
    first, second = first[keep], second[keep]
    axis = ends.outward[first] - ends.outward[second]
    axis /= np.linalg.norm(axis, axis=1, keepdims=True)
    gap = ends.tip[second] - ends.tip[first]
    along = (gap * axis).sum(axis=1)
    aside = np.linalg.norm(gap - along[:, None] * axis, axis=1)
    reach = config.join_aside * (1.0 + np.maximum(along, 0.0) / config.join_gap)
    keep = (along >= -config.join_overlap) & (aside <= reach)
    links = []
    for row in np.flatnonzero(keep).tolist():
        one, two = ((int(ends.element[k]), int(ends.end[k])) for k in (first[row], second[row]))
        ahead = float(along[row])
        if one[0] == two[0] and (ahead < 0.0 or elements[one[0]].length < SHORTEST_CLOSED):
            continue
        if ahead > config.max_gap:
            share = np.linspace(0.0, 1.0, int(ahead) + 2)[1:-1, None]
            if float(np.median(views.at(ends.tip[first[row]] + share * gap[row]))) > config.join_views:
                continue
        links.append(Link(abs(ahead) + 2.0 * float(aside[row]), (one, two), max(-ahead, 0.0)))
    return sorted(links, key=lambda link: (link.cost, link.ends))


def joined_along(elements: Sequence[MapElement], links: Sequence[Link]) -> list[tuple[int, MapElement]]:
    """Join along links, each end once, in their order: the least number in each joined element, ascending, and it."""

    def join(before: MapElement, after: MapElement, number: int) -> MapElement:
        return _joined(before, after, links[number].overlap)

    chains = chain_lines(elements, [link.ends for link in links], _reversed, join, _closed)
    return sorted(((min(chain.members), chain.line) for chain in chains), key=lambda found: found[0])


def _reversed(element: MapElement) -> MapElement:
    return element.with_vertices(np.arange(len(element.points))[::-1])


def _closed(element: MapElement) -> MapElement:
    deviation = element.deviation
    return replace(
        element,
        points=np.vstack([element.points, element.points[:1]]),
        deviation=None if deviation is None else np.append(deviation, deviation[0]),
    )


def _joined(before: MapElement, after: MapElement, overlap: float) -> MapElement:
    """Put two elements end to end; where they overlap, each gives up half."""
    one, one_deviation = _cut_back(_reversed(before), overlap / 2)
    two, two_deviation = _cut_back(after, overlap / 2)
    share = before.length / max(before.length + after.length, 1e-9)
    skip = int(len(two) > 1 and np.linalg.norm(two[0] - one[0]) < ONE_VERTEX)
    points = np.concatenate([one[::-1], two[skip:]])
    rows = repaired_rows(points)
    deviation: Float | None = None
    if one_deviation is not None and two_deviation is not None:
        deviation = np.concatenate([one_deviation[::-1], two_deviation[skip:]])[rows]
    return replace(
        before,
        points=points[rows],
        deviation=deviation,
        confidence=share * before.confidence + (1.0 - share) * after.confidence,
        # frames that saw both are counted in either, so that the sum would count them twice
        observations=max(before.observations, after.observations),
        first_seen=min(before.first_seen, after.first_seen),
        last_seen=max(before.last_seen, after.last_seen),
    ).with_origins(united_origins([before.origins, after.origins]))


def _cut_back(element: MapElement, length: float) -> tuple[Float, Float | None]:
    """Return points and deviations without the first so many metres, but at least the last segment."""
    points, deviation = element.points, element.deviation
    distance = arc_length(points)
    length = min(length, 0.9 * float(distance[-1]))
    if length <= 0.0:
        return points, deviation
    rest = distance > length
    start = [np.interp(length, distance, points[:, axis]) for axis in range(2)]
    cut = np.vstack([start, points[rest]])
    return cut, None if deviation is None else np.append(np.interp(length, distance, deviation), deviation[rest])
