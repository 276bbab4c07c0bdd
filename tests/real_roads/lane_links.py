"""Lane paths of made-up streets, and the ways across the junctions between them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import shapely

from mapfusion.arrays import Float
from tests.real_roads.street_layout import StreetLayout

LONGEST_LINK = 70.0
"""Metres across a junction."""
POINTS_PER_LINK = 14
STRAIGHT_ON = 0.8
"""Cosine of the turn up to which a lane goes on in the lane that lies straight ahead; others take the nearest."""
MOST_TURN = -0.5
"""Cosine of the sharpest turn."""


@dataclass(frozen=True)
class _End:
    """An end of a lane at a junction: its street, place and direction of travel."""

    street: int
    point: Float
    direction: Float


def linked_lanes(layouts: Sequence[StreetLayout], road: shapely.Geometry) -> tuple[Float, ...]:
    """Return the middle ``(n, 2)`` of each lane in driving direction, and curves from lane to lane over junctions.

    Args:
        layouts: of all streets.
        road: curves stay on it.
    """
    arriving: dict[int, list[_End]] = {}
    leaving: dict[int, list[_End]] = {}
    paths = []
    for number, layout in enumerate(layouts):
        for lane in range(layout.lanes):
            path = layout.beside(layout.offset((lane + 0.5) / layout.lanes))[layout.begin : layout.end + 1]
            first, last = layout.nodes
            if not layout.is_forward(lane):
                path, first, last = path[::-1], last, first
            paths.append(path)
            leaving.setdefault(first, []).append(_End(number, path[0], _unit(path[3] - path[0])))
            arriving.setdefault(last, []).append(_End(number, path[-1], _unit(path[-1] - path[-4])))
    surface = road.buffer(0.5)
    shapely.prepare(surface)
    for node, ends in arriving.items():
        for end in ends:
            links = (_curve(end, following) for following in _following(end, leaving.get(node, [])))
            paths += [link for link in links if surface.contains(shapely.LineString(link))]
    return tuple(paths)


def _following(end: _End, leaving: Sequence[_End]) -> Iterator[_End]:
    """One lane of each street into which one can go on from the end of a lane."""
    best: dict[int, tuple[float, _End]] = {}
    for other in leaving:
        way = other.point - end.point
        length, turn = float(np.linalg.norm(way)), float(end.direction @ other.direction)
        if turn < MOST_TURN or end.direction @ way < 0 or not 1.0 < length < LONGEST_LINK:
            continue
        sideways = abs(float(end.direction[0] * way[1] - end.direction[1] * way[0]))
        cost = sideways if turn > STRAIGHT_ON else length
        if other.street not in best or cost < best[other.street][0]:
            best[other.street] = (cost, other)
    yield from (other for _, other in best.values())


def _curve(start: _End, end: _End) -> Float:
    """A Bézier curve with the directions of both ends, ``(14, 2)``."""
    reach = 0.45 * float(np.linalg.norm(end.point - start.point))
    u = np.linspace(0.0, 1.0, POINTS_PER_LINK)[:, None]
    first, second = start.point + reach * start.direction, end.point - reach * end.direction
    curve = (1 - u) ** 3 * start.point + 3 * u * (1 - u) ** 2 * first + 3 * u * u * (1 - u) * second + u**3 * end.point
    return np.asarray(curve)


def _unit(vector: Float) -> Float:
    return np.asarray(vector / np.linalg.norm(vector))
