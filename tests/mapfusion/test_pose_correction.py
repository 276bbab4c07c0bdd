"""Poses of single frames are corrected by what the frames show together, and by nothing else."""

from dataclasses import replace

import numpy as np

from mapfusion import ElementKind, FrameMap, RegionOfInterest, correct_poses
from tests.mapfusion.pose_noise import off_by_frame, remaining_errors
from tests.mapfusion.simulation import pose, town_drive


def placed(frames, poses):
    return [replace(frame, ego_to_global=at) for frame, at in zip(frames, poses, strict=True)]


def straight_road(poses):
    """Two kerbs along the x axis as each pose sees them, without an end in sight."""
    x = np.linspace(-30.0, 30.0, 20)
    lines = tuple(np.stack([x, np.full(20, y)], axis=1) for y in (-6.0, 7.0))
    return [
        FrameMap(i, at, RegionOfInterest(), np.full(2, ElementKind.BOUNDARY), np.ones(2), np.arange(2), lines)
        for i, at in enumerate(poses)
    ]


def test_frames_correct_each_other():
    drive = town_drive(3, frames=30)
    true = [frame.ego_to_global for frame in drive.frames]
    off = off_by_frame(true, np.random.default_rng(1))
    corrected = correct_poses(placed(drive.frames, off))
    before, after = remaining_errors(off, true), remaining_errors([f.ego_to_global for f in corrected], true)
    assert after[0] < 0.4 * before[0] and after[1] < 0.6 * before[1] and after[2] < 0.7 * before[2]
    assert [f.timestamp for f in corrected] == [f.timestamp for f in drive.frames]


def test_right_poses_stay():
    drive = town_drive(4, frames=30)
    true = [frame.ego_to_global for frame in drive.frames]
    sideways, along, turn = remaining_errors([f.ego_to_global for f in correct_poses(drive.frames)], true)
    assert sideways < 0.2 and along < 0.4 and turn < 0.6


def test_what_nothing_shows_stays_as_measured():
    """Along a straight road no frame knows better; across it they agree on their mean."""
    rng = np.random.default_rng(2)
    measured = [pose(4.0 * i + rng.normal(0, 1.5), rng.normal(0, 0.5), 0.0) for i in range(12)]
    corrected = correct_poses(straight_road(measured))
    found = np.array([f.ego_to_global[:2, 3] for f in corrected])
    was = np.array([at[:2, 3] for at in measured])
    np.testing.assert_allclose(found[:, 0], was[:, 0], atol=0.02)
    assert np.ptp(found[:, 1]) < 0.15 * np.ptp(was[:, 1])
    assert abs(found[:, 1].mean() - was[:, 1].mean()) < 0.1


def bend(poses):
    """A kerb that bends within 20 m, as each pose has it before itself."""
    angle = np.linspace(0.0, 1.4, 24)
    arc = np.stack([20.0 * np.sin(angle), 20.0 * (1.0 - np.cos(angle))], axis=1)
    return [
        FrameMap(i, at, RegionOfInterest(), [ElementKind.BOUNDARY], [1.0], [0], (arc,)) for i, at in enumerate(poses)
    ]


def test_a_frame_is_not_moved_by_what_it_shows_itself():
    """Along a bend the neighbours of a point lie on its inner side: a frame that counted its own would drift there."""
    measured = [pose(100.0 * i, 3.0 * i, 0.2) for i in range(3)]
    for frame, at in zip(correct_poses(bend(measured)), measured, strict=True):
        np.testing.assert_allclose(frame.ego_to_global, at, atol=1e-12)


def test_broken_frames_stay_as_they_are():
    frames = straight_road([pose(0.0, 0.0, 0.0), pose(4.0, 0.6, 0.0), pose(8.0, np.nan, 0.0), pose(12.0, 0.0, 0.0)])
    frames[3] = replace(frames[3], polylines=(np.full((3, 2), np.nan), np.zeros((1, 2))))
    corrected = correct_poses(frames)
    assert corrected[2] is frames[2]
    assert np.isfinite(corrected[1].ego_to_global).all()
    np.testing.assert_allclose(corrected[3].ego_to_global, frames[3].ego_to_global)
    assert correct_poses([]) == []
    alone = correct_poses(frames[:1])
    np.testing.assert_allclose(alone[0].ego_to_global, frames[0].ego_to_global)
