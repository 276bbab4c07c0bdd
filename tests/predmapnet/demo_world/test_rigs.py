"""Rigs of all kinds of cars: within the promised ranges, each looking at the road ahead."""

from __future__ import annotations

import numpy as np
import pytest

from predmapnet.config import ImageWindowConfig
from predmapnet.demo_world.rig import DEMO_RIG
from predmapnet.demo_world.rigs import HIGHEST, LOWEST, MOST_ROLL, NARROWEST, WIDEST, sample_rig
from predmapnet.network.image_input import image_window, window_intrinsics
from predmapnet.scenes import Camera

SEEDS = range(300)
RIGS = [sample_rig(seed) for seed in SEEDS]
OTHERS = [rig for rig in RIGS if rig is not DEMO_RIG]


def _road_in_window(camera: Camera) -> int:
    """Number of points of the road ahead that fall into the network's window."""
    x, y = np.meshgrid(np.linspace(5, 30, 26), np.linspace(-3, 3, 7))
    points = np.stack([x.ravel(), y.ravel(), np.full(x.size, camera.ground_height), np.ones(x.size)])
    local = (np.linalg.inv(camera.camera_to_ego) @ points)[:3]
    config = ImageWindowConfig()
    pixel = window_intrinsics(camera, config) @ local
    column, row = pixel[:2] / np.where(local[2] > 0.1, local[2], np.inf)
    inside = (column > 0) & (column < config.width) & (row > 0) & (row < config.height) & (local[2] > 0.1)
    return int(inside.sum())


def test_a_third_of_the_seeds_gets_the_demo_car() -> None:
    assert 0.25 < 1 - len(OTHERS) / len(RIGS) < 0.42


def test_every_number_of_cameras_occurs() -> None:
    assert {len(rig) for rig in OTHERS} == set(range(1, 9))


def test_every_rig_sees_the_road_ahead() -> None:
    for rig in RIGS:
        assert max(_road_in_window(camera) for camera in rig) > 20


def test_the_network_window_fits_into_every_image() -> None:
    config = ImageWindowConfig()
    for rig in RIGS:
        for camera in rig:
            window = image_window(camera, config)
            assert window.top + config.height <= window.scaled_height


def test_mountings_and_lenses_stay_in_range() -> None:
    heights, fields, rolls = [], [], []
    for rig in OTHERS:
        assert len({camera.name for camera in rig}) == len(rig)
        assert len({camera.ground_height for camera in rig}) == 1
        for camera in rig:
            pose = camera.camera_to_ego
            assert np.allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3))
            assert np.linalg.det(pose[:3, :3]) == pytest.approx(1.0)
            heights.append(pose[2, 3] - camera.ground_height)
            fields.append(2 * np.degrees(np.arctan(camera.width / 2 / camera.intrinsics[0, 0])))
            rolls.append(np.degrees(np.arcsin(pose[2, 0])))
    assert LOWEST <= min(heights) < 1.4 and 2.4 < max(heights) <= HIGHEST
    assert NARROWEST - 1e-6 <= min(fields) < 55 and 100 < max(fields) <= WIDEST + 1e-6
    assert np.abs(rolls).max() <= MOST_ROLL + 1e-6 and np.std(rolls) > 0.3


def test_the_same_seed_gives_the_same_rig() -> None:
    for first, second in zip(sample_rig(9), sample_rig(9), strict=True):
        assert np.array_equal(first.camera_to_ego, second.camera_to_ego)
        assert np.array_equal(first.intrinsics, second.intrinsics)
