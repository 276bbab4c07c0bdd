from functools import cache

import numpy as np
import pytest
import shapely
from predmapnet.demo_world.town.town_plan import plan_town

from predmapnet.demo_world.catalogue import SPLITS, vector_map
from predmapnet.demo_world.nuscenes.map_expansion import CANVAS_EDGE
from predmapnet.demo_world.town.town import build_town
from predmapnet.demo_world.world import LineStyle

SEEDS = [*SPLITS["test"], *range(201, 213)]


@cache
def town_map_of(seed):
    return build_town(seed).vector_map


@cache
def drivable(seed):
    town_map = town_map_of(seed)
    return shapely.union(shapely.union_all(town_map.road_segments), shapely.union_all(town_map.lanes))


def test_the_same_seed_builds_the_same_town_and_another_seed_another():
    first, second, other = (build_town(seed).vector_map for seed in (7, 7, 8))
    assert shapely.to_wkb(first.road_segments).tolist() == shapely.to_wkb(second.road_segments).tolist()
    assert all(a.points.tobytes() == b.points.tobytes() for a, b in zip(first.dividers, second.dividers, strict=True))
    assert first.dividers[0].points.tobytes() != other.dividers[0].points.tobytes()


@pytest.mark.parametrize("seed", SEEDS)
def test_drivable_surface_is_one_clean_piece(seed):
    surface = drivable(seed)
    assert surface.geom_type == "Polygon"
    assert surface.is_valid
    islands = [shapely.Polygon(ring) for ring in surface.interiors]
    assert min(island.area for island in islands) > 1.5
    # A crack or a spike is thinner than 20 cm: opening and closing by 10 cm would change the surface there.
    opened = surface.buffer(-0.1).buffer(0.15)
    closed = surface.buffer(0.1).buffer(-0.15)
    assert max((part.area for part in shapely.get_parts(surface.difference(opened))), default=0.0) < 0.05
    assert max((part.area for part in shapely.get_parts(closed.difference(surface))), default=0.0) < 0.05


@pytest.mark.parametrize("seed", SEEDS)
def test_every_part_is_valid_and_on_the_road(seed):
    town_map = town_map_of(seed)
    surface = drivable(seed).buffer(0.05)
    crossings = [crossing.polygon for crossing in town_map.crossings]
    polygons = [*town_map.road_segments, *town_map.lanes, *crossings, *town_map.walkways, *town_map.parking]
    assert all(polygon.is_valid for polygon in polygons)
    for polygon in [*crossings, *town_map.parking, *town_map.stop_lines]:
        assert polygon.difference(surface).area < 0.02 * polygon.area + 0.01
    bounds = shapely.total_bounds([*town_map.road_segments, *town_map.walkways])
    assert bounds[0] > 100.0
    assert bounds[1] > 100.0
    assert bounds[2] < CANVAS_EDGE[0] - 100.0
    assert bounds[3] < CANVAS_EDGE[1] - 100.0


@pytest.mark.parametrize("seed", SEEDS)
def test_dividers_are_simple_lines_that_keep_clear_of_crossings_and_kerbs(seed):
    town_map = town_map_of(seed)
    surface = drivable(seed)
    crossings = shapely.union_all([crossing.polygon for crossing in town_map.crossings])
    lines = [shapely.LineString(divider.points) for divider in town_map.dividers]
    assert len(lines) > 10
    for line in lines:
        assert line.is_simple
        assert surface.contains(line)
        assert line.distance(surface.boundary) > 0.5
        assert line.intersection(crossings).length < 1.0
    # Not two lines in the same place.
    tree = shapely.STRtree(lines)
    pairs = tree.query(lines, predicate="dwithin", distance=1.0)
    assert (pairs[0] == pairs[1]).all()


def test_lanes_are_as_wide_as_lanes():
    widths = [2 * part.area / part.length for seed in SEEDS for part in town_map_of(seed).lanes if part.area > 80]
    # Area over half the perimeter is a little below the width of a long strip.
    assert min(widths) > 2.4
    assert max(widths) < 3.6


def test_towns_show_the_whole_variety_of_roads():
    towns = [build_town(seed) for seed in range(201, 241)]
    sections = [road.section for town in towns for road in town.plan.roads]
    assert {section.lanes for section in sections} == {1, 2, 3}
    assert 0.1 < np.mean([section.median > 0 for section in sections]) < 0.5
    assert any(node.is_roundabout for town in towns for node in town.plan.nodes)
    arms = [len(town.plan.arms(node)) for town in towns for node in range(len(town.plan.nodes))]
    assert set(arms) == {3, 4}
    dividers = [divider for town in towns for divider in town.vector_map.dividers]
    assert {divider.style for divider in dividers} == set(LineStyle)
    assert {divider.colour for divider in dividers} == {"white", "yellow"}
    assert np.mean([divider.style is LineStyle.UNPAINTED for divider in dividers]) < 0.08
    assert len({crossing.style for town in towns for crossing in town.vector_map.crossings}) == 3
    assert all(town.vector_map.stop_lines for town in towns)
    assert np.mean([len(town.vector_map.parking) > 0 for town in towns]) > 0.6


def test_junctions_meet_at_other_than_right_angles():
    angles = []
    for seed in range(201, 241):
        plan = plan_town(np.random.default_rng(seed))
        for node in range(len(plan.nodes)):
            headings = []
            for edge, side in plan.arms(node):
                road = plan.roads[plan.edges[edge].road]
                station = plan.edges[edge].start if side == 1 else plan.edges[edge].end
                tangent = side * road.direction(np.array([station]))[0]
                headings.append(np.arctan2(tangent[1], tangent[0]))
            gaps = np.diff(np.sort(headings))
            angles.extend(np.degrees(gaps[gaps < np.radians(150)]))
    assert np.min(angles) > 35.0
    assert np.mean(np.abs(np.array(angles) - 90.0) > 15.0) > 0.2


def test_map_of_a_scene_is_the_map_of_its_town():
    assert len(vector_map("scene-0103").road_segments) == len(build_town(103).vector_map.road_segments)
