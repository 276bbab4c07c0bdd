"""Augmented frames: the mirrored world is one, and what is covered, lost or moved is what was asked for."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from mapfusion.geometry import inverse_pose, transform_points
from predmapnet.augmentation.frames import (
    AugmentationSettings,
    augment,
    cover_grid,
    disturb_pose,
    drop_camera,
    mirror,
)
from predmapnet.augmentation.photography import PhotographySettings
from predmapnet.demo_world.rig import DEMO_RIG
from predmapnet.frame_cache.scene_cache import CachedFrame
from predmapnet.network.calibration import calibrate
from predmapnet.presets import preset
from predmapnet.scenes import FrameTruth
from tests.predmapnet.network.mirrored_rig import mirror_rig

LITE, PAPER = preset("lite"), preset("paper-nuscenes")


def drawn_frame(config, seed=0, rig=DEMO_RIG):
    generator = np.random.default_rng(seed)
    turn, pose = generator.uniform(-3, 3), np.eye(4)
    pose[:2, :2] = [[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]]
    pose[:3, 3] = generator.uniform(-90, 90, 3)
    height, width = 2, config.image.width
    return CachedFrame(
        pose,
        calibrate(rig, config),
        FrameTruth(np.array([1]), (generator.normal(size=(4, 2)),), np.array([3])),
        generator.integers(0, 255, (len(rig), height, width, 3), dtype=np.uint8),
        np.array([False] + [True] * (len(rig) - 1)),
        generator.integers(-1, 60, (len(rig), 3, 100)),
    )


@pytest.mark.parametrize("config", [LITE, PAPER], ids=["lite", "paper"])
def test_mirroring_twice_changes_nothing(config):
    frame = drawn_frame(config)
    once, again = mirror(frame, config), mirror(mirror(frame, config), config)
    for name in ("ego_to_global", "images", "camera_valid", "depth"):
        np.testing.assert_allclose(getattr(again, name), getattr(frame, name), atol=1e-12)
    for name, value in vars(frame.calibration).items():
        torch.testing.assert_close(getattr(again.calibration, name), value, atol=1e-9, rtol=0)
    np.testing.assert_array_equal(again.truth.polylines[0], frame.truth.polylines[0])
    assert not np.array_equal(once.images, frame.images) and not np.array_equal(once.depth, frame.depth)
    assert np.isclose(np.linalg.det(once.ego_to_global[:3, :3]), 1.0), "still a rotation"


@pytest.mark.parametrize("config", [LITE, PAPER], ids=["lite", "paper"])
def test_mirrored_calibrations_are_those_of_the_mirrored_cars_cameras(config):
    found, expected = mirror(drawn_frame(config), config).calibration, calibrate(mirror_rig(DEMO_RIG), config)
    assert torch.allclose(found.ego_to_image, expected.ego_to_image, atol=1e-9)
    assert torch.equal(found.image_size, expected.image_size)


def test_a_mirrored_left_camera_has_the_learned_code_of_the_right_one():
    codes = mirror(drawn_frame(PAPER), PAPER).calibration.camera_code[0].tolist()
    names = [camera.name for camera in DEMO_RIG]
    assert [PAPER.bev.cameras[code] for code in codes] == [
        {"LEFT": name.replace("LEFT", "RIGHT"), "RIGHT": name.replace("RIGHT", "LEFT")}.get(name.split("_")[-1], name)
        for name in names
    ]
    assert mirror(drawn_frame(LITE), LITE).calibration.camera_code.tolist() == [[0] * 6]


def test_a_frame_is_taken_again_in_all_the_ways_that_are_asked_for():
    generator = np.random.default_rng(0)
    frame = replace(drawn_frame(LITE), images=generator.integers(0, 255, (6, 32, 64, 3), dtype=np.uint8))
    nothing = PhotographySettings(**dict.fromkeys(PhotographySettings.__dataclass_fields__, 0.0))
    asked = {
        "images": {"photography": PhotographySettings(exposure=1.5, noise=10.0)},
        "camera_valid": {"camera_dropout": 1.0},
        "calibration": {"bumped": 1.0},
    }
    exact = AugmentationSettings(photography=nothing, camera_dropout=0.0, bumped=0.0)
    for changed in (None, *asked):
        settings = replace(exact, **asked.get(changed, {}))
        again = augment(frame, settings, LITE.image, generator, bump=1)
        assert np.array_equal(again.images, frame.images) == (changed != "images")
        assert again.camera_valid.sum() == frame.camera_valid.sum() - (changed == "camera_valid")
        matrices = (each.calibration.ego_to_image for each in (again, frame))
        assert torch.equal(*matrices) == (changed != "calibration")
    covered = augment(frame, replace(exact, grid_mask=1.0), LITE.image, generator, bump=1)
    assert not np.array_equal(covered.images, frame.images)


def test_what_stands_in_the_world_stands_still_in_the_mirrored_one():
    frames = [drawn_frame(LITE, seed) for seed in range(2)]
    points = np.random.default_rng(2).uniform(-30, 30, (9, 2))
    flipped = []
    for frame in frames:
        local = transform_points(inverse_pose(frame.ego_to_global), points)
        seen = replace(frame, truth=replace(frame.truth, polylines=(local,)))
        mirrored = mirror(seen, LITE)
        flipped.append(transform_points(mirrored.ego_to_global, mirrored.truth.polylines[0]))
    np.testing.assert_allclose(flipped[0], points * [1, -1], atol=1e-9)
    np.testing.assert_allclose(flipped[1], flipped[0], atol=1e-9)


def test_depth_flips_within_the_image_and_not_into_its_padding():
    config = PAPER.model_copy(update={"image": PAPER.image.model_copy(update={"width": 784})})  # 98 of 100 cells
    frame = drawn_frame(config)
    mirrored = mirror(frame, config).depth
    np.testing.assert_array_equal(mirrored[:, :, :98], frame.depth[:, :, 97::-1])
    np.testing.assert_array_equal(mirrored[:, :, 98:], frame.depth[:, :, 98:])


@pytest.mark.parametrize("config", [LITE, PAPER], ids=["lite", "paper"])
def test_a_grid_covers_a_quarter_with_the_colour_that_the_network_takes_for_none(config):
    images = np.random.default_rng(0).integers(0, 80, (2, 96, 256, 3), dtype=np.uint8)
    mean = np.array(config.image.mean) * 255 if config is LITE else np.array(config.image.mean[::-1])
    shares = []
    for seed in range(60):
        covered = cover_grid(images, 1.0, config.image, np.random.default_rng(seed))
        changed = (covered != images).any(axis=-1)
        np.testing.assert_array_equal(covered[changed], np.broadcast_to(mean.round(), (changed.sum(), 3)))
        assert np.array_equal(changed[0], changed[1]), "alike in all cameras"
        shares.append(changed.mean())
    assert 0.18 < np.mean(shares) < 0.32
    assert cover_grid(images, 0.0, config.image, np.random.default_rng(0)) is images


def test_a_lost_camera_is_one_that_worked_and_never_the_last():
    always = AugmentationSettings(camera_dropout=1.0)
    valid = np.array([True, False, True, True])
    lost = [np.flatnonzero(valid & ~drop_camera(valid, always, np.random.default_rng(s))) for s in range(40)]
    assert {tuple(each.tolist()) for each in lost} == {(0,), (2,), (3,)}
    alone = np.array([False, True])
    assert drop_camera(alone, always, np.random.default_rng(0)).tolist() == [False, True]


def test_poses_are_as_wrong_as_asked_for():
    settings = AugmentationSettings(pose_metres=0.2, pose_degrees=2.0)
    pose = drawn_frame(LITE).ego_to_global
    wrong = [inverse_pose(pose) @ disturb_pose(pose, settings, np.random.default_rng(s)) for s in range(300)]
    places, turns = np.array([each[:3, 3] for each in wrong]), [np.arctan2(each[1, 0], each[0, 0]) for each in wrong]
    np.testing.assert_allclose(places[:, :2].std(axis=0), 0.2, rtol=0.15)
    assert np.degrees(np.std(turns)) == pytest.approx(2.0, rel=0.15)
    assert not places[:, 2].any()
