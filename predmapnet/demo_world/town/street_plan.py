"""The plan of a town: through streets, side streets, dead ends, and the places where they meet."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import StrEnum

import numpy as np
import shapely
from numpy.random import Generator

from mapfusion.arrays import Float
from predmapnet.demo_world.town.reference_line import ReferenceLine, draw_curvature, grow_line, reverse_and_join

TOWN_CENTRE = np.array([400.0, 400.0])
"""Place of every town in the global frame, metres: all coordinates stay positive."""

REACH = 235.0
"""Through streets leave the town at this distance from its centre, metres."""

SMALLEST_ANGLE = np.radians(34.0)
"""Between two arms of a junction."""


class Rank(StrEnum):
    """Importance of a street."""

    ARTERIAL = "arterial"
    COLLECTOR = "collector"
    LOCAL = "local"
    ALLEY = "alley"


@dataclass
class Street:
    """A street while and after it is planned.

    ``stops`` are its (station, node) in order of station; node -1 where the street leaves the town.
    """

    line: ReferenceLine
    rank: Rank
    stops: list[tuple[float, int]] = field(default_factory=list)


@dataclass(frozen=True)
class Arm:
    """One street leaving a node: +1 along its stations, -1 against them, from ``station`` to ``far``."""

    street: int
    side: int
    station: float
    far: float


@dataclass
class StreetPlan:
    """Streets and the positions ``(n, 2)`` of the nodes where they meet or end."""

    streets: list[Street] = field(default_factory=list)
    nodes: list[Float] = field(default_factory=list)

    def arms(self, node: int) -> list[Arm]:
        """The arms of a node, anticlockwise by heading."""
        found = []
        for index, street in enumerate(self.streets):
            for place, (station, here) in enumerate(street.stops):
                if here != node:
                    continue
                if place + 1 < len(street.stops):
                    found.append(Arm(index, 1, station, street.stops[place + 1][0]))
                if place > 0:
                    found.append(Arm(index, -1, station, street.stops[place - 1][0]))
        return sorted(found, key=lambda arm: self.heading(arm))

    def heading(self, arm: Arm) -> float:
        """Direction in which an arm leaves its node, radians in (-pi, pi]; looked at a few metres out."""
        line = self.streets[arm.street].line
        return float(np.angle(arm.side * np.exp(1j * line.heading(arm.station + arm.side * 6.0))))


def plan_streets(random: Generator) -> StreetPlan:
    """Draw the plan of a town about 400 m across."""
    plan = StreetPlan()
    base = float(random.uniform(-np.pi, np.pi))
    regular = bool(random.random() < 0.5)
    straight = float(random.uniform(0.7, 0.97))
    cross = base + np.pi / 2 + np.radians(float(random.normal(0.0, 4.0 if regular else 20.0)))
    spread = 3.0 if regular else 12.0
    for heading in (base, cross):
        other = cross if heading == base else base
        aside = np.array([np.cos(other), np.sin(other)])
        first = float(random.uniform(-50.0, 50.0))
        places = [first, first + float(random.uniform(70.0, 125.0)), first - float(random.uniform(70.0, 125.0))]
        for number, place in enumerate(places[: int(random.choice([2, 3], p=[0.4, 0.6]))]):
            rank = Rank.ARTERIAL if number == 0 and random.random() < 0.8 else Rank.COLLECTOR
            turned = heading + np.radians(float(random.normal(0.0, spread)))
            curvature = draw_curvature(random, straight, 130.0)
            _lay_through(plan, TOWN_CENTRE + place * aside, turned, curvature, rank)
    wanted = int(random.integers(14, 30))
    for _ in range(wanted * 7):
        if wanted and _lay_side_street(random, plan, regular, straight):
            wanted -= 1
    return plan


def _lay_through(plan: StreetPlan, middle: Float, heading: float, curvature: Float, rank: Rank) -> None:
    """Add a street through the whole town unless it would meet others at a bad angle or too close to a node."""
    half = REACH
    halves = [grow_line(middle, heading + turn, half, curvature * sign) for turn, sign in ((np.pi, -0.5), (0.0, 0.5))]
    line = reverse_and_join(*halves)
    meetings = _meetings(plan, line)
    if meetings is None:
        return
    along = sorted(station for station, _, _ in meetings)
    if any(gap < 26.0 for gap in np.diff(along)):
        return
    for _, street, there in meetings:
        if min((abs(there - station) for station, _ in plan.streets[street].stops), default=99.0) < 26.0:
            return
    _add(plan, Street(line, rank, [(0.0, -1), (line.length, -1)]), meetings)


def _meetings(plan: StreetPlan, line: ReferenceLine) -> list[tuple[float, int, float]] | None:
    """(station on the line, street, station on that street) of all crossings; None where an angle is too small."""
    found = []
    shape = line.shape
    for index, street in enumerate(plan.streets):
        for point in shapely.get_parts(shape.intersection(street.line.shape)):
            if point.is_empty:
                continue
            here, there = shape.project(point.centroid), street.line.shape.project(point.centroid)
            angle = abs(np.angle(np.exp(2j * (line.heading(here) - street.line.heading(there))))) / 2
            if angle < SMALLEST_ANGLE:
                return None
            found.append((here, index, there))
    return found


def _add(plan: StreetPlan, street: Street, meetings: list[tuple[float, int, float]]) -> None:
    """Add a street with new nodes at its meetings."""
    for here, other, there in meetings:
        node = _node_at(plan, plan.streets[other], there)
        street.stops.append((here, node))
    street.stops.sort()
    plan.streets.append(street)


def _node_at(plan: StreetPlan, street: Street, station: float) -> int:
    """The node of a street at a station, a new one unless there is one."""
    for there, node in street.stops:
        if abs(there - station) < 1e-6 and node >= 0:
            return node
    plan.nodes.append(street.line.locate(np.array([station]))[0])
    street.stops.append((station, len(plan.nodes) - 1))
    street.stops.sort()
    return len(plan.nodes) - 1


def _lay_side_street(random: Generator, plan: StreetPlan, regular: bool, straight: float) -> bool:
    """Try to add a street that begins on another one and ends on a third, or blindly."""
    host_index = int(random.integers(len(plan.streets)))
    host = plan.streets[host_index]
    if host.rank is Rank.ALLEY:
        return False
    low, high = (30.0, host.line.length - 30.0) if host.stops[0][1] < 0 else (18.0, host.line.length - 18.0)
    if high <= low:
        return False
    station = float(random.uniform(low, high))
    near = min(host.stops, key=lambda stop: abs(stop[0] - station))
    if abs(near[0] - station) < float(random.uniform(14.0, 42.0)):
        if near[1] < 0 or random.random() < 0.5:
            return False
        station = near[0]
    outward = float(random.choice([-1.0, 1.0]))
    spread = float(random.choice([3.0, 10.0] if regular else [8.0, 28.0]))
    lean = np.radians(np.clip(random.normal(0.0, spread), -52.0, 52.0))
    heading = host.line.heading(station) + outward * np.pi / 2 + lean
    rank = Rank.ALLEY if random.random() < 0.35 else (Rank.LOCAL if random.random() < 0.8 else Rank.COLLECTOR)
    length = float(random.uniform(35.0, 90.0) if rank is Rank.ALLEY else random.uniform(60.0, 230.0))
    start = host.line.locate(np.array([station]))[0]
    line = grow_line(start, heading, length, draw_curvature(random, straight, 45.0))
    node = next((node for there, node in host.stops if abs(there - station) < 1e-6), -1)
    if node >= 0:
        gaps = [abs(np.angle(np.exp(1j * (plan.heading(arm) - heading)))) for arm in plan.arms(node)]
        if len(gaps) > 5 or min(gaps) < np.radians(42.0):
            return False
    ended = _end_of(random, plan, line, host_index)
    if ended is None:
        return False
    line, meetings = ended
    street = Street(line, rank)
    street.stops.append((0.0, _node_at(plan, host, station)))
    if not meetings or meetings[-1][0] < line.length - 1e-6:
        at_rim = np.linalg.norm(line.points[-1] - TOWN_CENTRE) > 190.0
        if not at_rim:
            plan.nodes.append(line.points[-1])
        street.stops.append((line.length, -1 if at_rim else len(plan.nodes) - 1))
    _add(plan, street, meetings)
    return True


def _end_of(
    random: Generator, plan: StreetPlan, line: ReferenceLine, host: int
) -> tuple[ReferenceLine, list[tuple[float, int, float]]] | None:
    """Cut a side street where it ends; None where it has no room."""
    meetings = _meetings(plan, _part(line, 4.0, line.length))
    if meetings is None:
        return None
    meetings = sorted((here + 4.0, other, there) for here, other, there in meetings)
    crossed: list[tuple[float, int, float]] = []
    end = line.length
    for here, other, there in meetings:
        stops = plan.streets[other].stops
        blocked = min(abs(there - station) for station, _ in stops) < float(random.uniform(14.0, 40.0))
        if here < 30.0 or blocked or (crossed and here - crossed[-1][0] < 26.0):
            return None
        crossed.append((here, other, there))
        if random.random() < 0.6:
            end = here
            break
    if end < 32.0 or (crossed and 0.0 < end - crossed[-1][0] < 24.0):
        return None
    if np.abs(line.points[: int(end / 2)] - TOWN_CENTRE).max() > REACH - 10.0:
        return None
    # Not beside another street: away from its own meetings it keeps its distance.
    stations = np.arange(24.0, end, 6.0)
    for here, _, _ in crossed:
        stations = stations[np.abs(stations - here) > 24.0]
    points = shapely.points(line.locate(stations)) if len(stations) else np.array([])
    others = shapely.union_all([street.line.shape for street in plan.streets])
    if len(points) and shapely.distance(points, others).min() < 21.0:
        return None
    return _part(line, 0.0, end), crossed


def _part(line: ReferenceLine, start: float, end: float) -> ReferenceLine:
    """The part of a line between two stations, with stations of its own from 0."""
    stations = np.linspace(start, end, max(2, round((end - start) / 2.0) + 1))
    return ReferenceLine(stations - start, line.locate(stations), line.direction(stations))
