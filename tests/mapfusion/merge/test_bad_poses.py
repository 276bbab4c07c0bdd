"""Three drives with bad poses make a map nearly as good as one with perfect poses."""

import numpy as np
import pytest

from tests.benchmarks.merge_under_noise import detections, mapped, merged, town
from tests.mapfusion.pose_noise import off_by_drive, off_by_frame


@pytest.fixture(scope="module")
def place():
    return town("scene-0001")


@pytest.fixture(scope="module")
def drives(place):
    return [detections(place, 5, number) for number in range(3)]


def noisy(drives, noise, correct):
    return [mapped(frames, noise, np.random.default_rng([7, n]), correct) for n, frames in enumerate(drives)]


@pytest.mark.parametrize(("noise", "correct"), [(off_by_frame, True), (off_by_drive, False)])
def test_three_drives_with_bad_poses_are_nearly_as_good_as_one_with_perfect_poses(place, drives, noise, correct):
    perfect = merged(place, [mapped(drives[0], None, np.random.default_rng(0), False)])
    one, three = (merged(place, noisy(drives[:count], noise, correct)) for count in (1, 3))
    assert three.common_f1 >= perfect.f1 - 0.05
    assert three.common_sideways < 0.3
    if correct:  # errors of single frames have no common motion
        assert three.f1 >= perfect.f1 - 0.05
        assert one.f1 > merged(place, noisy(drives[:1], noise, False)).f1
