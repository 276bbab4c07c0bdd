from dataclasses import replace

import numpy as np
import pytest
import shapely

from predmapnet.demo_world.catalogue import town_of, trajectory
from predmapnet.demo_world.town.mirror import mirrored
from predmapnet.demo_world.town.routes import NoDriveError, drive

NAMES = [f"scene-{number:04d}" for number in (101, 103, 201, 218, 226, 228, 106, 203)]


def heading(poses):
    return np.arctan2(poses[:, 1, 0], poses[:, 0, 0])


@pytest.fixture(scope="module")
def drives():
    return {name: trajectory(name) for name in NAMES}


def test_the_same_scene_is_driven_the_same_way(drives):
    again = drive(town_of("scene-0103"), 103)
    assert again.ego_to_global.tobytes() == drives["scene-0103"].ego_to_global.tobytes()
    assert again.timestamps.tobytes() == drives["scene-0103"].timestamps.tobytes()


def test_a_town_without_streets_for_a_drive_is_told_from_one_with_a_fault():
    town = town_of("scene-0103")
    alleys = tuple(way for way in town.carriageways if not way.main)
    with pytest.raises(NoDriveError):
        drive(replace(town, carriageways=alleys), 103)


def test_oncoming_lanes_lie_to_the_left_unless_the_town_drives_on_the_left(drives):
    assert len({town_of(name).vector_map.left_hand for name in NAMES}) == 2
    for name, driven in drives.items():
        town_map = town_of(name).vector_map
        lines = [shapely.LineString(path) for path in town_map.lane_paths]
        tree = shapely.STRtree(lines)
        to_the_left = []
        for pose in driven.ego_to_global:
            for row in tree.query(shapely.Point(pose[:2, 3]), predicate="dwithin", distance=9.0):
                at = lines[row].project(shapely.Point(pose[:2, 3]))
                if not 0.5 < at < lines[row].length - 0.5:
                    continue
                first, last = (shapely.get_coordinates(lines[row].interpolate(at + d))[0] for d in (-0.5, 0.5))
                if (last - first) @ pose[:2, 0] < -0.95 * np.linalg.norm(last - first):
                    to_the_left.append((first - pose[:2, 3]) @ pose[:2, 1] > 0)
        assert len(to_the_left) > 5
        share = np.mean(to_the_left)
        assert share < 0.05 if town_map.left_hand else share > 0.95


@pytest.mark.parametrize("name", NAMES)
def test_poses_are_rigid_and_half_a_second_apart(name, drives):
    driven = drives[name]
    poses = driven.ego_to_global
    assert poses.shape == (40, 4, 4)
    assert (np.diff(driven.timestamps) == 500_000_000).all()
    assert (driven.timestamps % 1000 == 0).all()
    np.testing.assert_allclose(
        poses[:, :3, :3] @ poses[:, :3, :3].swapaxes(1, 2), np.tile(np.eye(3), (40, 1, 1)), atol=1e-12
    )
    np.testing.assert_array_equal(poses[:, 2, 3], 0.0)
    assert np.degrees(np.arccos(poses[:, 2, 2])).max() < 0.8


@pytest.mark.parametrize("name", NAMES)
def test_car_stays_on_the_road_and_out_of_the_way_of_oncoming_cars(name, drives):
    town = town_of(name)
    lanes, paths = town.vector_map.lanes, town.vector_map.lane_paths
    surface = shapely.union(shapely.union_all(town.vector_map.road_segments), shapely.union_all(lanes))
    tree = shapely.STRtree(lanes)
    poses = drives[name].ego_to_global
    rear_axle = np.stack([poses[:, :2, 3] + side * 0.8 * poses[:, :2, 1] for side in (-1, 1)])
    assert surface.buffer(0.05).contains(shapely.MultiPoint(rear_axle.reshape(-1, 2)))
    for pose in poses:
        for lane in tree.query(shapely.Point(pose[:2, 3]), predicate="within"):
            nearest = int(np.argmin(np.linalg.norm(paths[lane][:-1] - pose[:2, 3], axis=1)))
            along = paths[lane][nearest + 1] - paths[lane][nearest]
            assert along @ pose[:2, 0] > 0.8 * np.linalg.norm(along), "the car drives against the traffic"


@pytest.mark.parametrize("name", NAMES)
def test_a_person_could_drive_like_that(name, drives):
    poses = drives[name].ego_to_global
    steps = np.diff(poses[:, :2, 3], axis=0)
    speed = np.linalg.norm(steps, axis=1) / 0.5
    turned = np.abs(np.angle(np.exp(1j * np.diff(heading(poses)))))
    assert speed.max() < 12.1
    assert speed.mean() > 3.0
    assert np.abs(np.diff(speed) / 0.5).max() < 2.6
    assert (turned / 0.5 * speed).max() < 3.2, "sideways acceleration"
    moving = speed > 1.0
    course = np.arctan2(steps[:, 1], steps[:, 0])
    middle = heading(poses)[:-1] + np.angle(np.exp(1j * np.diff(heading(poses)))) / 2
    assert np.abs(np.angle(np.exp(1j * (course - middle))))[moving].max() < np.radians(6.0)


def test_drives_turn_stop_and_never_see_the_end_of_the_world(drives):
    turning = [
        np.degrees(np.abs(np.angle(np.exp(1j * np.diff(heading(driven.ego_to_global)))).sum()))
        for driven in drives.values()
    ]
    assert np.mean(np.array(turning) > 45.0) > 0.4
    standing = [
        (np.linalg.norm(np.diff(driven.ego_to_global[:, :2, 3], axis=0), axis=1) < 0.05).any()
        for driven in drives.values()
    ]
    assert 0.05 < np.mean(standing) < 0.8
    for name, driven in drives.items():
        town = town_of(name)
        ends = np.array(
            [way.lines[0][end] for way in town.carriageways for end in (0, -1) if way.nodes[end] < 0], dtype=np.float64
        )
        ends = mirrored(ends) if town.vector_map.left_hand else ends
        gaps = np.linalg.norm(driven.ego_to_global[:, None, :2, 3] - ends, axis=2)
        # The corner of the region of interest lies 33.5 m from its middle.
        assert gaps.min() > 34.0


def test_there_is_enough_to_see_around_the_car(drives):
    crossings, dividers, boundaries = [], [], []
    for name, driven in drives.items():
        town_map = town_of(name).vector_map
        surface = shapely.union(shapely.union_all(town_map.road_segments), shapely.union_all(town_map.lanes))
        for pose in driven.ego_to_global[::4]:
            corners = np.array([[-30, -15], [30, -15], [30, 15], [-30, 15]]) @ pose[:2, :2].T + pose[:2, 3]
            roi = shapely.Polygon(corners)
            crossings.append(sum(roi.intersection(crossing.polygon).area > 5 for crossing in town_map.crossings))
            lengths = [roi.intersection(shapely.LineString(line.points)).length for line in town_map.dividers]
            dividers.append(sum(length > 2 for length in lengths))
            boundaries.append(len(shapely.get_parts(roi.buffer(-0.2).intersection(surface.boundary))))
    assert 0.6 < np.mean(np.array(crossings) > 0) < 0.97
    assert 1.5 < np.mean(dividers) < 7.0
    assert 2.0 < np.mean(boundaries) < 7.0
