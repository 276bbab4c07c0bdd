"""Which ground cameras look at; a camera without an image has seen nothing."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import shapely

from mapfusion import RegionOfInterest
from mapfusion.ground import ground_within
from predmapnet.demo_world.rig import DEMO_RIG
from predmapnet.field_of_view import sector_of, seen_by, seen_in
from predmapnet.scenes import Camera, Frame

ROI = RegionOfInterest()


def forward_camera(width: int, centre: float, focal: float) -> Camera:
    pose = np.eye(4)
    pose[:3, :3] = [[0, 0, 1], [-1, 0, 0], [0, -1, 0]]
    return Camera("CAM", width, 900, np.array([[focal, 0, centre], [0, focal, 450.0], [0, 0, 1]]), pose)


def test_a_sector_follows_the_intrinsics():
    even = sector_of(forward_camera(1600, 800.0, 800.0))
    assert even.heading == pytest.approx(0.0)
    assert even.field_of_view == pytest.approx(np.pi / 2)
    left = sector_of(forward_camera(1600, 1600.0, 1600.0))
    assert left.heading == pytest.approx(np.pi / 8)


def test_six_cameras_see_all_and_one_that_is_missing_takes_its_part():
    rig = DEMO_RIG
    assert seen_by(rig, ROI) is None
    images = {camera.name: Path(camera.name) for camera in rig if camera.name != "CAM_BACK"}
    frame = Frame("scene", 0, "token", 0, np.eye(4), rig, images)
    ground = ground_within(seen_in(frame, ROI))
    assert shapely.contains_xy(ground, [20.0, 10.0, -5.0, -25.0], [0.0, -10.0, 10.0, 0.0]).tolist() == [
        True,
        True,
        True,
        False,
    ]
    nobody = Frame("scene", 0, "token", 0, np.eye(4), rig, {})
    assert seen_in(nobody, ROI) == ()
