"""A town: from a seed to the vector map that all ground truth is derived from."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import shapely
from numpy.random import Generator

from predmapnet.demo_world.town.assembly import assemble
from predmapnet.demo_world.town.bays import shape_street
from predmapnet.demo_world.town.cross_sections import CrossSection, Use, draw_section
from predmapnet.demo_world.town.crossings import cross_street, draw_crossings
from predmapnet.demo_world.town.furnishing import furnish
from predmapnet.demo_world.town.habits import Habits
from predmapnet.demo_world.town.junctions import ArmReach, Junction, build_junction
from predmapnet.demo_world.town.lane_graph import Carriageway
from predmapnet.demo_world.town.medians import painted_gaps
from predmapnet.demo_world.town.mirror import mirrored_map
from predmapnet.demo_world.town.reference_line import ReferenceLine
from predmapnet.demo_world.town.road_paint import paint_street
from predmapnet.demo_world.town.street_plan import Rank, Street, StreetPlan, plan_streets
from predmapnet.demo_world.town.works import Stretch, Works, spaced
from predmapnet.demo_world.world import LineStyle, VectorMap


@dataclass(frozen=True)
class Town:
    """A vector map and the lanes that routes follow.

    Attributes:
        vector_map: what is true about the road.
        carriageways: lanes by stretch and direction, as they were built, for right-hand traffic.
        surface: the whole paved surface without islands, likewise. With left-hand traffic the map is their reflection.
    """

    vector_map: VectorMap
    carriageways: tuple[Carriageway, ...]
    surface: shapely.Geometry


def build_town(seed: int, attempt: int = 0) -> Town:
    """Build a town of roughly 400 x 400 m. The same seed and attempt give the same town."""
    random = np.random.default_rng([0x746F776E32, seed, attempt])
    habits = Habits.draw(random)
    plan = plan_streets(random)
    sections = [draw_section(random, street.rank, habits) for street in plan.streets]
    for index, section in enumerate(sections):
        shape_street(random, plan, index, section)
    junctions = [build_junction(random, plan, sections, node) for node in range(len(plan.nodes))]
    works = Works()
    reaches: dict[tuple[int, float, int], ArmReach] = {}
    for junction in junctions:
        works.paved.append(junction.surface)
        works.islands += junction.islands
        _cross_junction(random, plan, sections, junction, habits, works)
        for reach in junction.reaches:
            reaches[reach.arm.street, reach.arm.station, reach.arm.side] = reach
    stretches = _stretches(plan, reaches)
    for stretch in stretches:
        line, section = plan.streets[stretch.street].line, sections[stretch.street]
        stations = spaced(stretch.start, stretch.end)
        edges = section.edges(stations)
        works.paved.append(line.band(stations, edges[-1], edges[0]))
    by_street = [[stretch for stretch in stretches if stretch.street == index] for index in range(len(plan.streets))]
    for index, own in enumerate(by_street):
        furnish(random, plan, sections[index], own, habits, works)
    for index, own in enumerate(by_street):
        _paint(random, plan.streets[index], sections[index], own, habits, works)
    vector_map, surface = assemble(plan, sections, stretches, habits, works)
    if habits.left_hand:
        vector_map = mirrored_map(vector_map)
    return Town(vector_map, tuple(works.carriageways), surface)


def _stretches(plan: StreetPlan, reaches: dict[tuple[int, float, int], ArmReach]) -> list[Stretch]:
    found = []
    for index, street in enumerate(plan.streets):
        for (start, first), (end, last) in zip(street.stops[:-1], street.stops[1:], strict=True):
            pair = (reaches.get((index, start, 1)), reaches.get((index, end, -1)))
            found.append(Stretch(index, start, end, (first, last), pair))
    return found


def _cross_junction(
    random: Generator, plan: StreetPlan, sections: list[CrossSection], junction: Junction, habits: Habits, works: Works
) -> None:
    """Draw the crossings of a junction and decide where cars stop and lines end."""
    crossings = draw_crossings(random, plan, sections, junction, habits)
    for index, reach in enumerate(junction.reaches):
        arm = reach.arm
        line = plan.streets[arm.street].line
        is_alley = plan.streets[arm.street].rank is Rank.ALLEY
        room = abs(arm.far - arm.station)
        if len(junction.reaches) == 1 or (junction.is_minor and not is_alley):
            continue
        reach.stop = reach.clear + float(random.uniform(-1.0, 1.5))
        crossing = crossings.get(index)
        if crossing is not None:
            works.crossings.append(crossing)
            corners = shapely.points(shapely.get_coordinates(crossing.polygon)[:-1])
            along = arm.side * (shapely.line_locate_point(line.shape, corners) - arm.station)
            reach.stop = float(along.max()) + float(random.uniform(0.3, 2.0 if random.random() < 0.65 else 5.5))
        reach.stop = max(min(reach.stop, 0.47 * room), 1.0)
        kind = random.random()
        gap = random.uniform(0.1, 1.2) if kind < 0.5 else random.uniform(1.2, 7.0 if kind < 0.8 else 18.0)
        reach.paint = reach.stop + min(float(gap), 0.2 * room)
        if not is_alley and random.random() < (habits.stop_line_share if crossing else habits.bare_stop_share):
            _stop_line(line, sections[arm.street], reach, works)


def _stop_line(line: ReferenceLine, section: CrossSection, reach: ArmReach, works: Works) -> None:
    """A bar over all lanes that arrive at a junction."""
    arm = reach.arm
    near = arm.station + arm.side * (reach.stop + 0.1)
    stations = np.sort([near, near + arm.side * 0.45])
    edges = section.edges(stations)
    arriving = [
        row
        for row, strip in enumerate(section.strips)
        if strip.direction == -arm.side and strip.use in (Use.LANE, Use.BUS) and edges[row, 0] - edges[row + 1, 0] > 2.0
    ]
    if arriving:
        bar = line.band(stations, edges[arriving[-1] + 1] + 0.2, edges[arriving[0]] - 0.2)
        if bar.is_valid:
            works.stop_lines.append(bar)
            reach.stop += 0.6
            reach.paint = max(reach.paint, reach.stop)


def _paint(
    random: Generator, street: Street, section: CrossSection, stretches: list[Stretch], habits: Habits, works: Works
) -> None:
    """Paint one street; lines run on where only alleys join it."""
    if street.rank is Rank.ALLEY:
        return
    runs: list[list[float]] = []
    for stretch in stretches:
        (begin, finish), stops = stretch.inner("paint"), stretch.inner("stop")
        if runs and abs(runs[-1][1] - begin) < 1e-6:
            runs[-1][1], runs[-1][3] = finish, stops[1]
        else:
            runs.append([begin, finish, *stops])
    for begin, finish, first_stop, last_stop in runs:
        cuts = [begin, finish]
        if finish - begin > 45.0 and random.random() < 0.22:
            cuts = _cross_midway(random, section, street.line, begin, finish, habits, works)
        for start, end in zip(cuts[0::2], cuts[1::2], strict=True):
            if end - start < 4.0:
                continue
            stops = (first_stop if start == begin else start, last_stop if end == finish else end)
            dividers, markings = paint_street(random, street.line, section, start, end, stops, habits)
            works.dividers += dividers
            works.markings += markings
            if section.centre_style is not LineStyle.UNPAINTED:
                works.hatchings += painted_gaps(random, street.line, section, start, end, habits)


def _cross_midway(
    random: Generator,
    section: CrossSection,
    line: ReferenceLine,
    begin: float,
    finish: float,
    habits: Habits,
    works: Works,
) -> list[float]:
    """Stations between which lines run where a crossing between junctions was added, if one has room."""
    station = float(random.uniform(begin + 18.0, finish - 18.0))
    stations = spaced(station - 12.0, station + 12.0)
    edges = section.edges(stations)
    crossing = cross_street(random, line, line.band(stations, edges[-1], edges[0]), station, habits)
    place = shapely.Point(line.locate(np.array([station]))[0])
    if crossing is None or any(other.polygon.distance(place) < 15.0 for other in works.crossings):
        return [begin, finish]
    works.crossings.append(crossing)
    corners = shapely.points(shapely.get_coordinates(crossing.polygon)[:-1])
    along = shapely.line_locate_point(line.shape, corners)
    gap = float(random.choice([0.3, 1.0, 4.0]))
    return [begin, float(along.min()) - gap, float(along.max()) + gap, finish]
