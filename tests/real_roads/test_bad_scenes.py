"""Bad days change what a mapper is told, by as much as they say, and never what is true."""

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from mapfusion.elements import RegionOfInterest
from mapfusion.geometry import inverse_pose
from predmapnet.datasets.images import read_image
from predmapnet.datasets.own_logs.calibration import write_rig
from predmapnet.datasets.own_logs.scene import LogScene
from predmapnet.datasets.own_logs.timed_poses import TimedPoses, write_timed_poses
from predmapnet.demo_world.rig import DEMO_RIG
from predmapnet.mapping import FRAMES_AHEAD
from tests.benchmarks.bad_days import CLEAN, Remains, conditions, mean_shares
from tests.real_roads.bad_scenes import (
    FaultyImages,
    LostCameras,
    LostImages,
    jumping_poses,
    late_cameras,
    lost_frames,
    noisy_poses,
    off_calibration,
)
from tests.real_roads.dressed import image_path
from tests.real_roads.image_faults import brighter
from tests.real_roads.street import EVERY_IMAGE

FRAMES = 30
SPEED = 6.0
RIG = tuple(
    replace(camera, width=80, height=45, intrinsics=np.diag([0.1, 0.1, 1.0]) @ camera.intrinsics) for camera in DEMO_RIG
)


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    """A car that drives along x past one line, 2 frames a second."""
    folder = tmp_path_factory.mktemp("log")
    poses = np.tile(np.eye(4), (FRAMES, 1, 1))
    poses[:, 0, 3] = SPEED * 0.5 * np.arange(FRAMES)
    stamps = 500_000_000 * np.arange(1, FRAMES + 1, dtype=np.int64)
    write_rig(folder / "calibration.json", RIG)
    write_timed_poses(folder / "poses.csv", TimedPoses(stamps, poses))
    for camera in RIG:
        for stamp in stamps.tolist():
            path = image_path(folder, camera.name, stamp)
            path.parent.mkdir(parents=True, exist_ok=True)
            cv2.imwrite(str(path), np.full((45, 80, 3), 100, dtype=np.uint8))
    truth = {"elements": [{"kind": "divider", "points": [[-50.0, 3.0], [150.0, 3.0]]}]}
    (folder / "truth.json").write_text(json.dumps(truth))
    return LogScene(folder, EVERY_IMAGE)


def angle(first, second) -> float:
    """Degrees between two rotations."""
    return float(np.degrees(np.arccos(np.clip((np.trace(first.T @ second) - 1) / 2, -1, 1))))


def test_faulty_images_reach_the_mapper_as_files_without_loss(scene, tmp_path):
    frame = FaultyImages(scene, brighter, 2, tmp_path).frame(3)
    assert set(frame.images) == {camera.name for camera in RIG}
    before, after = scene.frame(3).images["CAM_BACK"], frame.images["CAM_BACK"]
    assert isinstance(after, Path)
    np.testing.assert_array_equal(read_image(after), np.round(read_image(before).astype(int) * 1.8))


def test_images_stay_while_frames_are_seen_ahead(scene, tmp_path):
    bad = FaultyImages(scene, lambda image, shot, _: np.full_like(image, shot.index), 1, tmp_path)
    frames = [bad.frame(index) for index in range(5, 6 + FRAMES_AHEAD)]
    for index, frame in enumerate(frames, start=5):
        for image in frame.images.values():
            assert isinstance(image, Path) and (read_image(image) == index).all()


@pytest.mark.parametrize("degrees", [0.0, 0.5, 2.0])
def test_every_camera_is_off_by_the_angle_all_along(scene, degrees):
    bad = off_calibration(scene, degrees)
    for index in (0, 17):
        for told, true in zip(bad.frame(index).rig, scene.frame(index).rig, strict=True):
            assert angle(told.camera_to_ego[:3, :3], true.camera_to_ego[:3, :3]) == pytest.approx(degrees, abs=1e-5)
            np.testing.assert_allclose(told.camera_to_ego[:3, 3], true.camera_to_ego[:3, 3])
    for told, again in zip(bad.frame(0).rig, off_calibration(scene, degrees).frame(20).rig, strict=True):
        np.testing.assert_array_equal(told.camera_to_ego, again.camera_to_ego)


@pytest.mark.parametrize("seconds", [0.0, 0.05, 0.1])
def test_late_cameras_are_told_to_stand_ahead_by_the_way_of_the_car(scene, seconds):
    bad = late_cameras(scene, seconds)
    for index in (0, 12, FRAMES - 1):
        for told, true in zip(bad.frame(index).rig, scene.frame(index).rig, strict=True):
            ahead = told.camera_to_ego @ inverse_pose(true.camera_to_ego)
            np.testing.assert_allclose(ahead[:3, 3], [SPEED * seconds, 0.0, 0.0], atol=1e-6)
            np.testing.assert_allclose(ahead[:3, :3], np.eye(3), atol=1e-9)


def test_noisy_poses_have_the_deviation_and_leave_the_truth_alone(scene):
    bad = noisy_poses(scene, 0.3)
    shift = np.array([bad.frame(i).ego_to_global - scene.frame(i).ego_to_global for i in range(FRAMES)])
    assert 0.2 < shift[:, :2, 3].std() < 0.4
    np.testing.assert_array_equal(shift[:, :, :3], 0.0)
    np.testing.assert_array_equal(bad.instant(7).ego_to_global, bad.frame(7).ego_to_global)
    roi = RegionOfInterest()
    told = bad.truths(roi)
    assert told is not None
    for bad_truth, truth in zip(told, scene.truths(roi), strict=True):
        np.testing.assert_array_equal(bad_truth.polylines[0], truth.polylines[0])


def test_jumping_poses_jump_by_the_distance_and_stay(scene):
    bad = jumping_poses(scene, 1.0, every=10)
    shift = np.array([bad.frame(i).ego_to_global[:2, 3] - scene.frame(i).ego_to_global[:2, 3] for i in range(FRAMES)])
    jumps = np.linalg.norm(np.diff(shift, axis=0), axis=1)
    np.testing.assert_allclose(shift[:10], 0.0)
    np.testing.assert_allclose(jumps[[9, 19]], 1.0, atol=1e-9)
    np.testing.assert_allclose(np.delete(jumps, [9, 19]), 0.0, atol=1e-9)


def test_lost_images_and_frames_are_as_many_as_said_and_never_all(scene):
    kept = [len(LostImages(scene, 0.3).frame(index).images) for index in range(FRAMES)]
    assert np.mean(kept) / len(RIG) == pytest.approx(0.7, abs=0.08)
    assert [len(LostImages(scene, 1.0).frame(index).images) for index in range(FRAMES)] == [1] * FRAMES
    assert [len(LostImages(scene, 0.0).frame(index).images) for index in range(3)] == [len(RIG)] * 3
    # What is lost at a small share is lost at a large one, too.
    few, many = (set(LostImages(scene, share).frame(4).images) for share in (0.5, 0.1))
    assert few <= many
    assert len(lost_frames(scene, 0.0)) == FRAMES and len(lost_frames(scene, 1.0)) == 1
    bad = lost_frames(scene, 0.5)
    assert 8 < len(bad) < 22
    assert [bad.frame(index).index for index in range(len(bad))] == list(range(len(bad)))
    assert bad.frame(3).timestamp == bad.instant(3).timestamp


def test_a_lost_camera_has_no_image_but_stays_in_the_rig(scene):
    frame = LostCameras(scene, ("CAM_FRONT",)).frame(0)
    assert "CAM_FRONT" not in frame.images and len(frame.images) == len(frame.rig) - 1


def test_severities_begin_at_1_and_names_differ(tmp_path):
    found = list(conditions([camera.name for camera in RIG], tmp_path))
    assert found[0].family == CLEAN and found[0].severity == 0
    assert {condition.severity for condition in found[1:]} == {1, 2, 3}
    assert len({condition.name for condition in found}) == len(found)
    for family in {condition.family for condition in found[1:]}:
        assert min(condition.severity for condition in found if condition.family == family) == 1


def test_conditions_make_scenes_that_yield_frames_and_truth(scene, tmp_path):
    for condition in conditions([camera.name for camera in RIG], tmp_path):
        if condition.name == "5 Hz":  # Renders.
            continue
        bad = condition.apply(scene, tmp_path)
        frame = bad.frame(1)
        assert frame.images and frame.index == 1, condition.name
        truths = bad.truths(RegionOfInterest())
        assert truths is not None and len(truths) == len(bad), condition.name


def test_means_count_every_family_the_same(tmp_path):
    found = list(conditions(["A", "B"], tmp_path))
    clean, lost = found[0], [condition for condition in found if condition.family == "camera lost"]
    noise = [condition for condition in found if condition.family == "noise"]
    rows = [(clean, Remains(0.8, 0.8, 0.8, 40))]
    rows += [(condition, Remains(0.4, 0.8, 0.0, 40)) for condition in lost]
    rows += [(condition, Remains(value, 0.8, 0.8, 40)) for condition, value in zip(noise, (0.8, 0.8, 0.2), strict=True)]
    means = mean_shares(rows)
    np.testing.assert_allclose(means["mean at the first severity"], [0.75, 1.0, 0.5])
    np.testing.assert_allclose(means["mean over all"], [(0.5 + 0.75) / 2, 1.0, 0.5])
