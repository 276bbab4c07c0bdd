"""Heights of elements come from the road under the car, and survive files, edits and merges."""

from __future__ import annotations

import json

import numpy as np
import pytest
from pyarrow import feather
from scipy.spatial import cKDTree

from mapfusion import ElementKind, FrameMap, GlobalMap, MapElement, MapIntegrator, RegionOfInterest
from mapfusion.formats.by_suffix import SUFFIXES, read_map, write_map
from mapfusion.formats.local_plane import LocalPlane
from mapfusion.merge.merge import merge_maps
from mapfusion.road_heights import RoadHeights
from tests.mapfusion.argoverse import LOGS

PLANE = LocalPlane(8.4, 49.0, "hill")
SECOND = 1_000_000_000
GROUND = -0.33


def hill(x):
    return 40.0 + 3.0 * np.sin(np.asarray(x) / 30.0)


def drive(count=40, step=4.0, y=0.0, road=hill, start=0, ground=GROUND):
    """Frames of a car that drives along x; its ego origin lies above the road, and a line lies 3 m to the left."""
    frames = []
    for index in range(count):
        pose = np.eye(4)
        pose[:3, 3] = [step * index, y, float(road(step * index)) - ground]
        line = np.stack([np.linspace(-30.0, 30.0, 20), np.full(20, 3.0)], axis=1)
        frames.append(
            FrameMap(start + index * SECOND, pose, RegionOfInterest(), [1], [0.9], [7], (line,), ground_height=ground)
        )
    return frames


def line(points, first=0, last=100 * SECOND, kind=ElementKind.DIVIDER, **more):
    return MapElement(kind, np.array(points, dtype=np.float64), 0.9, 9, first, last, (1,), **more)


def test_lines_lie_on_the_road_that_was_driven():
    integrator = MapIntegrator()
    frames = drive()
    for frame in frames:
        integrator.add(frame, "drive")
    lifted = RoadHeights.along(frames).lifted_map(integrator.map())
    (found,) = lifted.elements
    beside = (found.points[:, 0] > 5) & (found.points[:, 0] < 151)
    assert beside.sum() > 5, "a straight line over a hill needs vertices on the slopes"
    np.testing.assert_allclose(found.heights[beside], hill(found.points[beside, 0]), atol=0.1)
    between = np.linspace(5, 151, 500)
    order = np.argsort(found.points[:, 0])
    np.testing.assert_allclose(
        np.interp(between, found.points[order, 0], found.heights[order]), hill(between), atol=0.25
    )
    assert len(found.deviation) == len(found.points)


def test_a_bridge_and_the_road_under_it_keep_their_heights():
    below = drive(road=lambda x: 0 * x + 10.0 + 0.001 * x)
    above = drive(road=lambda x: 0 * x + 16.0, start=1000 * SECOND)
    heights = RoadHeights.along([*below, *above])
    low = heights.lifted(line([[0, 3], [100, 3]], 0, 40 * SECOND))
    high = heights.lifted(line([[0, 3], [100, 3]], 1000 * SECOND, 1040 * SECOND))
    assert np.abs(low.heights - 10.05).max() < 0.1
    assert np.abs(high.heights - 16.0).max() < 0.01


def test_what_is_not_known_stays_absent():
    flat = drive(road=lambda x: 0 * x)
    assert RoadHeights.along(flat).lifted(line([[0, 3], [50, 3]])).heights is None
    heights = RoadHeights.along(drive())
    assert heights.lifted(line([[0, 300], [50, 300]])).heights is None
    assert RoadHeights.along([]).lifted(line([[0, 3], [50, 3]])).heights is None


def test_merged_lines_have_the_mean_height_of_the_maps_that_know_one():
    x = np.linspace(0, 150, 40)
    points = np.stack([x, np.full(40, 3.0)], axis=1)
    ring = [[20, 8], [24, 8], [24, 16], [20, 16], [20, 8]]
    maps = [
        GlobalMap(
            (
                line(points + 0.1 * shift, heights=hill(x) + shift),
                line(ring, kind=ElementKind.PED_CROSSING, heights=np.full(5, 41.0 + shift)),
            )
        )
        for shift in (-0.2, 0.4)
    ]
    maps.append(GlobalMap((line(points), line(ring, kind=ElementKind.PED_CROSSING))))
    merged, _ = merge_maps(maps)
    for element in merged:
        expected = 41.1 if element.kind.is_ring else hill(element.points[:, 0]) + 0.1
        np.testing.assert_allclose(element.heights, np.broadcast_to(expected, len(element.points)), atol=0.1)
    alone, _ = merge_maps([maps[2]])
    assert all(element.heights is None for element in alone)


@pytest.mark.parametrize("ending", [suffix for suffix in SUFFIXES if suffix != ".json"])
def test_files_keep_heights_and_their_absence(tmp_path, ending):
    known = line([[0, 0], [10, 1], [20, 0]], kind=ElementKind.BOUNDARY, heights=np.array([101.25, 102.5, -3.125]))
    ring = line([[0, 5], [4, 5], [4, 9], [0, 5]], kind=ElementKind.PED_CROSSING, heights=np.array([1.0, 2, 3, 1]))
    unknown = line([[0, -5], [20, -5]])
    path = tmp_path / f"map{ending}"
    write_map(GlobalMap((known, ring, unknown)), path, PLANE)
    found = read_map(path, PLANE)
    assert found.notes == ()
    for before in (known, ring):
        (after,) = found.of_kind(before.kind)
        corner = np.argmin(np.linalg.norm(before.points[:-1] - after.points[0], axis=1))  # a ring may begin elsewhere
        heights = np.roll(before.heights[:-1], -corner) if before is ring else before.heights[:-1]
        np.testing.assert_allclose(after.heights[:-1], heights, atol=1e-3)
    assert found.of_kind(unknown.kind)[0].heights is None


def test_geojson_positions_and_box_have_three_numbers(tmp_path):
    path = tmp_path / "map.geojson"
    write_map(GlobalMap((line([[0, 0], [10, 1]], heights=np.array([5.0, 6.0])),)), path, PLANE)
    document = json.loads(path.read_text())
    assert [position[2] for position in document["features"][0]["geometry"]["coordinates"]] == [5.0, 6.0]
    assert len(document["bbox"]) == 6
    assert (document["bbox"][2], document["bbox"][5]) == (5.0, 6.0)


def test_a_vertex_without_a_height_gets_one_from_its_neighbours(tmp_path):
    path = tmp_path / "map.geojson"
    write_map(GlobalMap((line([[0, 0], [10, 0], [20, 0]], heights=np.array([5.0, 9.0, 7.0])),)), path, PLANE)
    document = json.loads(path.read_text())
    position = document["features"][0]["geometry"]["coordinates"][1]
    for edited in (position[:2], [*position[:2], 0.0]):
        document["features"][0]["geometry"]["coordinates"][1] = edited
        path.write_text(json.dumps(document))
        found = read_map(path, PLANE)
        np.testing.assert_allclose(found.elements[0].heights, [5.0, 6.0, 7.0], atol=1e-6)
        assert any("without a height" in note for note in found.notes)


@pytest.mark.reference
def test_heights_of_a_real_drive_are_those_of_the_surveyed_map():
    """Poses of Argoverse 2 logs against the heights of the lane boundaries beside the car."""
    logs = sorted(LOGS.glob("*/map"))
    if not logs:
        pytest.skip("no reference logs")
    for folder in logs:
        poses = feather.read_table(folder.parent / "city_SE3_egovehicle.feather")
        frames = []
        for row in poses.to_pylist()[::20]:
            pose = np.eye(4)
            pose[:3, 3] = row["tx_m"], row["ty_m"], row["tz_m"]
            frames.append(FrameMap(row["timestamp_ns"], pose, RegionOfInterest(), [], [], [], (), ground_height=GROUND))
        archive = json.loads(next(folder.glob("log_map_archive_*.json")).read_text())
        lanes = archive["lane_segments"].values()
        surveyed = np.array(
            [
                [point[axis] for axis in "xyz"]
                for lane in lanes
                for side in ("left_lane_boundary", "right_lane_boundary")
                for point in lane[side]
            ]
        )
        road = RoadHeights.along(frames)
        near = cKDTree(road.points).query(surveyed[:, :2])[0] < 5.0
        error = road.at(surveyed[near, :2]) - surveyed[near, 2]
        assert near.sum() > 50
        assert abs(np.median(error)) < 0.1
        assert np.percentile(np.abs(error), 90) < 0.25
