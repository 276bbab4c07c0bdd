"""Visible ground: a missing detection counts against an element only where it could have been seen."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st

from mapfusion import ElementKind, FrameMap, GlobalMap, MapIntegrator
from mapfusion.geometry import transform_points
from mapfusion.ground import CameraSector, ground_within, seen_along, visible_ground
from tests.mapfusion.integrate.test_integrator_properties import frame_map, integrate
from tests.mapfusion.map_quality import dense, nearest
from tests.mapfusion.simulation import BOUNDARY, CROSSING, DIVIDER, ROI, Detector, element, pose, simulate

ROAD = GlobalMap(
    (
        element(DIVIDER, np.array([[-60.0, 0.0], [60.0, 0.0]])),
        element(BOUNDARY, np.array([[-60.0, 8.0], [60.0, 8.0]])),
        element(CROSSING, np.array([[6.0, 2.0], [10.0, 2.0], [10.0, 7.0], [6.0, 7.0], [6.0, 2.0]])),
    )
)
TRUCK = np.array([[-2.0, 0.5], [14.0, 0.5], [14.0, 1.8], [-2.0, 1.8]])
"""Parked between the car's lane and the crossing and the kerb."""
SURE = Detector(drop_out=0.1, ghosts=0.0, id_switch=0.0)


def parked_drive(hidden: int, frames: int = 40, seed: int = 0):
    """A car that waits for 40 frames; a truck stands beside it in the last ``hidden`` of them."""
    poses = [pose(0.05 * i, -2.0, 0.0) for i in range(frames)]
    trucks = [[TRUCK] if i >= frames - hidden else [] for i in range(frames)]
    return simulate(ROAD, poses, np.random.default_rng(seed), SURE, trucks=trucks)


def held(found: GlobalMap, kind: ElementKind, points) -> float:
    """Share of a line that the map has."""
    return float((nearest(dense(np.array(points, dtype=float)), [e.points for e in found.of_kind(kind)]) < 0.5).mean())


KERB = [[2.0, 8.0], [12.0, 8.0]]


@pytest.mark.parametrize("seed", range(3))
def test_what_a_parked_truck_hides_stays(seed):
    drive = parked_drive(hidden=30, seed=seed)
    found = integrate(drive.frames)
    assert held(found, BOUNDARY, KERB) == 1.0
    assert len(found.of_kind(CROSSING)) == 1
    blind = integrate([replace(frame, visible=None) for frame in drive.frames])
    assert held(blind, BOUNDARY, KERB) < 0.5
    assert len(blind.of_kind(CROSSING)) == 0


def test_a_truck_for_half_of_a_drive_costs_no_certainty():
    before = integrate(parked_drive(hidden=20).frames[:20])
    after = integrate(parked_drive(hidden=20).frames)
    kerb = lambda found: max(e.confidence for e in found.of_kind(BOUNDARY))  # noqa: E731
    assert held(after, BOUNDARY, KERB) == 1.0
    assert kerb(after) >= kerb(before) - 0.01


def test_what_is_gone_dies_though_other_ground_is_hidden():
    line, other = [[5.0, -6.0], [20.0, -6.0]], [[5.0, 8.0], [12.0, 8.0]]
    hidden = visible_ground(ROI, [CameraSector(np.zeros(2))], [TRUCK])
    frames = [frame_map([line, other], [2, 2], number=i) for i in range(10)]
    frames += [replace(frame_map([], number=i), visible=hidden) for i in range(10, 40)]
    found = integrate(frames)
    assert held(found, BOUNDARY, line) == 0.0
    assert held(found, BOUNDARY, other) == 1.0


@pytest.mark.parametrize("visible", [(np.array([[0.0, np.nan], [1.0, 0.0], [1.0, 1.0]]),), (np.zeros((2, 2)),)])
def test_broken_ground_is_counted(visible):
    integrator = MapIntegrator()
    integrator.add(replace(frame_map([[[0, 0], [10, 0]]]), visible=visible))
    assert integrator.rejections == {"visible ground is no polygon": 1}
    assert integrator.frames == 0


def test_all_of_the_region_visible_is_as_if_nothing_were_said():
    drive = parked_drive(hidden=0)
    wide = (np.array([[-90.0, -90.0], [90.0, -90.0], [90.0, 90.0], [-90.0, 90.0]]),)
    plain = integrate([replace(frame, visible=None) for frame in drive.frames])
    said = integrate([replace(frame, visible=wide) for frame in drive.frames])
    for one, two in zip(plain, said, strict=True):
        assert one.confidence == two.confidence
        np.testing.assert_array_equal(one.points, two.points)


@settings(max_examples=40, deadline=None, derandomize=True)
@given(st.floats(-25, 25), st.floats(-12, 12), st.floats(0, 6.3), st.floats(0.5, 4.0))
def test_a_point_is_hidden_if_the_thing_crosses_its_sight(x, y, turn, size):
    axis = np.array([np.cos(turn), np.sin(turn)])
    across = np.array([-axis[1], axis[0]])
    thing = np.array([[x, y] + a * size * axis + b * across for a, b in ((1, 1), (-1, 1), (-1, -1), (1, -1))])
    eye = np.array([1.0, 0.5])
    box = shapely.Polygon(thing)
    if shapely.distance(box, shapely.Point(eye)) < 0.3:
        return
    ground = ground_within(visible_ground(ROI, [CameraSector(eye)], [thing]))
    points = np.random.default_rng(0).uniform([-29, -14], [29, 14], (200, 2))
    sight = shapely.linestrings(np.stack([np.broadcast_to(eye, points.shape), points], axis=1))
    clear = shapely.distance(box, sight)
    inside = shapely.contains_xy(ground, points)
    assert (inside == (clear > 0.0))[(clear > 0.01) | (clear == 0.0)].mean() > 0.98
    assert not inside[shapely.distance(shapely.buffer(box, -0.01), sight) == 0.0].any()


def test_a_front_camera_sees_what_is_ahead():
    rings = visible_ground(ROI, [CameraSector(np.array([1.5, 0.0]), 0.0, np.radians(90.0))])
    ground = ground_within(rings)
    assert shapely.contains_xy(ground, [10.0, 10.0, -5.0, 20.0], [0.0, 9.0, 0.0, -14.0]).tolist() == [
        True,
        False,
        False,
        True,
    ]


def test_ground_of_a_frame_lies_where_the_car_was():
    frame: FrameMap = replace(
        frame_map([], ego_to_global=pose(100.0, 50.0, np.pi / 2)),
        visible=(np.array([[0, -5], [10, -5], [10, 5], [0, 5]]),),
    )
    ground = seen_along([frame])
    expected = transform_points(frame.ego_to_global, np.array([[5.0, 0.0]]))[0]
    assert ground.area == pytest.approx(100.0)
    assert shapely.distance(ground.centroid, shapely.Point(expected)) < 1e-9


def test_ground_seen_along_a_drive_is_the_union_of_its_frames_and_nothing_that_a_missing_camera_would_have_seen():
    front = visible_ground(ROI, [CameraSector(np.zeros(2), 0.0, np.radians(120.0))])
    poses = [pose(20.0 * number, 0.0, 0.3 * number) for number in range(4)]
    frames = [frame_map([], ego_to_global=place) for place in poses]
    frames = [replace(frame, visible=front if number > 1 else None) for number, frame in enumerate(frames)]
    seen = seen_along(frames)
    assert seen.equals(shapely.union_all([seen_along([frame]) for frame in frames]))
    behind_the_last = transform_points(poses[-1], np.array([[-25.0, 12.0]]))[0]
    assert not shapely.contains_xy(seen, *behind_the_last)
    assert shapely.contains_xy(seen, *transform_points(poses[0], np.array([[-25.0, 12.0]]))[0])
