"""A town: from a seed to the vector map that all ground truth is derived from."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
import shapely
from numpy.random import Generator
from numpy.typing import NDArray
from shapely import Polygon

from predmapnet.demo_world.town.bays import shape_street
from predmapnet.demo_world.town.cross_sections import CrossSection, Use, draw_section
from predmapnet.demo_world.town.crossings import cross_street, draw_crossings
from predmapnet.demo_world.town.habits import Habits
from predmapnet.demo_world.town.junctions import ArmReach, Junction, build_junction
from predmapnet.demo_world.town.kerbside import build_lay_bys, build_openings
from predmapnet.demo_world.town.lane_graph import Carriageway, lanes_between
from predmapnet.demo_world.town.medians import median_islands, painted_gaps
from predmapnet.demo_world.town.mirror import mirrored_map
from predmapnet.demo_world.town.reference_line import ReferenceLine
from predmapnet.demo_world.town.road_paint import paint_street
from predmapnet.demo_world.town.street_plan import Rank, StreetPlan, plan_streets
from predmapnet.demo_world.world import Crossing, Divider, Hatching, LineStyle, VectorMap

Float = NDArray[np.float64]

UNPAINTED_SHARE = 0.02
"""Of the length of all dividers: lanes that are known to be two though no line says so."""


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


@dataclass
class _Works:
    """What has been built so far."""

    paved: list[shapely.Geometry] = field(default_factory=list)
    islands: list[Polygon] = field(default_factory=list)
    crossings: list[Crossing] = field(default_factory=list)
    dividers: list[Divider] = field(default_factory=list)
    markings: list[Divider] = field(default_factory=list)
    hatchings: list[Hatching] = field(default_factory=list)
    parking: list[Polygon] = field(default_factory=list)
    stop_lines: list[Polygon] = field(default_factory=list)
    lanes: list[tuple[Polygon, Float]] = field(default_factory=list)
    grass: list[Polygon] = field(default_factory=list)
    segments: list[shapely.Geometry] = field(default_factory=list)
    carriageways: list[Carriageway] = field(default_factory=list)


@dataclass(frozen=True)
class _Stretch:
    """A street between two nodes: its index, the stations of both ends, and how far the junctions reach."""

    street: int
    start: float
    end: float
    nodes: tuple[int, int]
    reaches: tuple[ArmReach | None, ArmReach | None]

    def inner(self, of: str) -> tuple[float, float]:
        """Stations between the junctions, by ``clear``, ``stop`` or ``paint``."""
        first, last = self.reaches
        values = [0.0 if reach is None else _distance(reach, of) for reach in (first, last)]
        return self.start + values[0], self.end - values[1]


def _distance(reach: ArmReach, of: str) -> float:
    if of == "clear":
        return max(reach.left_clear, reach.right_clear)
    return reach.stop if of == "stop" else reach.paint


def build_town(seed: int, attempt: int = 0) -> Town:
    """Build a town of roughly 400 x 400 m. The same seed and attempt give the same town."""
    random = np.random.default_rng([0x746F776E32, seed, attempt])
    habits = Habits.draw(random)
    plan = plan_streets(random)
    sections = [draw_section(random, street.rank, habits) for street in plan.streets]
    for index, section in enumerate(sections):
        shape_street(random, plan, index, section)
    junctions = [build_junction(random, plan, sections, node) for node in range(len(plan.nodes))]
    works = _Works()
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
        stations = _spaced(stretch.start, stretch.end)
        edges = section.edges(stations)
        works.paved.append(line.band(stations, edges[-1], edges[0]))
    for stretch in stretches:
        _furnish(random, plan, sections[stretch.street], stretch, habits, works)
    for index in range(len(plan.streets)):
        _paint(random, plan, sections[index], index, [s for s in stretches if s.street == index], habits, works)
    vector_map, surface = _assemble(plan, sections, stretches, habits, works)
    if habits.left_hand:
        vector_map = mirrored_map(vector_map)
    return Town(vector_map, tuple(works.carriageways), surface)


def _spaced(start: float, end: float, spacing: float = 2.0) -> Float:
    return np.linspace(start, end, max(2, int(np.ceil((end - start) / spacing)) + 1))


def _stretches(plan: StreetPlan, reaches: dict[tuple[int, float, int], ArmReach]) -> list[_Stretch]:
    found = []
    for index, street in enumerate(plan.streets):
        for (start, first), (end, last) in zip(street.stops[:-1], street.stops[1:], strict=True):
            pair = (reaches.get((index, start, 1)), reaches.get((index, end, -1)))
            found.append(_Stretch(index, start, end, (first, last), pair))
    return found


def _cross_junction(
    random: Generator, plan: StreetPlan, sections: list[CrossSection], junction: Junction, habits: Habits, works: _Works
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
        reach.stop = max(reach.left_clear, reach.right_clear) + float(random.uniform(-1.0, 1.5))
        crossing = crossings.get(index)
        if crossing is not None:
            works.crossings.append(crossing)
            corners = shapely.points(shapely.get_coordinates(crossing.polygon)[:-1])
            along = arm.side * (shapely.line_locate_point(line.shape, corners) - arm.station)
            reach.stop = float(along.max()) + float(random.uniform(0.4, 2.0))
        reach.stop = max(min(reach.stop, 0.47 * room), 1.0)
        kind = random.random()
        gap = random.uniform(0.1, 1.2) if kind < 0.5 else random.uniform(1.2, 7.0 if kind < 0.8 else 18.0)
        reach.paint = reach.stop + min(float(gap), 0.2 * room)
        if not is_alley and random.random() < (habits.stop_line_share if crossing is not None else 0.25):
            _stop_line(line, sections[arm.street], reach, works)


def _stop_line(line: ReferenceLine, section: CrossSection, reach: ArmReach, works: _Works) -> None:
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


def _furnish(
    random: Generator, plan: StreetPlan, section: CrossSection, stretch: _Stretch, habits: Habits, works: _Works
) -> None:
    """Everything of a stretch that is not paint: medians, openings, lay-bys, lanes."""
    street = plan.streets[stretch.street]
    line = street.line
    begin, finish = stretch.inner("stop")
    clear = stretch.inner("clear")
    if finish - begin > 8.0:
        works.islands += median_islands(random, line, section, begin + 0.5, finish - 0.5)
        for row, strip in enumerate(section.strips):
            inner = _spaced(begin + 3.0, finish - 3.0) if finish - begin > 16.0 else None
            if inner is not None and (strip.use is Use.PARKING or strip.parked):
                works.parking += _parking_places(line, section, row, inner)
    low, high = clear[0] + 3.0, clear[1] - 3.0
    if high - low > 8.0:
        own = line.shape.buffer(section.half_width + 0.2)
        others = [s.line.shape.buffer(14.0) for number, s in enumerate(plan.streets) if number != stretch.street]
        taken = shapely.union_all(others)
        shapely.prepare(taken)
        rate = habits.openings * float(random.choice([0.4, 1.0, 2.0]))
        openings = build_openings(random, line, section, low, high, rate, taken)
        works.paved += [piece for piece in openings if piece.area > 1.0 and not piece.within(own)]
        lay_bys = build_lay_bys(random, line, section, low, high)
        works.paved += lay_bys.paved
        works.parking += lay_bys.parking
        for sign in (1, -1):
            if random.random() < habits.grass_share:
                kerb = section.edges(np.array([low, high]))[0 if sign == 1 else -1]
                rim = kerb + sign * 5.0
                works.grass.append(line.band(np.array([low, high]), np.minimum(kerb, rim), np.maximum(kerb, rim)))
    _lay_lanes(line, section, stretch, street.rank is not Rank.ALLEY, works)


def _parking_places(line: ReferenceLine, section: CrossSection, row: int, stations: Float) -> list[Polygon]:
    """Where cars are parked in one strip, in pieces short enough to be straight."""
    edges = section.edges(stations)
    width = section.strips[row].parked or 0.0
    high, low = edges[row], edges[row + 1]
    if width:
        on_left = row == 0 and len(section.strips) > 1
        high, low = (high, high - width) if on_left else (low + width, low)
    wide = (high - low) > 1.7
    found = []
    for first in range(0, len(stations) - 1, 12):
        last = min(first + 12, len(stations) - 1)
        if last > first and wide[first : last + 1].all():
            found.append(line.band(stations[first : last + 1], low[first : last + 1], high[first : last + 1]))
    return found


def _lay_lanes(line: ReferenceLine, section: CrossSection, stretch: _Stretch, main: bool, works: _Works) -> None:
    """Lane polygons between the junctions, and the carriageways."""
    clear, stop = stretch.inner("clear"), stretch.inner("stop")
    if clear[1] - clear[0] < 3.0:
        middle = (clear[0] + clear[1]) / 2
        clear = (middle - 1.5, middle + 1.5)
    stations = _spaced(*clear, spacing=1.0)
    edges = section.edges(stations)
    for row, strip in enumerate(section.strips):
        width = edges[row] - edges[row + 1]
        if strip.use in (Use.LANE, Use.BUS, Use.CYCLES) and width.max() > 0.6:
            wide = np.flatnonzero(width > 0.5)
            rows = slice(int(wide[0]), int(wide[-1]) + 1)
            if wide[-1] - wide[0] > 3:
                path = line.locate(stations[rows], (edges[row, rows] + edges[row + 1, rows]) / 2)
                band = line.band(stations[rows], edges[row + 1, rows], edges[row, rows])
                works.lanes.append((band, path if strip.direction == 1 else path[::-1]))
    for direction in (1, -1):
        to_stop = max(clear[1] - stop[1] if direction == 1 else stop[0] - clear[0], 0.0)
        reach = stretch.reaches[1 if direction == 1 else 0]
        waits = reach is not None and reach.stop > 0.0
        way = lanes_between(line, section, stations, direction, stretch.nodes, to_stop if waits else np.nan, main)
        if way is not None:
            works.carriageways.append(way)


def _paint(
    random: Generator,
    plan: StreetPlan,
    section: CrossSection,
    index: int,
    stretches: list[_Stretch],
    habits: Habits,
    works: _Works,
) -> None:
    """Paint one street; lines run on where only alleys join it."""
    street = plan.streets[index]
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
            cuts = _cross_midway(random, plan, section, street.line, begin, finish, habits, works)
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
    plan: StreetPlan,
    section: CrossSection,
    line: ReferenceLine,
    begin: float,
    finish: float,
    habits: Habits,
    works: _Works,
) -> list[float]:
    station = float(random.uniform(begin + 18.0, finish - 18.0))
    stations = _spaced(station - 12.0, station + 12.0)
    edges = section.edges(stations)
    crossing = cross_street(random, line, line.band(stations, edges[-1], edges[0]), station, habits)
    near = (
        min(
            abs(other.polygon.distance(shapely.Point(line.locate(np.array([station]))[0]))) for other in works.crossings
        )
        if works.crossings
        else 99.0
    )
    if crossing is None or near < 15.0:
        return [begin, finish]
    works.crossings.append(crossing)
    corners = shapely.points(shapely.get_coordinates(crossing.polygon)[:-1])
    along = shapely.line_locate_point(line.shape, corners)
    gap = float(random.choice([0.3, 1.0, 4.0]))
    return [begin, float(along.min()) - gap, float(along.max()) + gap, finish]


def _assemble(
    plan: StreetPlan, sections: list[CrossSection], stretches: list[_Stretch], habits: Habits, works: _Works
) -> tuple[VectorMap, shapely.Geometry]:
    """Cut islands out of the pavement and divide it into stretches and junctions."""
    outline = shapely.union_all(works.paved)
    # Slits and needles where pieces meet are closed; nothing that a car could see is lost.
    outline = outline.buffer(0.15, join_style="mitre").buffer(-0.3, join_style="mitre").buffer(0.15, join_style="mitre")
    outline = max(shapely.get_parts(outline), key=lambda part: part.area).simplify(0.03)
    outline = Polygon(outline.exterior, [ring for ring in outline.interiors if Polygon(ring).area > 6.0])
    islands = shapely.union_all(works.islands).intersection(outline.buffer(-0.8))
    kept = [part for part in shapely.get_parts(islands) if part.geom_type == "Polygon" and part.area > 1.6]
    islands = shapely.union_all(kept)
    surface = outline.difference(islands)
    surface = max(shapely.get_parts(surface), key=lambda part: part.area)
    segments, cutters = [], []
    for stretch in stretches:
        line, section = plan.streets[stretch.street].line, sections[stretch.street]
        low, high = stretch.inner("clear")
        low, high = (low + 1.0, high - 1.0)
        if high - low < 4.0:
            continue
        reach = section.half_width + 4.0
        for inset, target in ((0.0, segments), (0.2, cutters)):
            stations = _spaced(low + inset, high - inset)
            aside = np.full(len(stations), reach - inset)
            target.append(line.band(stations, -aside, aside))
    parts = [piece for band in segments for piece in _polygons(surface.intersection(band), 0.01)]
    parts += _polygons(surface.difference(shapely.union_all(cutters)), 0.01)
    inner = surface.buffer(-0.02)
    shapely.prepare(inner)
    lanes = [(part, path) for lane, path in works.lanes for part in _polygons(inner.intersection(lane), 2.0)]
    walkways = outline.buffer(habits.walkway_width, quad_segs=4).difference(outline)
    if works.grass:
        walkways = walkways.difference(shapely.union_all(works.grass))
    vector_map = VectorMap(
        road_segments=tuple(parts),
        lanes=tuple(lane for lane, _ in lanes),
        crossings=tuple(
            replace(crossing, polygon=part)
            for crossing in works.crossings
            for part in _polygons(crossing.polygon.difference(islands), 4.0)
        ),
        dividers=_painted_or_few(works.dividers),
        walkways=tuple(_polygons(walkways, 2.0)),
        parking=tuple(bay for bay in works.parking if bay.is_valid),
        stop_lines=tuple(works.stop_lines),
        lane_paths=tuple(path for _, path in lanes),
        markings=tuple(works.markings),
        hatchings=tuple(works.hatchings),
    )
    return vector_map, surface


def _painted_or_few(dividers: list[Divider]) -> tuple[Divider, ...]:
    """All painted dividers, and unpainted ones up to a small share of the length."""
    painted = [divider for divider in dividers if divider.style is not LineStyle.UNPAINTED]
    allowed = UNPAINTED_SHARE * sum(shapely.LineString(divider.points).length for divider in painted)
    for divider in dividers:
        if divider.style is LineStyle.UNPAINTED:
            length = shapely.LineString(divider.points).length
            if length <= allowed:
                painted.append(divider)
                allowed -= length
    return tuple(painted)


def _polygons(geometry: shapely.Geometry, least: float) -> list[Polygon]:
    """Polygons of a geometry, without crumbs below ``least`` square metres."""
    return [part for part in shapely.get_parts(geometry) if part.geom_type == "Polygon" and part.area >= least]
