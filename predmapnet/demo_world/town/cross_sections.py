"""Cross-sections of streets: strips side by side whose widths change along the way."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import StrEnum

import numpy as np
from numpy.random import Generator

from mapfusion.arrays import Float
from predmapnet.demo_world.town.habits import Habits
from predmapnet.demo_world.town.street_plan import Rank
from predmapnet.demo_world.world import LineStyle

ACTIVE = 0.6
"""A strip narrower than this is not there, metres."""

BROAD = (13.0, 22.0)
"""Widths of broad streets from kerb to kerb, metres."""


class Use(StrEnum):
    """Use of a strip."""

    LANE = "lane"
    BUS = "bus"
    CYCLES = "cycles"
    PARKING = "parking"
    EDGE = "edge"
    """Between the outermost lane and the kerb."""
    GAP = "gap"
    """Paint only, hatched where it is wide."""
    TURNS = "turns"
    """A lane in the middle from which both directions turn."""
    RAISED = "raised"
    """A median with kerbs."""


DRIVEN = (Use.LANE, Use.BUS)
PAIRED = (Use.LANE, Use.BUS, Use.CYCLES, Use.TURNS)
"""Strips between which a line is a divider: lanes, whoever may use them."""


@dataclass
class Strip:
    """One strip of a street.

    Attributes:
        use: what it is for.
        direction: of traffic, +1 along the stations, -1 against them, 0 for none.
        width: metres, where nothing changes it.
        changes: (stations, widths added) that are interpolated and add up.
        parked: metres of its width, at the kerb, in which cars are parked without any line.
    """

    use: Use
    direction: int
    width: float
    changes: list[tuple[Float, Float]] = field(default_factory=list)
    parked: float = 0.0

    def widths(self, stations: Float) -> Float:
        """Width at each station, metres, never negative."""
        width = np.full(len(stations), self.width)
        for at, added in self.changes:
            width += np.interp(stations, at, added)
        return np.asarray(np.maximum(width, 0.0))


@dataclass
class CrossSection:
    """The strips of a street and its paint.

    Attributes:
        left: strips from the middle to the left kerb.
        middle: what separates the two sides; more than one where a median has a turning bay beside it.
        right: strips from the middle to the right kerb.
        one_way: both sides go along the stations.
        centre_style, lane_style: paint between the directions and between lanes of one direction.
        solid_before_stop: metres before a stop within which lane lines are solid.
        edge_line: whether a line runs along the kerb.
    """

    left: list[Strip]
    middle: list[Strip]
    right: list[Strip]
    one_way: bool
    centre_style: LineStyle
    lane_style: LineStyle
    solid_before_stop: float
    edge_line: bool

    @property
    def strips(self) -> list[Strip]:
        """All strips from the left kerb to the right kerb."""
        return [*self.left[::-1], *self.middle, *self.right]

    def edges(self, stations: Float) -> Float:
        """Lateral offsets ``(strips + 1, n)`` of the edges of all strips, from the left kerb to the right kerb."""
        widths = np.array([strip.widths(stations) for strip in self.strips])
        left, middle = len(self.left), len(self.middle)
        usual = [sum(strip.width for strip in side) for side in (self.left, self.middle, self.right)]
        # The middle stays where it is, so that the street is balanced where nothing changes.
        centre = (usual[2] - usual[0]) / 2
        top = centre + widths[left : left + middle].sum(axis=0) / 2 + widths[:left].sum(axis=0)
        edges: Float = top - np.concatenate([np.zeros((1, len(stations))), np.cumsum(widths, axis=0)])
        return edges

    @property
    def half_width(self) -> float:
        """Half of the usual width, metres."""
        return sum(strip.width for strip in self.strips) / 2


def draw_section(random: Generator, rank: Rank, habits: Habits) -> CrossSection:
    """Draw the cross-section of a street."""
    if rank is Rank.ALLEY:
        return _draw_alley(random)
    if random.random() < habits.broad_share:
        return _draw_broad(random, habits)
    one_way = bool(random.random() < {Rank.ARTERIAL: 0.08, Rank.COLLECTOR: 0.12, Rank.LOCAL: 0.25}[rank])
    shares = {
        Rank.ARTERIAL: [0.25, 0.55, 0.2],
        Rank.COLLECTOR: [0.7, 0.27, 0.03],
        Rank.LOCAL: [0.97, 0.03, 0.0],
    }[rank]
    right = 1 + int(random.choice(3, p=shares))
    left = right
    if random.random() < (0.1 if rank is Rank.LOCAL else 0.45):
        left = max(1, right + int(random.choice([-1, 1])))
    if one_way:
        left = 0 if right == 1 or random.random() < 0.5 else left
    quiet = rank is Rank.LOCAL and random.random() < habits.unmarked_share
    sides = [
        _draw_side(random, rank, habits, count, direction, quiet, one_way)
        for count, direction in ((left, 1 if one_way else -1), (right, 1))
    ]
    centre_styles = [LineStyle.DOUBLE_SOLID, LineStyle.SOLID, LineStyle.DASHED, LineStyle.SOLID_DASHED]
    weights = [0.5, 0.3, 0.1, 0.1] if habits.centre_colour == "yellow" else [0.1, 0.35, 0.5, 0.05]
    weights = [0.6, 0.35, 0.0, 0.05] if left + right > 2 and habits.centre_colour == "yellow" else weights
    lane_style = LineStyle.SOLID if random.random() < 0.12 else LineStyle.DASHED
    style = lane_style if one_way else centre_styles[random.choice(4, p=weights)]
    return CrossSection(
        left=sides[0],
        middle=[] if one_way else [_draw_middle(random, rank)],
        right=sides[1],
        one_way=one_way,
        centre_style=LineStyle.UNPAINTED if quiet else style,
        lane_style=lane_style,
        solid_before_stop=float(random.choice([0.0, random.uniform(8.0, 40.0)], p=[0.35, 0.65])),
        edge_line=bool(not quiet and random.random() < habits.edge_line_share),
    )


def _draw_broad(random: Generator, habits: Habits) -> CrossSection:
    """A carriageway of 13 to 22 m with cars parked along both kerbs, beside traffic or behind a line."""
    width, parked = float(random.uniform(*BROAD)), float(random.uniform(1.9, 2.6))
    room = width / 2 - parked
    count = 1 if room < 5.4 else 2
    marked = random.random() < 0.5
    sides = []
    for direction in (-1, 1):
        side = [Strip(Use.LANE, direction, room / count) for _ in range(count)]
        if marked:
            side.append(Strip(Use.PARKING, direction, parked))
        else:
            side[-1].width += parked
            side[-1].parked = parked
        sides.append(side)
    styles = [LineStyle.UNPAINTED, LineStyle.DASHED, LineStyle.SOLID, LineStyle.DOUBLE_SOLID]
    return CrossSection(
        left=sides[0],
        middle=[Strip(Use.GAP, 0, 0.0)],
        right=sides[1],
        one_way=False,
        centre_style=styles[random.choice(4, p=[0.12, 0.33, 0.22, 0.33])],
        lane_style=LineStyle.DASHED,
        solid_before_stop=float(random.choice([0.0, random.uniform(8.0, 40.0)])),
        edge_line=bool(random.random() < habits.edge_line_share),
    )


def _draw_alley(random: Generator) -> CrossSection:
    width = float(random.uniform(4.2, 6.5))
    lane = Strip(Use.LANE, 1, width)
    return CrossSection([], [], [lane], True, LineStyle.UNPAINTED, LineStyle.UNPAINTED, 0.0, False)


def _draw_side(
    random: Generator, rank: Rank, habits: Habits, count: int, direction: int, quiet: bool, one_way: bool
) -> list[Strip]:
    """Strips of one side from the middle to the kerb."""
    strips = []
    for _ in range(count):
        width = float(np.clip(random.normal(habits.lane_width, 0.22), 2.6, 4.4))
        strips.append(Strip(Use.LANE, direction, width - (0.3 if quiet else 0.0)))
    parking = random.random() < {Rank.ARTERIAL: 0.25, Rank.COLLECTOR: 0.45, Rank.LOCAL: 0.6}[rank]
    kind = random.random()
    if strips and parking and kind < 0.5:
        strips[-1].parked = float(random.uniform(1.9, 2.4))
        strips[-1].width += strips[-1].parked
    elif parking:
        strips.append(Strip(Use.PARKING, direction, float(random.uniform(1.9, 2.6))))
    elif strips and not quiet and random.random() < 0.12:
        strips[-1].use = Use.BUS
    if not quiet and rank is not Rank.LOCAL and random.random() < 0.22:
        cycles = Strip(Use.CYCLES, direction, float(random.uniform(1.3, 1.9)))
        place = len(strips) - 1 if strips and strips[-1].use is Use.PARKING else len(strips)
        strips.insert(place, cycles)
    if not parking or not strips:
        strips.append(Strip(Use.EDGE, direction, float(random.choice([0.05, random.uniform(0.2, 0.7)]))))
    return strips


def _draw_middle(random: Generator, rank: Rank) -> Strip:
    """Mostly nothing but a line; else a raised median (often narrow), a painted gap, or a lane for turns."""
    shares = {
        Rank.ARTERIAL: [0.55, 0.15, 0.07, 0.12, 0.11],
        Rank.COLLECTOR: [0.82, 0.05, 0.03, 0.06, 0.04],
        Rank.LOCAL: [0.97, 0.02, 0.0, 0.01, 0.0],
    }[rank]
    kind = int(random.choice(5, p=shares))
    if kind == 0:
        return Strip(Use.GAP, 0, 0.0)
    if kind == 1:
        return Strip(Use.RAISED, 0, float(random.uniform(0.6, 1.6)))
    if kind == 2:
        return Strip(Use.RAISED, 0, float(random.uniform(2.0, 6.0)))
    if kind == 3:
        return Strip(Use.GAP, 0, float(random.uniform(0.8, 3.2)))
    return Strip(Use.TURNS, 0, float(random.uniform(3.0, 4.0)))


def ramp(*knots: tuple[float, float]) -> tuple[Float, Float]:
    """Stations and widths of one change, from (station, width added) pairs in any order."""
    ordered = sorted(knots)
    return np.array([station for station, _ in ordered]), np.array([width for _, width in ordered])
