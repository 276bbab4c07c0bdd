"""Wrong calibrations: small, seeded, and still cameras."""

from __future__ import annotations

import numpy as np

from predmapnet.demo_world.rig import DEMO_RIG
from predmapnet.training.data.calibration_noise import CalibrationNoise, perturb_rig


def _degrees(first: np.ndarray, second: np.ndarray) -> float:
    cosine = (np.trace(first[:3, :3].T @ second[:3, :3]) - 1) / 2
    return float(np.degrees(np.arccos(np.clip(cosine, -1, 1))))


def test_the_same_generator_gives_the_same_rig() -> None:
    noise = CalibrationNoise(probability=1.0)
    once, again = (perturb_rig(DEMO_RIG, noise, np.random.default_rng(3)) for _ in range(2))
    assert all(np.array_equal(a.camera_to_ego, b.camera_to_ego) for a, b in zip(once, again, strict=True))


def test_rotations_stay_rotations_and_reach_about_a_degree() -> None:
    noise = CalibrationNoise(probability=1.0)
    turns = []
    for seed in range(100):
        for true, wrong in zip(DEMO_RIG, perturb_rig(DEMO_RIG, noise, np.random.default_rng(seed)), strict=True):
            rotation = wrong.camera_to_ego[:3, :3]
            assert np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-9)
            assert np.linalg.det(rotation) > 0
            turns.append(_degrees(true.camera_to_ego, wrong.camera_to_ego))
    assert 0.5 < np.mean(turns) < 1.5
    assert 1.0 < np.percentile(turns, 90) < 3.0


def test_as_many_rigs_stay_right_as_asked_for() -> None:
    noise = CalibrationNoise(probability=0.5)
    same = [perturb_rig(DEMO_RIG, noise, np.random.default_rng(seed)) is DEMO_RIG for seed in range(200)]
    assert 0.35 < np.mean(same) < 0.65
