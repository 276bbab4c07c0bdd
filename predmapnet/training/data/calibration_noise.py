"""Wrong calibration in training, so that the network bears a camera that was bumped or measured badly."""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np

from predmapnet.scenes import Rig


@dataclass(frozen=True)
class CalibrationNoise:
    """How far the calibration that the network is told lies from the true one.

    Attributes:
        probability: of a frame or clip whose rig is wrong at all.
        degrees: standard deviation of each camera's rotation about each of its axes, where it is wrong.
        common_degrees: that of the whole rig, as a car that is loaded unevenly.
        metres: standard deviation of each camera's position along each axis.
        focal: standard deviation of the focal length, as a logarithm.
    """

    probability: float = 0.5
    degrees: float = 0.5
    common_degrees: float = 0.3
    metres: float = 0.02
    focal: float = 0.004


def perturb_rig(rig: Rig, noise: CalibrationNoise, generator: np.random.Generator) -> Rig:
    """Return the rig as a wrong calibration describes it.

    Args:
        rig: the true one.
        noise: how wrong.
        generator: source of randomness; the same state gives the same rig.
    """
    if generator.random() >= noise.probability:
        return rig
    # Most calibrations are better than the worst ones: how bad this one is varies as well.
    strength = generator.uniform(0, 1.7)
    together, _ = cv2.Rodrigues(np.radians(generator.normal(0, noise.common_degrees, 3)) * strength)
    wrong = []
    for camera in rig:
        own, _ = cv2.Rodrigues(np.radians(generator.normal(0, noise.degrees, 3)) * strength)
        pose, intrinsics = camera.camera_to_ego.copy(), camera.intrinsics.copy()
        pose[:3, :3] = together @ pose[:3, :3] @ own
        pose[:3, 3] += generator.normal(0, noise.metres, 3) * strength
        intrinsics[[0, 1], [0, 1]] *= np.exp(generator.normal(0, noise.focal) * strength)
        wrong.append(replace(camera, camera_to_ego=pose, intrinsics=intrinsics))
    return tuple(wrong)
