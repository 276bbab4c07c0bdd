"""Changes to a frame that keep its truth exact: mirroring left and right, photography, missing cameras."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from predmapnet.scenes import FrameTruth
from predmapnet.training.data.calibration_noise import CalibrationNoise
from predmapnet.training.data.photography import (
    PhotographySettings,
    add_noise,
    add_stray_light,
    blur,
    save_and_load,
    tone_tables,
)
from predmapnet.training.data.scene_cache import Images

Float = NDArray[np.float64]

MIRROR_Y = np.diag([1.0, -1.0, 1.0, 1.0])
"""Ego frame to mirrored ego frame; its own inverse."""


@dataclass(frozen=True)
class AugmentationSettings:
    """How strongly frames are changed.

    Attributes:
        mirror: probability of swapping left and right.
        photography: light, lenses, sensors and files.
        camera_dropout: probability that one camera of a frame is missing; a single one never is.
        calibration: how wrong the calibration is that the network is told (single-frame stage).
    """

    mirror: float = 0.5
    photography: PhotographySettings = field(default_factory=PhotographySettings)
    camera_dropout: float = 0.05
    calibration: CalibrationNoise = field(default_factory=CalibrationNoise)


def mirror_images(images: Images) -> Images:
    """Return what the mirrored rig (:func:`predmapnet.network.image_input.mirror_rig`) sees in the mirrored world.

    Args:
        images: ``(N, h, w, 3)``.
    """
    return np.ascontiguousarray(images[:, :, ::-1])


def mirror_truth(truth: FrameTruth) -> FrameTruth:
    """Return the truth of the mirrored world: y changes its sign."""
    return replace(truth, polylines=tuple(line * np.array([1.0, -1.0]) for line in truth.polylines))


def mirror_pose(ego_to_global: Float) -> Float:
    """Return the ego poses ``(..., 4, 4)`` in the mirrored world."""
    mirrored: Float = MIRROR_Y @ ego_to_global @ MIRROR_Y
    return mirrored


def change_light(images: Images, settings: AugmentationSettings, generator: np.random.Generator) -> Images:
    """Take the photographs of one frame again, in other light and with other lenses, sensors and files.

    Args:
        images: ``(N, h, w, 3)``.
        settings: how strongly they change.
        generator: source of randomness.

    Returns:
        New images of the same shape.
    """
    look = settings.photography
    changed = np.stack([add_stray_light(image, look, generator) for image in images])
    changed = blur(changed, look, generator)
    tables = tone_tables(len(images), look, generator)
    changed = np.stack([cv2.LUT(image, tables[index][None]) for index, image in enumerate(changed)])
    return save_and_load(add_noise(changed, look, generator), look, generator)


def drop_camera(cameras: int, settings: AugmentationSettings, generator: np.random.Generator) -> NDArray[np.bool_]:
    """Draw which cameras work: ``(cameras,) bool``, at most one is False, and never all."""
    valid = np.ones(cameras, dtype=np.bool_)
    if generator.random() < settings.camera_dropout and cameras > 1:
        valid[generator.integers(cameras)] = False
    return valid
