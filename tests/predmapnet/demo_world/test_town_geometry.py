from functools import cache

import numpy as np
import pytest
import shapely

from mapfusion.elements import ElementKind, RegionOfInterest
from predmapnet.demo_world.catalogue import vector_map
from predmapnet.demo_world.nuscenes.map_expansion import CANVAS_EDGE
from predmapnet.demo_world.town.habits import Habits
from predmapnet.demo_world.town.street_plan import SMALLEST_ANGLE, plan_streets
from predmapnet.demo_world.town.town import build_town
from predmapnet.demo_world.truth import truth_from_vector_map
from predmapnet.demo_world.world import LineStyle

SEEDS = [101, 103, 201, 218, 226, 228]
"""Three of these towns drive on the left; the tests of drives use the same ones."""


@cache
def town_map_of(seed):
    return vector_map(f"scene-{seed:04d}")


@cache
def drivable(seed):
    town_map = town_map_of(seed)
    return shapely.union(shapely.union_all(town_map.road_segments), shapely.union_all(town_map.lanes))


def test_the_same_seed_builds_the_same_town_and_another_seed_another():
    first, second, other = town_map_of(103), build_town(103).vector_map, town_map_of(101)
    assert shapely.to_wkb(first.road_segments).tolist() == shapely.to_wkb(second.road_segments).tolist()
    assert all(a.points.tobytes() == b.points.tobytes() for a, b in zip(first.dividers, second.dividers, strict=True))
    assert first.dividers[0].points.tobytes() != other.dividers[0].points.tobytes()


@pytest.mark.parametrize("seed", SEEDS)
def test_drivable_surface_is_one_clean_piece(seed):
    surface = drivable(seed)
    assert surface.geom_type == "Polygon"
    assert surface.is_valid
    assert min(shapely.Polygon(ring).area for ring in surface.interiors) > 1.0
    # A crack or a spike is thinner than 20 cm: opening and closing by 10 cm would change the surface there.
    opened = surface.buffer(-0.1).buffer(0.15)
    closed = surface.buffer(0.1).buffer(-0.15)
    assert max((part.area for part in shapely.get_parts(surface.difference(opened))), default=0.0) < 0.3
    assert max((part.area for part in shapely.get_parts(closed.difference(surface))), default=0.0) < 0.3


@pytest.mark.parametrize("seed", SEEDS)
def test_every_part_is_valid_and_inside_the_map(seed):
    town_map = town_map_of(seed)
    crossings = [crossing.polygon for crossing in town_map.crossings]
    polygons = [*town_map.road_segments, *town_map.lanes, *crossings, *town_map.walkways, *town_map.parking]
    assert all(polygon.is_valid for polygon in polygons)
    surface = drivable(seed)
    for polygon in crossings:
        assert polygon.difference(surface).area < 0.5 * polygon.area
    bounds = shapely.total_bounds([*town_map.road_segments, *town_map.walkways])
    assert (bounds[:2] > 10.0).all()
    assert bounds[2] < CANVAS_EDGE[0] - 10.0
    assert bounds[3] < CANVAS_EDGE[1] - 10.0


@pytest.mark.parametrize("seed", SEEDS)
def test_dividers_lie_on_the_road_and_keep_clear_of_crossings(seed):
    town_map = town_map_of(seed)
    surface = drivable(seed).buffer(0.1)
    crossings = shapely.union_all([crossing.polygon for crossing in town_map.crossings])
    lines = [shapely.LineString(divider.points) for divider in town_map.dividers]
    assert len(lines) > 10
    assert np.mean([line.is_simple and surface.contains(line) for line in lines]) > 0.97
    total = sum(line.length for line in lines)
    assert sum(line.intersection(crossings).length for line in lines) < 0.01 * total
    unpainted = [shapely.LineString(d.points).length for d in town_map.dividers if d.style is LineStyle.UNPAINTED]
    assert sum(unpainted) < 0.03 * total


def test_crossings_ring_junctions_and_meet_at_corners():
    touching = []
    for seed in SEEDS:
        shapes = [crossing.polygon for crossing in town_map_of(seed).crossings]
        tree = shapely.STRtree(shapes)
        first, second = tree.query(shapes, predicate="dwithin", distance=0.5)
        touching += [(first[first != second] == index).any() for index in range(len(shapes))]
    assert 0.4 < np.mean(touching) < 0.95


def test_lines_along_kerbs_and_parking_are_painted_but_no_truth():
    beside_truth = []
    for seed in SEEDS:
        town_map = town_map_of(seed)
        truth = truth_from_vector_map(town_map)
        for marking in [marking for marking in town_map.markings if len(marking.points) > 12][::8]:
            pose = np.eye(4)
            pose[:2, 3] = marking.points[len(marking.points) // 2]
            frame = truth.frame(pose, RegionOfInterest())
            lines = [
                shapely.LineString(line)
                for line, kind in zip(frame.polylines, frame.kinds, strict=True)
                if kind == ElementKind.DIVIDER
            ]
            beside_truth.append(min((line.distance(shapely.Point(0, 0)) for line in lines), default=99.0) < 0.2)
    assert len(beside_truth) > 10
    assert np.mean(beside_truth) < 0.1


def test_streets_widen_and_narrow_and_their_lanes_stay_on_the_road():
    changing = []
    for seed in SEEDS:
        surface = drivable(seed).buffer(0.05)
        for lane, path in zip(town_map_of(seed).lanes, town_map_of(seed).lane_paths, strict=True):
            line = shapely.LineString(path)
            if line.length < 40.0:
                continue
            widths = [_width(lane, line, share) for share in (0.15, 0.5, 0.85)]
            changing.append(max(widths) - min(widths) > 0.3)
            assert surface.covers(line)
    assert 0.01 < np.mean(changing) < 0.4


def _width(lane, line, share):
    before, here, after = (shapely.get_coordinates(line.interpolate(share * line.length + d))[0] for d in (-1, 0, 1))
    aside = 4.0 * np.array([before[1] - after[1], after[0] - before[0]])
    return lane.intersection(shapely.LineString([here - aside, here + aside])).length


def test_junctions_have_three_or_more_arms_at_any_angle_and_some_streets_end():
    counts, angles = [], []
    for seed in range(201, 211):
        plan = plan_streets(np.random.default_rng(seed))
        for node in range(len(plan.nodes)):
            headings = np.sort([plan.heading(arm) for arm in plan.arms(node)])
            counts.append(len(headings))
            gaps = np.diff(np.append(headings, headings[0] + 2 * np.pi))
            angles += gaps[gaps < np.radians(150)].tolist()
    assert {1, 3, 4} <= set(counts) <= set(range(1, 7))
    assert min(angles) > SMALLEST_ANGLE - np.radians(12.0)
    assert np.mean(np.abs(np.degrees(angles) - 90.0) > 15.0) > 0.15


def test_towns_drive_on_both_sides_and_paint_in_two_colours():
    habits = [Habits.draw(np.random.default_rng(seed)) for seed in range(200)]
    assert 0.08 < np.mean([habit.left_hand for habit in habits]) < 0.3
    assert 0.6 < np.mean([habit.centre_colour == "yellow" for habit in habits]) < 0.9
