"""Paint, crossings, parking and driveways made up over real road edges, for maps that record no more than these."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import shapely
from numpy.random import Generator
from shapely import Polygon

from predmapnet.demo_world.town.crossings import between_kerbs
from predmapnet.demo_world.town.habits import Habits
from predmapnet.demo_world.world import Crossing, Divider, LineStyle, VectorMap
from predmapnet.errors import UserError
from tests.real_roads.lane_links import linked_lanes
from tests.real_roads.road_skeleton import road_skeleton
from tests.real_roads.street_layout import StreetLayout, street_layouts

CENTRE_STYLES = {
    "yellow": (
        (LineStyle.DOUBLE_SOLID, 0.45),
        (LineStyle.DASHED, 0.25),
        (LineStyle.SOLID, 0.2),
        (LineStyle.SOLID_DASHED, 0.1),
    ),
    "white": ((LineStyle.DASHED, 0.5), (LineStyle.SOLID, 0.3), (LineStyle.DOUBLE_SOLID, 0.2)),
}
"""Paint between opposite directions by its colour, with shares."""
PAST_KERB = 1.2
"""A crossing ends at most so far beyond the usual kerb of its street, metres: not in the side street's mouth."""
SMALL_STREET = 8.4
"""Streets that are narrower, metres, are often without paint."""


@dataclass
class _Painted:
    """What has been made up so far."""

    crossings: list[Crossing] = field(default_factory=list)
    dividers: list[Divider] = field(default_factory=list)
    markings: list[Divider] = field(default_factory=list)
    stop_lines: list[Polygon] = field(default_factory=list)
    parking: list[Polygon] = field(default_factory=list)


def read_bare_map(path: Path, seed: int) -> VectorMap:
    """Read road edges and driveways of a map without paint, and make up the rest; the same seed gives the same map."""
    try:
        content = json.loads(path.read_text())
        segments = [Polygon(entry["exterior"], _rings(entry["holes"])).buffer(0) for entry in content["road_segments"]]
        driveways = [Polygon(ring).buffer(0) for ring in _rings(content.get("driveways", []))]
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise UserError(f"{path} is no road map: {error!r}") from error
    return made_up_map(shapely.union_all(segments), driveways, seed)


def _rings(rings: Sequence[Sequence[Sequence[float]]]) -> list[Sequence[Sequence[float]]]:
    return [ring for ring in rings if len(ring) >= 4]


def made_up_map(road: shapely.Geometry, driveways: Sequence[Polygon], seed: int) -> VectorMap:
    """Return a road with everything that is painted on it.

    Args:
        road: drivable area, metres.
        driveways: areas beside it, some of which become part of the road.
        seed: of all that is made up.
    """
    random = np.random.default_rng([0x7061696E74, seed])
    habits = Habits.draw(random)
    layouts = street_layouts(road_skeleton(road), road, habits, random)
    crossed = _share_of_crossed_arms(layouts, habits, random)
    painted = _Painted()
    for layout in layouts:
        begin = _end_at_crossing(painted, layout, road, 1, crossed, habits, random)
        end = _end_at_crossing(painted, layout, road, -1, crossed, habits, random)
        _add_crossing_between(painted, layout, road, begin, end, habits, random)
        if end - begin >= 4:
            _paint_lines(painted, layout, slice(begin, end + 1), habits, random)
            painted.parking += _parking_bays(layout, begin, end, road, random)
    return VectorMap(
        road_segments=_with_driveways(road, driveways, random),
        lanes=(),
        crossings=tuple(painted.crossings),
        dividers=tuple(painted.dividers),
        parking=tuple(painted.parking),
        stop_lines=tuple(painted.stop_lines),
        lane_paths=linked_lanes(layouts, road),
        markings=tuple(painted.markings),
        left_hand=habits.left_hand,
    )


def _share_of_crossed_arms(layouts: list[StreetLayout], habits: Habits, random: Generator) -> dict[int, float]:
    """Probability of a crossing over each arm, by junction: all of its arms, none, or half of them."""
    shares = {}
    nodes = [node for layout in layouts for node in layout.nodes]
    for node in sorted(set(nodes)):
        kind = random.random()
        share = 1.0 if kind < habits.ring_share else (0.0 if kind > 1 - habits.bare_share else 0.5)
        shares[node] = share if nodes.count(node) >= 3 else 0.0
    return shares


def _end_at_crossing(
    painted: _Painted,
    layout: StreetLayout,
    road: shapely.Geometry,
    sign: int,
    crossed: dict[int, float],
    habits: Habits,
    random: Generator,
) -> int:
    """Add a crossing and a stop line at the beginning (1) or the end (-1) of a street; return where its lines end."""
    mouth, which = (layout.begin, 0) if sign > 0 else (layout.end, 1)
    if not layout.is_junction[which] or random.random() > crossed[layout.nodes[which]]:
        return mouth
    stations = layout.stations
    depth = float(np.clip(random.normal(3.4, 0.7), 2.2, 5.5))
    row = layout.row(stations[mouth] + sign * (float(random.uniform(0.2, 2.0)) + depth / 2))
    skew = float(random.normal(0.0, np.radians(random.choice([2.0, 10.0]))))
    crossing = _across(layout, road, row, skew + (np.pi if sign < 0 else 0.0), depth, habits, random)
    if crossing is None:
        return mouth
    painted.crossings.append(crossing)
    stop = layout.row(stations[row] + sign * (depth / 2 + float(random.uniform(0.6, 2.5))))
    if random.random() < habits.stop_line_share:
        painted.stop_lines += _stop_lines(layout, stop, sign, float(random.uniform(0.3, 0.6)))
    return max(mouth, stop) if sign > 0 else min(mouth, stop)


def _across(
    layout: StreetLayout,
    road: shapely.Geometry,
    row: int,
    turn: float,
    depth: float,
    habits: Habits,
    random: Generator,
) -> Crossing | None:
    """A crossing over a street; ``turn`` is the direction of walking from straight to the left, radians."""
    leftward = layout.leftward[row]
    limit = layout.width / 2 + PAST_KERB
    walk = float(np.arctan2(leftward[1], leftward[0])) + turn
    return between_kerbs(random, road, layout.line[row], walk, depth, (limit, limit), habits)


def _add_crossing_between(
    painted: _Painted,
    layout: StreetLayout,
    road: shapely.Geometry,
    begin: int,
    end: int,
    habits: Habits,
    random: Generator,
) -> None:
    """Some long streets are crossed between their junctions, too."""
    if random.random() < 0.15 and layout.stations[-1] > 70 and end - begin > 30:
        row, depth = int(random.integers(begin + 12, end - 12)), float(random.uniform(2.5, 4.5))
        crossing = _across(layout, road, row, 0.0, depth, habits, random)
        painted.crossings += [] if crossing is None else [crossing]


def _stop_lines(layout: StreetLayout, row: int, sign: int, thickness: float) -> list[Polygon]:
    """Stop line across the lanes that lead to the beginning (1) or the end (-1) of a street."""
    arriving = [lane for lane in range(layout.lanes) if layout.is_forward(lane) == (sign < 0)]
    if not arriving:
        return []
    right = float(layout.offset(arriving[0] / layout.lanes)[row]) + 0.1
    left = float(layout.offset((arriving[-1] + 1) / layout.lanes)[row]) - 0.1
    if left - right < 1.8:
        return []
    corners = [(right, -0.5), (left, -0.5), (left, 0.5), (right, 0.5)]
    here, leftward, ahead = layout.line[row], layout.leftward[row], layout.tangents[row]
    return [Polygon([here + aside * leftward + along * thickness * ahead for aside, along in corners])]


def _paint_lines(painted: _Painted, layout: StreetLayout, part: slice, habits: Habits, random: Generator) -> None:
    """Add the lines between lanes, along parking and along kerbs of a part of a street."""
    is_small = layout.width < SMALL_STREET
    unmarked = (is_small and random.random() < habits.unmarked_share) or random.random() < 0.08
    styles, shares = zip(*CENTRE_STYLES[habits.centre_colour], strict=True)
    centre = styles[int(random.choice(len(styles), p=shares))]
    for number in range(1, layout.lanes):
        points = layout.beside(layout.offset(number / layout.lanes))[part]
        if number == layout.parting:
            style, colour = (LineStyle.UNPAINTED, "white") if unmarked else (centre, habits.centre_colour)
            painted.dividers.append(Divider(points, style, colour, True))
        elif not unmarked:
            painted.dividers.append(Divider(points, LineStyle.DASHED))
    edge = random.random()
    for side, inward in ((0, 0.35), (1, -0.35)):
        is_lined = edge < (0.5 if layout.parking[side] else habits.edge_line_share)
        if is_lined and not unmarked:
            offset = layout.offset(float(side)) + (0.0 if layout.parking[side] else inward)
            painted.markings.append(Divider(layout.beside(offset)[part], LineStyle.SOLID))


def _parking_bays(
    layout: StreetLayout, begin: int, end: int, road: shapely.Geometry, random: Generator
) -> list[Polygon]:
    """Parking along the kerbs in pieces of up to 24 m."""
    bays = []
    for side, sign in ((0, -1.0), (1, 1.0)):
        if not layout.parking[side]:
            continue
        kerb = layout.beside(sign * (layout.half_width - 0.1))
        lanes = layout.beside(layout.offset(float(side)) + sign * 0.05)
        row = begin
        while row < end - 5:
            following = min(row + int(random.uniform(8, 24)), end)
            ring = Polygon(np.concatenate([kerb[row : following + 1], lanes[row : following + 1][::-1]]))
            bay = ring.buffer(0).intersection(road)
            if isinstance(bay, Polygon) and bay.area > 8.0:
                bays.append(bay)
            row = following
    return bays


def _with_driveways(road: shapely.Geometry, driveways: Sequence[Polygon], random: Generator) -> tuple[Polygon, ...]:
    """Parts of the road; in two thirds of the maps with the first metres of most driveways."""
    ways: list[shapely.Geometry] = []
    if random.random() < 0.65:
        near = road.buffer(float(random.uniform(4.0, 8.0)))
        chosen = [way.intersection(near) for way in driveways if random.random() < 0.8]
        ways = [way.buffer(0.4) for way in chosen if way.distance(road) < 0.3]
    # Seams between a driveway and the street close.
    joined = shapely.union_all([road, *ways]).buffer(0.3).buffer(-0.3) if ways else road
    return tuple(part for part in shapely.get_parts(joined) if isinstance(part, Polygon))
