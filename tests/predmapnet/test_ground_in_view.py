"""The ground that cameras cover; a camera without an image has seen nothing."""

from __future__ import annotations

import numpy as np
import pytest
import shapely

from mapfusion import RegionOfInterest
from mapfusion.ground import ground_within
from predmapnet.demo_world.rig import DEMO_RIG
from predmapnet.scenes import Camera, ground_in_view

ROI = RegionOfInterest()


def forward_camera(width: int, centre: float, focal: float) -> Camera:
    pose = np.eye(4)
    pose[:3, :3] = [[0, 0, 1], [-1, 0, 0], [0, -1, 0]]
    return Camera("CAM", width, 900, np.array([[focal, 0, centre], [0, focal, 450.0], [0, 0, 1]]), pose)


def test_a_sector_follows_the_intrinsics():
    even = forward_camera(1600, 800.0, 800.0).sector
    assert even.heading == pytest.approx(0.0)
    assert even.field_of_view == pytest.approx(np.pi / 2)
    left = forward_camera(1600, 1600.0, 1600.0).sector
    assert left.heading == pytest.approx(np.pi / 8)


def test_six_cameras_see_all_and_one_that_is_missing_takes_its_part():
    assert ground_in_view(DEMO_RIG, ROI) is None
    ground = ground_within(ground_in_view([camera for camera in DEMO_RIG if camera.name != "CAM_BACK"], ROI))
    seen = shapely.contains_xy(ground, [20.0, 10.0, -5.0, -25.0], [0.0, -10.0, 10.0, 0.0])
    assert seen.tolist() == [True, True, True, False]
    assert ground_in_view([], ROI) == ()
