"""Wrong calibration in training, so that the network bears a camera that was bumped or measured badly."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import torch

from predmapnet.network.calibration import Calibration

DEGREES = 0.75
"""Standard deviation of each camera's rotation about each axis, where the calibration is wrong."""
COMMON_DEGREES = 0.4
"""That of the whole rig, as of a car that is loaded unevenly."""
METRES = 0.02
"""Standard deviation of each camera's position along each axis."""


def perturb_calibration(calibration: Calibration, probability: float, generator: np.random.Generator) -> Calibration:
    """Return a wrong calibration of the cameras of one frame; what their images show does not change.

    Args:
        calibration: the true one, of one frame.
        probability: that it is wrong at all.
        generator: source of randomness; the same state gives the same result.
    """
    if generator.random() >= probability:
        return calibration
    # Most calibrations are better than the worst ones: how bad this one is varies as well.
    strength = generator.uniform(0.0, 1.7)
    common = generator.normal(0.0, COMMON_DEGREES, 3)
    projections = calibration.ego_to_image[0].numpy().copy()
    for index, projection in enumerate(projections):
        angles = np.radians(strength * (common + generator.normal(0.0, DEGREES, 3)))
        rotation, _ = cv2.Rodrigues(angles)
        position = -np.linalg.solve(projection[:, :3], projection[:, 3])
        moved = position + strength * generator.normal(0.0, METRES, 3)
        # The camera turns about itself: (M R | -M R c') looks from c' along the turned axes.
        turned = projection[:, :3] @ rotation
        projections[index] = np.column_stack([turned, -turned @ moved])
    return replace(calibration, ego_to_image=torch.from_numpy(projections[None]))
