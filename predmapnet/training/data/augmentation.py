"""Changes to a frame that keep its truth exact: mirroring left and right, light, noise, missing cameras."""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from predmapnet.scenes import FrameTruth
from predmapnet.training.data.scene_cache import Images

Float = NDArray[np.float64]

MIRROR_Y = np.diag([1.0, -1.0, 1.0, 1.0])
"""Ego frame to mirrored ego frame; its own inverse."""


@dataclass(frozen=True)
class AugmentationSettings:
    """How strongly frames are changed.

    Attributes:
        mirror: probability of swapping left and right.
        gain: largest change of the exposure, as a logarithm.
        colour: largest change of one colour channel, as a logarithm.
        offset: largest shift of the black level, of 255.
        noise: largest standard deviation of the pixel noise, of 255.
        camera_dropout: probability that one camera of a frame is missing; a single one never is.
    """

    mirror: float = 0.5
    gain: float = 0.25
    colour: float = 0.08
    offset: float = 10.0
    noise: float = 5.0
    camera_dropout: float = 0.05


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
    """Change exposure, colour, black level and noise of one frame, a little differently in each camera.

    Args:
        images: ``(N, h, w, 3)``.
        settings: how strongly.
        generator: source of randomness.
    """
    cameras = len(images)
    common = generator.uniform(-1, 1, (1, 3)) * settings.colour + generator.uniform(-1, 1) * settings.gain
    own = 0.2 * settings.gain * generator.uniform(-1, 1, (cameras, 1))
    scale = np.exp(common + own)
    offset = generator.uniform(-1, 1) * settings.offset
    levels = np.arange(256)[None, :, None] * scale[:, None, :] + offset
    table = np.clip(np.round(levels), 0, 255).astype(np.uint8)
    changed = np.stack([cv2.LUT(image, table[index][None]) for index, image in enumerate(images)])
    deviation = generator.uniform(0, settings.noise)
    # One draw serves all cameras, each at its own offset: independent noise costs more than the eye can tell.
    grain = np.round(generator.standard_normal(images[0].size, dtype=np.float32) * deviation).astype(np.int16)
    shifts = generator.integers(0, grain.size, cameras)
    for index in range(cameras):
        noisy = cv2.add(changed[index].astype(np.int16), np.roll(grain, shifts[index]).reshape(images[0].shape))
        changed[index] = np.clip(noisy, 0, 255).astype(np.uint8)
    return changed


def drop_camera(cameras: int, settings: AugmentationSettings, generator: np.random.Generator) -> NDArray[np.bool_]:
    """Draw which cameras work: ``(cameras,) bool``, at most one is False, and never all."""
    valid = np.ones(cameras, dtype=np.bool_)
    if generator.random() < settings.camera_dropout and cameras > 1:
        valid[generator.integers(cameras)] = False
    return valid
