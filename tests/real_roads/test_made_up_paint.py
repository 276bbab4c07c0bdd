"""Real road edges become streets, and streets get paint that keeps the rules of the road."""

import json

import numpy as np
import pytest
import shapely
from shapely import LineString, Point, Polygon, box

from predmapnet.errors import UserError
from tests.real_roads.made_up_paint import made_up_map, read_bare_map
from tests.real_roads.road_skeleton import road_skeleton

HALF_WIDTHS = {"along x": 6.0, "along y": 4.5}
JUNCTION = box(-4.5, -6.0, 4.5, 6.0)
SEEDS = range(12)


def cross_of_streets(reach=120.0):
    """Two streets that cross at the origin, corners rounded by 4 m; their ends lie on the rim of the tile."""
    wide, narrow = HALF_WIDTHS.values()
    road = shapely.union_all([box(-reach, -wide, reach, wide), box(-narrow, -reach, narrow, reach)])
    return road.buffer(4.0).buffer(-4.0)


@pytest.fixture(scope="module")
def maps():
    return [made_up_map(cross_of_streets(), [], seed) for seed in SEEDS]


def streets_paths(vector_map):
    return [path for path in vector_map.lane_paths if shapely.length(LineString(path)) > 40]


def test_a_cross_is_four_streets_of_their_widths_and_one_junction():
    skeleton = road_skeleton(cross_of_streets())
    degrees = [skeleton.degree(node) for node in range(len(skeleton.places))]
    assert sorted(degrees) == [1, 1, 1, 1, 4]
    np.testing.assert_allclose(skeleton.places[degrees.index(4)], 0.0, atol=0.6)
    widths = []
    for street in skeleton.streets:
        away = slice(20, 80) if degrees[street.nodes[0]] == 4 else slice(-80, -20)
        is_along_x = np.ptp(street.line[:, 0]) > np.ptp(street.line[:, 1])
        widths.append(HALF_WIDTHS["along x" if is_along_x else "along y"])
        np.testing.assert_allclose(street.half_width[away], widths[-1], atol=0.1)
        np.testing.assert_allclose(street.line[away, 1 if is_along_x else 0], 0.0, atol=0.1)
        np.testing.assert_allclose(np.linalg.norm(np.diff(street.line[away], axis=0), axis=1), 1.0, atol=0.05)
    assert sorted(widths) == [4.5, 4.5, 6.0, 6.0]


def test_small_bays_and_islands_are_no_streets_and_a_broad_island_parts_the_road():
    road = box(0, 0, 200, 12).union(box(60, 12, 64, 16)).difference(box(120, 5, 124, 7))
    assert len(road_skeleton(road).streets) == 1
    parted = road_skeleton(box(0, 0, 200, 30).difference(box(60, 12, 140, 18)))
    assert len(parted.streets) == 4
    assert sorted(parted.degree(node) for node in range(len(parted.places))) == [1, 1, 3, 3]


def test_dividers_lie_on_the_road_and_nowhere_in_the_junction(maps):
    lines = [LineString(divider.points) for found in maps for divider in found.dividers]
    assert len(lines) > 3 * len(maps)
    road = cross_of_streets().buffer(-1.0)
    for line in lines:
        assert road.contains(line) and line.distance(JUNCTION) > 0.5
    markings = [LineString(line.points) for found in maps for line in found.markings]
    assert markings and all(cross_of_streets().buffer(0.05).contains(line) for line in markings)


def test_crossings_reach_from_kerb_to_kerb_off_the_junction(maps):
    crossings = [crossing.polygon for found in maps for crossing in found.crossings]
    assert len(crossings) > len(maps)
    for polygon in crossings:
        is_over_x = abs(polygon.centroid.x) > abs(polygon.centroid.y)
        across = np.array(polygon.exterior.coords)[:, 1 if is_over_x else 0]
        half = HALF_WIDTHS["along x" if is_over_x else "along y"]
        # Habits say how far beyond the kerb, or short of it.
        assert half - 0.6 < -across.min() < half + 2.8 and half - 0.6 < across.max() < half + 2.8
        assert polygon.distance(Point(0, 0)) > 4.0


def test_stop_lines_lie_before_crossings_on_the_side_of_arriving_cars(maps):
    stops = [(line.centroid, found.left_hand) for found in maps for line in found.stop_lines]
    assert stops
    for place, left_hand in stops:
        position = np.array([place.x, place.y])
        inward = -np.sign(position) * (np.abs(position) == np.abs(position).max())
        lateral = float(inward[0] * position[1] - inward[1] * position[0])
        # One-way streets have them over all lanes.
        assert abs(lateral) < 0.8 or (lateral > 0) == left_hand


def test_cars_keep_to_the_side_of_their_town(maps):
    checked = set()
    for found in maps:
        two_way = [divider for divider in found.dividers if divider.opposite]
        for path in streets_paths(found):
            heading = path[-1] - path[0]
            for divider in two_way:
                parting = LineString(divider.points)
                middle = Point(path[len(path) // 2])
                if parting.distance(middle) > 6.0:
                    continue
                nearest = np.array(parting.interpolate(parting.project(middle)).coords[0])
                normal = np.array([-heading[1], heading[0]])
                assert ((np.array(middle.coords[0]) - nearest) @ normal > 0) == found.left_hand
                checked.add(found.left_hand)
    assert checked == {False, True}


def test_lanes_go_on_over_the_junction(maps):
    for found in maps:
        paths = found.lane_paths
        links = [path for path in paths if LineString(path).intersects(JUNCTION)]
        assert links
        starts = np.array([path[0] for path in paths if not LineString(path).intersects(JUNCTION)])
        ends = np.array([path[-1] for path in paths if not LineString(path).intersects(JUNCTION)])
        for link in links:
            assert np.linalg.norm(ends - link[0], axis=1).min() < 1e-6
            assert np.linalg.norm(starts - link[-1], axis=1).min() < 1e-6
            assert cross_of_streets().buffer(0.5).contains(LineString(link))


def direction(path):
    return (path[-1] - path[0]) / np.linalg.norm(path[-1] - path[0])


def test_turning_cars_take_the_nearest_lane_of_several(maps):
    choices = 0
    for found in maps:
        streets = streets_paths(found)
        for link in found.lane_paths:
            if not LineString(link).intersects(JUNCTION) or abs(direction(link[:2]) @ direction(link[-2:])) > 0.5:
                continue
            (taken,) = [path for path in streets if np.linalg.norm(path[0] - link[-1]) < 1e-6]
            beside = [
                path
                for path in streets
                if direction(path) @ direction(taken) > 0.95 and np.linalg.norm(path[0] - taken[0]) < 15.0
            ]
            choices += len(beside) > 1
            nearest = min(float(np.linalg.norm(path[0] - link[0])) for path in beside)
            assert np.linalg.norm(link[-1] - link[0]) == pytest.approx(nearest)
    assert choices > 5


def everything(vector_map):
    lines = [divider.points for divider in (*vector_map.dividers, *vector_map.markings)]
    areas = [*vector_map.road_segments, *vector_map.parking, *vector_map.stop_lines]
    areas += [crossing.polygon for crossing in vector_map.crossings]
    parts = [*lines, *vector_map.lane_paths, *(shapely.get_coordinates(area) for area in areas)]
    return np.concatenate(parts).tobytes()


def test_the_same_seed_gives_the_same_map(maps):
    again = [made_up_map(cross_of_streets(), [], seed) for seed in (0, 1)]
    assert [everything(found) for found in again] == [everything(found) for found in maps[:2]]
    assert everything(maps[0]) != everything(maps[1])


def test_driveways_open_the_kerb_in_some_maps():
    way = Polygon([(40, 5.9), (44, 5.9), (44, 30), (40, 30)])
    areas = {
        round(shapely.union_all(made_up_map(cross_of_streets(), [way], seed).road_segments).area) for seed in SEEDS
    }
    assert min(areas) == round(cross_of_streets().area) and max(areas) > min(areas) + 12


def test_a_file_that_is_no_map_is_told(tmp_path):
    path = tmp_path / "broken.json"
    path.write_text(json.dumps({"road_segments": 3}))
    with pytest.raises(UserError, match=r"broken\.json is no road map"):
        read_bare_map(path, 0)
