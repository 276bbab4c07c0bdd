"""A town: from a seed to the vector map that all ground truth is derived from."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import shapely
from numpy.random import Generator
from numpy.typing import NDArray
from shapely import Polygon

from predmapnet.demo_world.town_v1.junctions import Arm, clear_distance, has_splitter, pave
from predmapnet.demo_world.town_v1.roads import Road, parts
from predmapnet.demo_world.town_v1.town_plan import Edge, TownPlan, plan_town
from predmapnet.demo_world.world import Crossing, CrossingStyle, Divider, VectorMap

Float = NDArray[np.float64]

ISLAND_GAP = 0.3
"""Between the edge of a lane and the kerb of a median, metres."""

MARKING_GAP = 0.6
"""Between the end of a divider and a crossing or a stop line, metres."""


@dataclass(frozen=True)
class Town:
    """A vector map and the plan behind it, which routes follow.

    Attributes:
        plan: roads, nodes and stretches.
        arms: for each stretch its arm at the start and at the end.
        corner_radius: of the kerbs at junctions, metres.
        vector_map: what is true about the road.
    """

    plan: TownPlan
    arms: tuple[tuple[Arm, Arm], ...]
    corner_radius: float
    vector_map: VectorMap


@dataclass
class _Works:
    """What has been built so far."""

    crossings: list[Crossing] = field(default_factory=list)
    dividers: list[Divider] = field(default_factory=list)
    islands: list[Polygon] = field(default_factory=list)
    widenings: list[Polygon] = field(default_factory=list)
    parking: list[Polygon] = field(default_factory=list)
    stop_lines: list[Polygon] = field(default_factory=list)
    lanes: list[tuple[Polygon, Float]] = field(default_factory=list)
    grass: list[Polygon] = field(default_factory=list)


def build_town(seed: int) -> Town:
    """Build a town of roughly 300 x 300 m. The same seed gives the same town."""
    random = np.random.default_rng([0x70776E, seed])
    plan = plan_town(random)
    corner_radius = float(random.uniform(5.0, 8.5))
    pavement = pave(plan, corner_radius)
    works = _Works()
    habits = _Habits.draw(random)
    arms = tuple(
        (
            _build_arm(random, plan, pavement, index, 1, habits, works),
            _build_arm(random, plan, pavement, index, -1, habits, works),
        )
        for index in range(len(plan.edges))
    )
    for edge, (first, last) in zip(plan.edges, arms, strict=True):
        _build_stretch(random, plan.roads[edge.road], edge, first, last, habits, works)
    works.islands += [
        shapely.Point(node.position).buffer(node.island_radius, 24) for node in plan.nodes if node.is_roundabout
    ]
    return Town(plan, arms, corner_radius, _assemble(plan, arms, pavement, habits, works))


@dataclass(frozen=True)
class _Habits:
    """What all streets of one town have in common."""

    crossing_styles: tuple[CrossingStyle, ...]
    crossing_share: float
    midblock_share: float
    walkway_width: float
    grass_share: float
    parking_share: float

    @classmethod
    def draw(cls, random: Generator) -> _Habits:
        styles = list(CrossingStyle)
        first = styles[random.choice(3, p=[0.5, 0.3, 0.2])]
        return cls(
            crossing_styles=(first, first, first, styles[random.integers(3)]),
            crossing_share=float(random.uniform(0.5, 0.9)),
            midblock_share=float(random.uniform(0.1, 0.6)),
            walkway_width=float(random.uniform(1.8, 3.6)),
            grass_share=float(random.uniform(0.0, 0.5)),
            parking_share=float(random.uniform(0.1, 0.6)),
        )


def _build_arm(
    random: Generator, plan: TownPlan, pavement: shapely.Geometry, index: int, side: int, habits: _Habits, works: _Works
) -> Arm:
    """Build crossing, stop line and refuge at one end of a stretch."""
    edge = plan.edges[index]
    node = edge.nodes[0 if side == 1 else 1]
    if node < 0:
        return Arm(index, side, -1, 0.0, (0.0, 0.0), stop=3.0)
    road = plan.roads[edge.road]
    section = road.section
    clear = clear_distance(plan, pavement, index, side)
    origin = edge.start if side == 1 else edge.end
    near = far = clear
    if random.random() < habits.crossing_share:
        depth = float(random.uniform(2.8, 4.4))
        skew = np.tan(np.radians(_draw_skew(random)))
        slack = abs(skew) * section.half_width
        near = clear + float(random.uniform(-0.4, 1.0)) + max(0.0, slack - 1.0)
        far = near + depth
        works.crossings.append(_crossing(random, road, origin + side * near, origin + side * far, skew, habits))
        near, far = near - slack, far + slack
    stop = far + float(random.uniform(0.8, 1.4))
    inner, outer = section.lane_edge(0) + 0.1, section.lane_edge(section.lanes)
    laterals = (inner, outer) if side == 1 else (-outer, -inner)
    if random.random() < 0.85 and not plan.nodes[node].is_roundabout:
        works.stop_lines.append(road.strip(origin + side * stop, origin + side * (stop + 0.4), *laterals))
    if has_splitter(plan, road, node):
        _build_splitter(road, origin, side, clear, far, works)
        stop = max(stop, far + 4.0)
    return Arm(index, side, node, clear, (near, far), stop)


def _draw_skew(random: Generator) -> float:
    """Degrees; most crossings are nearly straight, a quarter clearly are not."""
    return float(
        random.choice([-1.0, 1.0]) * random.uniform(8.0, 22.0) if random.random() < 0.25 else random.normal(0.0, 2.0)
    )


def _crossing(random: Generator, road: Road, start: float, end: float, skew: float, habits: _Habits) -> Crossing:
    """A crossing from kerb to kerb between two stations, sheared along the road by ``skew`` per metre of offset."""
    reach = road.section.half_width - float(random.uniform(0.0, 0.3))
    offsets = np.array([-reach, reach, reach, -reach])
    corners = road.locate(np.array([start, start, end, end]) + skew * offsets, offsets)
    walk = corners[1] - corners[0]
    style = habits.crossing_styles[random.integers(4)]
    return Crossing(shapely.orient_polygons(Polygon(corners)), style, float(np.arctan2(walk[1], walk[0])))


def _build_splitter(road: Road, origin: float, side: int, clear: float, far: float, works: _Works) -> None:
    """An island between the directions at the mouth of a roundabout, and the road widened around it."""
    half, gain = road.section.half_width, 1.0
    tip, tail = clear - 1.0, far + 3.0
    distances = np.array([clear - 4.0, clear - 2.0, tail + 1.0, tail + 9.0])
    stations, profile = origin + side * distances, half + gain * np.array([0.0, 1.0, 1.0, 0.0])
    if side == -1:
        stations, profile = stations[::-1], profile[::-1]
    works.widenings.append(road.band(stations, -profile, profile))
    works.islands.append(_island(road, origin + side * tip, origin + side * tail, 0.75))


def _island(road: Road, start: float, end: float, half_width: float) -> Polygon:
    """A raised island along the reference line with rounded noses."""
    shrink = np.sign(end - start) * half_width
    return shapely.LineString(road.line(start + shrink, end - shrink)).buffer(half_width, quad_segs=6)


def _build_stretch(
    random: Generator, road: Road, edge: Edge, first: Arm, last: Arm, habits: _Habits, works: _Works
) -> None:
    """Build everything between the arms of a stretch."""
    section = road.section
    begin, finish = edge.start + first.stop, edge.end - last.stop
    cuts = [begin, finish]
    if finish - begin > 32.0 and random.random() < habits.midblock_share:
        middle = float(random.uniform(begin + 13.0, finish - 13.0))
        depth = float(random.uniform(3.0, 4.5))
        skew = np.tan(np.radians(_draw_skew(random)))
        works.crossings.append(_crossing(random, road, middle - depth / 2, middle + depth / 2, skew, habits))
        clearance = depth / 2 + abs(skew) * section.lane_edge(section.lanes - 1)
        cuts = [begin, middle - clearance, middle + clearance, finish]
    free = list(zip(cuts[0::2], cuts[1::2], strict=True))
    through_median = random.random() < 0.5
    _build_medians(road, free, (cuts[0], cuts[-1]) if through_median else None, works)
    for start, end in free:
        if end - start > 6.0:
            _paint_dividers(road, start + MARKING_GAP, end - MARKING_GAP, works)
            for side in (-1, 1):
                _build_kerbside(random, road, start + 2.0, end - 2.0, side, habits, works)
    inner_first, inner_last = edge.start + first.clear, edge.end - last.clear
    for side in (-1, 1):
        for lane in range(section.lanes):
            laterals = sorted((side * section.lane_edge(lane), side * section.lane_edge(lane + 1)))
            ends = (inner_last, inner_first) if side == 1 else (inner_first, inner_last)
            path = road.line(*ends, side * section.lane_centre(lane))
            works.lanes.append((road.strip(inner_first, inner_last, *laterals), path))
        if random.random() < habits.grass_share:
            laterals = sorted((side * (section.half_width - 0.5), side * (section.half_width + 5.0)))
            works.grass.append(road.strip(inner_first + 2.0, inner_last - 2.0, *laterals))


def _build_medians(
    road: Road, free: list[tuple[float, float]], whole: tuple[float, float] | None, works: _Works
) -> None:
    half_width = road.section.median / 2 - ISLAND_GAP
    for start, end in [whole] if whole else free:
        if half_width > 0.4 and end - start > 6.0:
            works.islands.append(_island(road, start, end, half_width))


def _paint_dividers(road: Road, start: float, end: float, works: _Works) -> None:
    section = road.section
    if section.median == 0.0:
        works.dividers.append(
            Divider(road.line(start, end), section.centre_style, section.centre_colour, opposite=True)
        )
    for side in (-1, 1):
        for lane in range(1, section.lanes):
            line = road.line(start, end, side * section.lane_edge(lane))
            works.dividers.append(Divider(line, section.lane_style))


def _build_kerbside(
    random: Generator, road: Road, start: float, end: float, side: int, habits: _Habits, works: _Works
) -> None:
    """Sometimes a lay-by for parked cars or a bus bay along the kerb."""
    room = end - start
    if room < 20.0 or random.random() > habits.parking_share:
        return
    is_bus_bay = room > 30.0 and random.random() < 0.25
    depth, taper = (float(random.uniform(2.6, 3.0)), 7.0) if is_bus_bay else (float(random.uniform(2.0, 2.5)), 1.2)
    length = float(random.uniform(0.6, 1.0)) * room
    begin = start + float(random.uniform(0.0, 1.0)) * (room - length)
    kerb = road.section.half_width
    stations = np.array([begin, begin + taper, begin + length - taper, begin + length])
    outer = side * (kerb + depth * np.array([0.0, 1.0, 1.0, 0.0]))
    inner = np.full(4, side * (kerb - 0.3))
    works.widenings.append(road.band(stations, inner, outer) if side == 1 else road.band(stations, outer, inner))
    if not is_bus_bay:
        laterals = sorted((side * kerb, side * (kerb + depth)))
        works.parking.append(road.strip(float(stations[1]), float(stations[2]), *laterals))


def _assemble(
    plan: TownPlan, arms: tuple[tuple[Arm, Arm], ...], pavement: shapely.Geometry, habits: _Habits, works: _Works
) -> VectorMap:
    """Cut islands out of the pavement and divide it into stretches and junctions."""
    outline = shapely.union_all([pavement, *works.widenings])
    islands = shapely.union_all(works.islands)
    surface = outline.difference(islands)
    stretches, cutters = [], []
    for edge, (first, last) in zip(plan.edges, arms, strict=True):
        road = plan.roads[edge.road]
        start, end = edge.start + first.clear + 3.0, edge.end - last.clear - 3.0
        start, end = (start if first.node >= 0 else 0.0), (end if last.node >= 0 else road.length)
        reach = road.section.half_width + 5.0
        stretches += parts(surface.intersection(road.strip(start, end, -reach, reach)), 0.5)
        # Neighbouring segments overlap by 20 cm, so that their union has no seam.
        inset = [start + 0.2 if first.node >= 0 else -2.0, end - 0.2 if last.node >= 0 else road.length + 2.0]
        cutters.append(road.strip(inset[0], inset[1], -reach, reach))
    junctions = parts(surface.difference(shapely.union_all(cutters)), 0.5)
    lanes = [(part, path) for lane, path in works.lanes for part in parts(lane.difference(islands), 0.5)]
    walkways = outline.buffer(habits.walkway_width, quad_segs=6).difference(outline)
    walkways = walkways.difference(shapely.union_all(works.grass)) if works.grass else walkways
    return VectorMap(
        road_segments=tuple(stretches + junctions),
        lanes=tuple(lane for lane, _ in lanes),
        crossings=tuple(
            Crossing(part, crossing.style, crossing.heading)
            for crossing in works.crossings
            for part in parts(crossing.polygon.difference(islands), 2.0)
        ),
        dividers=tuple(works.dividers),
        walkways=tuple(parts(walkways, 2.0)),
        parking=tuple(works.parking),
        stop_lines=tuple(works.stop_lines),
        lane_paths=tuple(path for _, path in lanes),
    )
