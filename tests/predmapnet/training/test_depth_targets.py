"""Depth targets say how far away the nearest thing is that a feature cell sees, and the loss wants just that."""

import dataclasses

import numpy as np
import pytest
import torch
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from predmapnet.config import DepthConfig
from predmapnet.datasets.nuscenes import NuScenesSource
from predmapnet.demo_world.rig import DEMO_RIG
from predmapnet.frame_cache.depth_targets import UNKNOWN, depth_targets
from predmapnet.training.losses.terms import depth_loss
from tests.predmapnet.network.maptracker_reference import FOLDER

BINS = DepthConfig(enabled=True, bins=20, near=2.0, far=42.0)
STRIDE = 25
FRONT = DEMO_RIG[:1]


def wall(distance, camera=FRONT[0]):
    """Points of a wall across the view of a camera, metres before its lens, in the ego frame."""
    across, up = np.meshgrid(np.linspace(-distance, distance, 80), np.linspace(-distance, distance, 60))
    points = np.stack([across.ravel(), up.ravel(), np.full(across.size, distance)], axis=1)
    return points @ camera.camera_to_ego[:3, :3].T + camera.camera_to_ego[:3, 3]


@settings(deadline=None, max_examples=15)
@given(st.floats(BINS.near, BINS.far), st.integers(0, len(DEMO_RIG) - 1))
def test_a_wall_fills_the_view_with_the_bin_of_its_distance(distance, camera):
    assume(0.01 < distance % 2.0 < 1.99)
    targets = depth_targets(wall(distance, DEMO_RIG[camera]), DEMO_RIG[camera : camera + 1], STRIDE, BINS)
    assert targets.shape == (1, 18, 32)
    assert (targets == int((distance - BINS.near) / 2.0)).all()


@pytest.mark.parametrize("distance", [-10.0, -0.1, 1.9, 42.1])
def test_what_is_behind_the_camera_or_out_of_range_says_nothing(distance):
    assert (depth_targets(wall(distance), FRONT, STRIDE, BINS) == UNKNOWN).all()


@settings(deadline=None, max_examples=15)
@given(st.floats(3.0, 40.0), st.floats(3.0, 40.0), st.integers(0, 99))
def test_the_nearest_of_two_walls_wins_in_any_order(first, second, seed):
    both = np.concatenate([wall(first), wall(second)])
    order = np.random.default_rng(seed).permutation(len(both))
    expected = depth_targets(wall(min(first, second)), FRONT, STRIDE, BINS)
    assert np.array_equal(depth_targets(both[order], FRONT, STRIDE, BINS), expected)


def test_cells_without_a_point_are_unknown():
    ray = FRONT[0].camera_to_ego @ np.array([0.0, 0.0, 9.0, 1.0])
    targets = depth_targets(ray[None, :3], FRONT, STRIDE, BINS)[0]
    row, column = (FRONT[0].intrinsics[[1, 0], 2] // STRIDE).astype(int)
    assert targets[row, column] == 3
    assert (targets != UNKNOWN).sum() == 1


def test_the_loss_is_the_entropy_of_all_bins_at_known_cells():
    logits = torch.zeros(1, 2, 4, 3, 5)
    targets = torch.full((1, 2, 3, 5), UNKNOWN)
    targets[0, 1, 2, 2] = 3
    expected = -(np.log(1 / 4) + 3 * np.log(3 / 4))
    assert float(depth_loss(logits, targets)) == pytest.approx(expected, rel=1e-5)
    logits[0, 0] = 7.0 * torch.randn(4, 3, 5)
    assert float(depth_loss(logits, targets)) == pytest.approx(expected, rel=1e-5)
    logits[0, 1, 3, 2, 2] = 20.0
    assert float(depth_loss(logits, targets)) == pytest.approx(0.0, abs=1e-5)


def test_without_any_point_there_is_nothing_to_learn():
    logits = torch.randn(1, 1, 4, 3, 5, requires_grad=True)
    loss = depth_loss(logits, torch.full((1, 1, 3, 5), UNKNOWN))
    loss.backward()
    assert float(loss.detach()) == 0.0
    assert not logits.grad.any()


@pytest.mark.reference
def test_a_real_sweep_shows_the_road_nearer_at_the_bottom_of_the_image():
    folder = FOLDER.parent / "ground_truth" / "nuscenes_sample"
    if not folder.is_dir():
        pytest.skip(f"no reference fixtures at {folder}: set PREDMAPNET_REFERENCE")
    scene = NuScenesSource(folder).open("scene-0061")
    points = scene.lidar(0)
    ground = points[(np.abs(points[:, :2]) < 10).all(axis=1) & (np.hypot(*points[:, :2].T) > 4), 2]
    assert abs(np.median(ground)) < 0.3
    half = np.diag([0.5, 0.5, 1.0])
    rig = tuple(
        dataclasses.replace(camera, width=800, height=450, intrinsics=half @ camera.intrinsics) for camera in scene.rig
    )
    config = DepthConfig(enabled=True)
    for targets in depth_targets(points, rig, 16, config):
        known = np.where(targets == UNKNOWN, np.nan, targets)
        assert np.isfinite(known).mean() > 0.2
        rows = np.nanmedian(known[16:26], axis=1)
        assert rows[-1] < rows[0]
