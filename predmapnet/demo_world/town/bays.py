"""Changes of a cross-section along its street: turning bays, lanes that begin or end, kerbs that come forward."""

from __future__ import annotations

import numpy as np
from numpy.random import Generator

from predmapnet.demo_world.town.cross_sections import CrossSection, Strip, Use, ramp
from predmapnet.demo_world.town.street_plan import Rank, StreetPlan

SUDDEN = 0.01
"""A change at a node happens within this length, hidden in the junction, metres."""


def shape_street(random: Generator, plan: StreetPlan, index: int, section: CrossSection) -> None:
    """Give a street the bays and tapers that its junctions ask for."""
    street = plan.streets[index]
    if street.rank is Rank.ALLEY:
        return
    if random.random() < 0.5:
        _end_lane(random, section, street.line.length)
    _vary_widths(random, section, street.line.length)
    bulbs = random.random() < 0.35
    for place, (station, node) in enumerate(street.stops):
        if node < 0:
            continue
        before = station - street.stops[place - 1][0] if place > 0 else 0.0
        after = street.stops[place + 1][0] - station if place + 1 < len(street.stops) else 0.0
        sides = _sides_joined(plan, index, node, station)
        if bulbs:
            _bring_kerbs_forward(random, section, station)
        big = street.rank is Rank.ARTERIAL or random.random() < 0.5
        if not section.one_way and big and random.random() < 0.55 and sides:
            _open_left_bays(random, section, station, before, after, sides)
        elif big and random.random() < 0.2:
            _open_right_bay(random, section, station, before, after, sides)


def _sides_joined(plan: StreetPlan, index: int, node: int, station: float) -> set[int]:
    """On which sides of a street others join at a node: 1 left, -1 right; alleys do not count."""
    tangent = plan.streets[index].line.heading(station)
    found = set()
    for arm in plan.arms(node):
        if arm.street != index and plan.streets[arm.street].rank is not Rank.ALLEY:
            turn = np.angle(np.exp(1j * (plan.heading(arm) - tangent)))
            found.add(1 if turn > 0 else -1)
    return found


def _end_lane(random: Generator, section: CrossSection, length: float) -> None:
    """The outermost lane of one side begins or ends somewhere."""
    side = section.left if random.random() < 0.5 else section.right
    lanes = [strip for strip in side if strip.use in (Use.LANE, Use.BUS)]
    if len(lanes) < 2:
        return
    taper = float(random.uniform(12.0, 35.0))
    at = float(random.uniform(0.25, 0.75)) * length
    added = (-lanes[-1].width, 0.0) if random.random() < 0.5 else (0.0, -lanes[-1].width)
    lanes[-1].changes.append(ramp((at, added[0]), (at + taper, added[1])))


def _vary_widths(random: Generator, section: CrossSection, length: float) -> None:
    """Some lanes widen or narrow somewhere along the street."""
    for strip in (*section.left, *section.right):
        if strip.use is Use.LANE and random.random() < 0.4:
            at, over = float(random.random()) * length, float(random.uniform(10.0, 45.0))
            least = max(2.6 - strip.width, -0.8)
            strip.changes.append(ramp((at, 0.0), (at + over, float(random.uniform(least, 1.4)))))


def _bring_kerbs_forward(random: Generator, section: CrossSection, station: float) -> None:
    """Parking strips end before the junction, so that the kerb comes forward."""
    reach, taper = float(random.uniform(9.0, 16.0)), float(random.uniform(1.0, 3.0))
    for strip in (*section.left, *section.right):
        if strip.use is Use.PARKING:
            gone = -strip.width + 0.2
            strip.changes.append(
                ramp(
                    (station - reach - taper, 0.0), (station - reach, gone), (station + reach, gone),
                    (station + reach + taper, 0.0),
                )
            )  # fmt: skip


def _bay_knots(station: float, back: int, hold: float, taper: float, width: float) -> tuple[tuple[float, float], ...]:
    """(Station, width) of a bay that opens over ``taper`` metres and lasts ``hold`` metres up to a node."""
    start = station + back * hold
    return (start + back * taper, 0.0), (start, width), (station, width), (station - back * SUDDEN, 0.0)


def _open_left_bays(
    random: Generator, section: CrossSection, station: float, before: float, after: float, sides: set[int]
) -> None:
    """Bays for left turns before a node, from either direction, in or beside the middle of the street."""
    width = float(random.uniform(2.7, 3.3))
    base = section.middle[len(section.middle) // 2]
    if base.use is Use.TURNS:
        width = base.width
    taken = min(max(base.width - (0.7 if base.use is Use.RAISED else 0.0), 0.0), width)
    for direction, length in ((1, before), (-1, after)):
        taper = float(random.uniform(10.0, 28.0))
        hold = float(random.uniform(12.0, 45.0))
        if length <= 20.0:
            continue
        if length < 2 * (taper + hold) + 14.0:
            hold, taper = max(0.5 * length - 22.0, 4.0), 12.0
        # A car going +1 turns left where an arm joins on the left.
        if direction in sides:
            strip = _left_bay(random, base, (station, -direction, hold, taper, width), taken)
        elif taken < width - 0.1:
            strip = _closing_gap(station, -direction, taper, width - taken)
        else:
            continue
        section.middle.insert(len(section.middle) if direction == 1 else 0, strip)


def _left_bay(random: Generator, base: Strip, bay: tuple[float, int, float, float, float], taken: float) -> Strip:
    """Return a bay for left turns that takes ``taken`` metres from the middle, or opens beside a hatched taper.

    ``bay`` is the station of the node, the direction back from it, and length, taper and width of the bay.
    """
    station, back, hold, taper, width = bay
    strip = Strip(Use.LANE, -back, 0.0)
    if base.use is Use.GAP and taken == 0.0 and random.random() < 0.5:
        opening = float(random.uniform(5.0, 9.0))
        strip.changes.append(ramp(*_bay_knots(station, back, hold, opening, width)))
        start = station + back * hold
        base.changes.append(
            ramp((start + back * (opening + taper), 0.0), (start + back * opening, width), (start, 0.0))
        )
        return strip
    knots = _bay_knots(station, back, hold, taper, width)
    strip.changes.append(ramp(*knots))
    if taken > 0:
        base.changes.append(ramp(*((at, -taken * added / width) for at, added in knots)))
    return strip


def _closing_gap(station: float, away: int, taper: float, width: float) -> Strip:
    """The hatched gap beyond a node at which nothing can be turned into: the space of the bay closes again."""
    gap = Strip(Use.GAP, 0, 0.0)
    gap.changes.append(
        ramp(
            (station - away * SUDDEN, 0.0), (station, width), (station + away * 2.0, width),
            (station + away * (taper + 8.0), 0.0),
        )
    )  # fmt: skip
    return gap


def _open_right_bay(
    random: Generator, section: CrossSection, station: float, before: float, after: float, sides: set[int]
) -> None:
    """A bay for right turns before a node, where an arm joins on that side."""
    direction = 1 if random.random() < 0.5 or section.one_way else -1
    length = before if direction == 1 else after
    side = section.right if direction == 1 else section.left
    if -direction not in sides or length < 50.0 or not side or side[0].use is not Use.LANE:
        return
    width, back = float(random.uniform(2.7, 3.3)), -direction
    hold, taper = float(random.uniform(12.0, 0.5 * length - 12.0)), float(random.uniform(6.0, 18.0))
    bay = Strip(Use.LANE, direction, 0.0)
    knots = _bay_knots(station, back, hold, taper, width)
    bay.changes.append(ramp(*knots))
    outer = side[-1]
    if outer.use is Use.PARKING:
        outer.changes.append(ramp(*((at, -outer.width * added / width) for at, added in knots)))
    side.insert(len(side) - 1 if outer.use in (Use.PARKING, Use.EDGE) else len(side), bay)
