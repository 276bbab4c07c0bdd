"""Streets of a real road, cut off before its junctions and divided into lanes and parking as one likes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import shapely
from numpy.random import Generator

from mapfusion.arrays import Bool, Float
from mapfusion.geometry import arc_length
from predmapnet.demo_world.town.habits import Habits
from tests.real_roads.road_skeleton import RoadSkeleton, Street

RIM = 12.0
"""Within so many metres of the tile's rim the outline is that of the tile, not of the road."""
SHORTEST_PIECE = 8.0
"""A street with less than this between its junctions, metres, stays bare."""
SHORTEST_STREET = 14.0
"""The same with its junctions."""
LEAST_LANES = 7.6
"""Width, metres, that parking has to leave."""
MOST_LANES = 5


@dataclass(frozen=True)
class StreetLayout:
    """A street with its lanes, seen in the direction of its line.

    Attributes:
        nodes: its ends.
        line: ``(n, 2)`` about every metre along its middle.
        half_width: ``(n,)`` metres.
        begin, end: first and last row of ``line`` outside of junctions.
        is_junction: which ends lie at a junction, not at the rim or a dead end.
        parking: widths of the rows along the right and the left kerb, metres; 0 for none.
        lanes: number of them.
        backward: how many lead against the line; 0 in a one-way street.
        left_hand: traffic keeps to the left.
    """

    nodes: tuple[int, int]
    line: Float
    half_width: Float
    begin: int
    end: int
    is_junction: tuple[bool, bool]
    parking: tuple[float, float]
    lanes: int
    backward: int
    left_hand: bool

    @property
    def stations(self) -> Float:
        """``(n,)`` metres from the beginning of the line."""
        return arc_length(self.line)

    @property
    def tangents(self) -> Float:
        """``(n, 2)`` unit vectors along the line."""
        return _tangents(self.line)

    @property
    def leftward(self) -> Float:
        """``(n, 2)`` unit vectors to the left of the line."""
        return self.tangents[:, ::-1] * [-1.0, 1.0]

    @property
    def width(self) -> float:
        """Usual width from kerb to kerb, metres."""
        return 2.0 * _usual(self.half_width)

    @property
    def parting(self) -> int | None:
        """Number of lanes to the right of the line between opposite directions; None in a one-way street."""
        if self.backward == 0:
            return None
        return self.backward if self.left_hand else self.lanes - self.backward

    def is_forward(self, lane: int) -> bool:
        """True if a lane, counted from the right, leads along the line."""
        return lane >= self.backward if self.left_hand else lane < self.lanes - self.backward

    def offset(self, share: float) -> Float:
        """``(n,)`` metres to the left of the line: 0 is the right edge of the lanes, 1 the left one."""
        right, left = -(self.half_width - self.parking[0]), self.half_width - self.parking[1]
        return right + (left - right) * share

    def beside(self, offset: Float | float) -> Float:
        """The line moved to the left, ``(n, 2)``."""
        return np.asarray(self.line + self.leftward * np.broadcast_to(offset, len(self.line))[:, None])

    def row(self, station: float) -> int:
        """Row of the line at a distance from its beginning."""
        return int(np.clip(np.searchsorted(self.stations, station), 0, len(self.line) - 1))


def street_layouts(
    skeleton: RoadSkeleton, road: shapely.Geometry, habits: Habits, random: Generator
) -> list[StreetLayout]:
    """Draw the layout of every street that is long enough for paint."""
    layouts = (_layout(street, skeleton, road, habits, random) for street in skeleton.streets)
    return [layout for layout in layouts if layout is not None]


def _layout(
    street: Street, skeleton: RoadSkeleton, road: shapely.Geometry, habits: Habits, random: Generator
) -> StreetLayout | None:
    rows = np.flatnonzero(_off_the_rim(street.line, road))
    if len(rows) < SHORTEST_STREET:
        return None
    first, last = int(rows[0]), int(rows[-1])
    line, half_width = street.line[first : last + 1], street.half_width[first : last + 1]
    is_whole = (first == 0, last == len(street.line) - 1)
    is_junction = [skeleton.degree(node) > 1 and whole for node, whole in zip(street.nodes, is_whole, strict=True)]
    stations = arc_length(line)
    begin = _mouth(stations, half_width) if is_junction[0] else 0
    backward_mouth = _mouth(stations[-1] - stations[::-1], half_width[::-1]) if is_junction[1] else 0
    end = len(line) - 1 - backward_mouth
    if end <= begin or stations[end] - stations[begin] < SHORTEST_PIECE:
        return None
    parking, lanes, backward = _draw_lanes(2.0 * _usual(half_width), habits, random)
    return StreetLayout(
        nodes=street.nodes,
        line=line,
        half_width=half_width,
        begin=begin,
        end=end,
        is_junction=(is_junction[0], is_junction[1]),
        parking=parking,
        lanes=lanes,
        backward=backward,
        left_hand=habits.left_hand,
    )


def _draw_lanes(width: float, habits: Habits, random: Generator) -> tuple[tuple[float, float], int, int]:
    """Widths of parking to the right and the left, number of lanes, and number of those that lead back."""
    parking = [0.0, 0.0]
    for side in (0, 1):
        if width - sum(parking) > LEAST_LANES and random.random() < 0.6:
            parking[side] = float(random.uniform(1.9, 2.4))
    free = width - sum(parking)
    one_way = bool(random.random() < (0.7 if free < 5.2 else 0.2))
    lane_width = habits.lane_width + float(random.uniform(0.0, 0.4))
    lanes = int(np.clip(round(free / lane_width), 1 if one_way else 2, MOST_LANES))
    backward = 0 if one_way else int((lanes + random.integers(2)) // 2)
    return (parking[0], parking[1]), lanes, backward


def _off_the_rim(line: Float, road: shapely.Geometry) -> Bool:
    x0, y0, x1, y1 = road.bounds
    return np.asarray((line > [x0 + RIM, y0 + RIM]).all(axis=1) & (line < [x1 - RIM, y1 - RIM]).all(axis=1))


def _usual(half_width: Float) -> float:
    """Half width of a street away from its ends, metres."""
    quarter = len(half_width) // 4
    return float(np.median(half_width[quarter : len(half_width) - quarter]))


def _mouth(stations: Float, half_width: Float) -> int:
    """Row at which a street that begins in a junction has left it: the kerbs run as they do further on."""
    usual = _usual(half_width)
    settled = (half_width < 1.1 * usual + 0.25) & (stations > 0.8 * usual)
    return int(np.argmax(settled)) if settled.any() else len(stations) // 2


def _tangents(line: Float) -> Float:
    tangents = np.gradient(line, axis=0)
    return np.asarray(tangents / np.maximum(np.linalg.norm(tangents, axis=1, keepdims=True), 1e-9))
