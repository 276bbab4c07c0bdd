"""Lines along a street: which are dividers, which are only paint, and how they are painted."""

from __future__ import annotations

from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.random import Generator

from mapfusion.arrays import Float
from predmapnet.demo_world.town.cross_sections import ACTIVE, PAIRED, CrossSection, Strip, Use
from predmapnet.demo_world.town.habits import Habits
from predmapnet.demo_world.town.reference_line import ReferenceLine
from predmapnet.demo_world.world import Divider, LineStyle

SPACING = 1.0
"""Between the places of a street that are looked at, metres."""

SHORTEST = 3.0
"""No line is shorter, metres."""


class _Line(NamedTuple):
    """One place of a line: a divider or only paint, and its looks."""

    is_divider: bool
    style: LineStyle
    colour: str
    opposite: bool


_Runs = dict[int, tuple[list[_Line | None], Float]]
"""Lines by name: what they are at each station, and their lateral offsets there."""


def paint_street(
    random: Generator,
    line: ReferenceLine,
    section: CrossSection,
    start: float,
    end: float,
    stops: tuple[float, float],
    habits: Habits,
) -> tuple[list[Divider], list[Divider]]:
    """Draw the lines of a street between two stations: dividers, and lines that are no dividers.

    A line between two lanes that touch is a divider, however it is painted. What only borders a painted gap, a
    median, parking or the kerb is paint and no more, as in the official truth of Argoverse 2, where a line counts
    when both lanes beside it know each other. ``stops`` are the stations at which traffic stops at the start and at the
    end (-inf or inf: it does not).
    """
    stations = np.linspace(start, end, max(2, round((end - start) / SPACING) + 1))
    runs = _lines_between_strips(section, stations, stops, habits)
    if section.edge_line:
        runs |= _edge_lines(section, stations, habits)
    dividers: list[Divider] = []
    markings: list[Divider] = []
    for kinds, offsets in runs.values():
        for first, last in _stretches(kinds):
            kind, part = kinds[first], slice(first, last + 1)
            assert kind is not None
            if stations[last] - stations[first] < SHORTEST:
                continue
            points = line.locate(stations[part], offsets[part])
            changes = _changes(kinds[part], stations[part])
            drawn = Divider(points, kind.style, kind.colour, kind.opposite, changes)
            (dividers if kind.is_divider else markings).append(drawn)
    return dividers, markings


def _lines_between_strips(section: CrossSection, stations: Float, stops: tuple[float, float], habits: Habits) -> _Runs:
    """Lines between neighbouring strips, by name."""
    edges = section.edges(stations)
    strips = section.strips
    active = -np.diff(edges, axis=0) > ACTIVE
    runs: _Runs = {}
    for column, station in enumerate(stations):
        for upper, lower in pairwise(np.flatnonzero(active[:, column]).tolist()):
            kind = _kind(section, strips[upper], strips[lower], station, stops, habits)
            if kind is None:
                continue
            # Lines keep their name along the street: the lane on the outer side of them, or the middle's left edge.
            name = upper if upper < len(section.left) else 100 + lower
            kinds, offsets = runs.setdefault(name, ([None] * len(stations), np.zeros(len(stations))))
            kinds[column], offsets[column] = kind, (edges[upper + 1, column] + edges[lower, column]) / 2
    return runs


def _edge_lines(section: CrossSection, stations: Float, habits: Habits) -> _Runs:
    """Lines along both kerbs, unless cars are parked there."""
    edges = section.edges(stations)
    runs: _Runs = {}
    for key, row, sign in ((-1, 0, -1.0), (-2, -1, 1.0)):
        if section.strips[row].use is not Use.PARKING:
            colour = habits.centre_colour if section.one_way and row == 0 else "white"
            runs[key] = [_Line(False, LineStyle.SOLID, colour, False)] * len(stations), edges[row] + sign * 0.35
    return runs


def _stretches(kinds: list[_Line | None]) -> list[tuple[int, int]]:
    """First and last index of each stretch that is one divider, or one paint."""
    found = []
    first = 0
    for index in range(1, len(kinds) + 1):
        previous = kinds[first]
        this = kinds[index] if index < len(kinds) else None
        same = previous is not None and this is not None and previous.is_divider == this.is_divider
        if not same:
            if previous is not None and index - 1 > first:
                found.append((first, index - 1))
            first = index
    return found


def _changes(kinds: list[_Line | None], stations: Float) -> tuple[tuple[float, LineStyle], ...]:
    """Changes of the style of paint along a line, metres from its start."""
    found = []
    for index in range(1, len(kinds)):
        before, this = kinds[index - 1], kinds[index]
        if before is not None and this is not None and before.style is not this.style:
            found.append((float(stations[index] - stations[0]), this.style))
    return tuple(found)


def _kind(
    section: CrossSection, left: Strip, right: Strip, station: float, stops: tuple[float, float], habits: Habits
) -> _Line | None:
    """The line between two neighbouring strips at a station, the left one as seen along the stations."""
    pair = {left.use, right.use}
    if left.use in PAIRED and right.use in PAIRED:
        if Use.TURNS in pair:
            return _Line(True, LineStyle.SOLID_DASHED, habits.centre_colour, True)
        if left.direction != right.direction:
            return _Line(True, section.centre_style, habits.centre_colour, True)
        if pair & {Use.BUS, Use.CYCLES}:
            return _Line(True, LineStyle.SOLID, "white", False)
        stop = stops[1] - station if left.direction == 1 else station - stops[0]
        solid = 0.0 <= stop < section.solid_before_stop and section.lane_style is not LineStyle.UNPAINTED
        style = LineStyle.SOLID if solid else section.lane_style
        if section.centre_style is LineStyle.UNPAINTED:
            style = LineStyle.UNPAINTED
        return _Line(True, style, "white", False)
    if Use.GAP in pair:
        opposite = not section.one_way
        return _Line(False, LineStyle.SOLID, habits.centre_colour if opposite else "white", opposite)
    if Use.PARKING in pair and section.edge_line:
        return _Line(False, LineStyle.SOLID, "white", False)
    return None
