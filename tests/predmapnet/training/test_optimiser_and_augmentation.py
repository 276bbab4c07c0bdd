"""The moving average, the schedule, and mirroring."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch import nn

from mapfusion.geometry import inverse_pose
from predmapnet.demo_world.rig import DEMO_RIG
from predmapnet.network.image_input import mirror_rig
from predmapnet.scenes import Camera, FrameTruth
from predmapnet.training.data.augmentation import (
    mirror_images,
    mirror_pose,
    mirror_truth,
)
from predmapnet.training.optimiser import OptimiserSettings, WeightAverage, learning_rate


def test_the_average_follows_the_weights() -> None:
    network = nn.Sequential(nn.Linear(1, 1, bias=False), nn.BatchNorm1d(1))
    average = WeightAverage(network, decay=0.5)
    expected = network[0].weight.item()
    for update, value in enumerate([1.0, -2.0, 3.0, 0.5]):
        with torch.no_grad():
            network[0].weight.fill_(value)
            network[1].running_mean.fill_(value)
            network[1].num_batches_tracked.fill_(update)
        average.update(network)
        decay = min(0.5, (1 + update) / (10 + update))
        expected = decay * expected + (1 - decay) * value
        assert average.network[0].weight.item() == pytest.approx(expected, abs=1e-6)
        assert average.network[1].num_batches_tracked.item() == update
    assert network[0].weight.item() == 0.5, "the network itself is left alone"


def test_the_rate_warms_up_and_falls_with_the_budget() -> None:
    settings = OptimiserSettings(learning_rate=1.0, warmup_steps=10)
    assert learning_rate(0, 0.0, settings) == pytest.approx(0.1)
    assert learning_rate(100, 0.0, settings) == pytest.approx(1.0)
    assert learning_rate(100, 0.5, settings) == pytest.approx(0.51)
    assert learning_rate(100, 1.2, settings) == pytest.approx(0.02)


def test_mirroring_twice_changes_nothing() -> None:
    generator = np.random.default_rng(0)
    images = generator.integers(0, 255, (6, 8, 12, 3), dtype=np.uint8)
    assert np.array_equal(mirror_images(mirror_images(images)), images)
    truth = FrameTruth(np.array([1]), (generator.normal(size=(4, 2)),), np.array([3]))
    assert np.array_equal(mirror_truth(mirror_truth(truth)).polylines[0], truth.polylines[0])
    angle = 0.3
    pose = np.eye(4)
    pose[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
    pose[:3, 3] = [100.0, 20.0, 1.0]
    mirrored = mirror_pose(pose)
    assert np.allclose(mirror_pose(mirrored), pose)
    assert np.isclose(np.linalg.det(mirrored[:3, :3]), 1.0), "still a rotation"


def test_mirrored_truth_lies_where_the_mirrored_images_show_it() -> None:
    points = np.random.default_rng(1).uniform([-25, -12], [25, 12], (200, 2))
    for camera, mirrored in zip(DEMO_RIG, mirror_rig(DEMO_RIG), strict=True):
        seen, columns = pixels_of(points, camera)
        mirrored_seen, mirrored_columns = pixels_of(points * [1, -1], mirrored)
        assert np.array_equal(seen, mirrored_seen)
        flipped = columns.copy()
        flipped[:, 0] = camera.width - flipped[:, 0]
        assert np.allclose(flipped, mirrored_columns, atol=1e-6)


def pixels_of(points: np.ndarray, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    ground = np.concatenate([points, np.zeros((len(points), 1)), np.ones((len(points), 1))], 1)
    rays = (ground @ inverse_pose(camera.camera_to_ego).T)[:, :3]
    seen = rays[:, 2] > 0.5
    projected = rays[seen] @ camera.intrinsics.T
    return seen, projected[:, :2] / projected[:, 2:]
