"""Changes to a frame that keep its truth exact: mirroring, photography, lost cameras, wrong calibrations and poses."""

from __future__ import annotations

import re
from dataclasses import dataclass, field, replace

import cv2
import numpy as np
import torch

from mapfusion.arrays import Bool, Byte, Float
from predmapnet.augmentation.calibration_noise import perturb_calibration
from predmapnet.augmentation.photography import (
    PhotographySettings,
    add_noise,
    add_stray_light,
    blur,
    save_and_load,
    tone_tables,
)
from predmapnet.config import BevFormerConfig, ImageConfig, PredMapNetConfig
from predmapnet.frame_cache.scene_cache import CachedFrame, TrainingScenes
from predmapnet.network.image_input import input_size

MIRROR_Y = np.diag([1.0, -1.0, 1.0, 1.0])
"""Ego frame to mirrored ego frame; its own inverse."""
_OTHER_SIDE = {"LEFT": "RIGHT", "RIGHT": "LEFT", "left": "right", "right": "left"}


@dataclass(frozen=True)
class AugmentationSettings:
    """Strengths of the changes to frames.

    Attributes:
        mirror: probability of swapping left and right.
        photography: light, lenses, sensors and files.
        grid_mask: probability that a grid covers a quarter of the images of a frame; MapTracker's is 0.7.
        camera_dropout: probability that one camera of a frame is missing; the last one never is.
        bumped: probability that the calibration that the network is told is wrong.
        pose_metres, pose_degrees: standard deviation of the places and headings of the frames of a stream.
    """

    mirror: float = 0.5
    photography: PhotographySettings = field(default_factory=PhotographySettings)
    grid_mask: float = 0.0
    camera_dropout: float = 0.05
    bumped: float = 0.6
    pose_metres: float = 0.05
    pose_degrees: float = 0.1


def load_frame(scenes: TrainingScenes, scene: int, frame: int, mirrored: bool, images: bool = True) -> CachedFrame:
    """Read one frame, mirrored or not."""
    stored = scenes.scenes[scene].frame(frame, images)
    return mirror(stored, scenes.config) if mirrored else stored


def mirror(frame: CachedFrame, config: PredMapNetConfig) -> CachedFrame:
    """Return what a mirrored car sees in the mirrored world: flipped images, and y with another sign."""
    depth, calibration = frame.depth, frame.calibration
    if depth is not None:
        # Cells of the padding at the right stay there.
        shown = config.image.width * depth.shape[2] // input_size(config.image)[1]
        depth = np.concatenate([depth[:, :, :shown][:, :, ::-1], depth[:, :, shown:]], axis=2)
    # The column u of a pixel becomes width - u, before it is divided by the depth.
    flip = torch.eye(3, dtype=torch.float64).repeat(*calibration.camera_code.shape, 1, 1)
    flip[..., 0, 0], flip[..., 0, 2] = -1.0, calibration.image_size[..., 0]
    return replace(
        frame,
        ego_to_global=MIRROR_Y @ frame.ego_to_global @ MIRROR_Y,
        calibration=replace(
            calibration,
            ego_to_image=flip @ calibration.ego_to_image @ torch.from_numpy(MIRROR_Y),
            camera_code=torch.tensor(_mirrored_codes(config))[calibration.camera_code],
        ),
        truth=replace(frame.truth, polylines=tuple(line * [1.0, -1.0] for line in frame.truth.polylines)),
        images=_flipped(frame.images),
        depth=depth,
    )


def _flipped(images: Byte) -> Byte:
    """Swap left and right of images ``(N, h, w, 3)``; OpenCV does it forty times as fast as numpy."""
    if not images.size:
        return images
    return np.asarray(cv2.flip(images.reshape(-1, *images.shape[2:]), 1), np.uint8).reshape(images.shape)


def _mirrored_codes(config: PredMapNetConfig) -> list[int]:
    """By learned camera code, that of the camera of the same name at the other side."""
    names = config.bev.cameras if isinstance(config.bev, BevFormerConfig) else ("",)
    others = [re.sub("|".join(_OTHER_SIDE), lambda side: _OTHER_SIDE[side[0]], name) for name in names]
    return [names.index(other) if other in names else code for code, other in enumerate(others)]


def augment(
    frame: CachedFrame, settings: AugmentationSettings, config: ImageConfig, generator: np.random.Generator, bump: int
) -> CachedFrame:
    """Take a frame again; ``bump`` is the seed of the calibration's error, which the frames of a clip share."""
    images = cover_grid(change_light(frame.images, settings, generator), settings.grid_mask, config, generator)
    calibration = perturb_calibration(frame.calibration, settings.bumped, np.random.default_rng(bump))
    valid = drop_camera(frame.camera_valid, settings, generator)
    return replace(frame, images=images, camera_valid=valid, calibration=calibration)


def change_light(images: Byte, settings: AugmentationSettings, generator: np.random.Generator) -> Byte:
    """Take the photographs of one frame ``(N, h, w, 3)`` again, in other light and by other lenses and sensors."""
    look = settings.photography
    changed = np.stack([add_stray_light(image, look, generator) for image in images])
    changed = blur(changed, look, generator)
    tables = tone_tables(len(images), look, generator)
    for image, table in zip(changed, tables, strict=True):
        cv2.LUT(image, table[None], image)
    return save_and_load(add_noise(changed, look, generator), look, generator)


def cover_grid(images: Byte, probability: float, config: ImageConfig, generator: np.random.Generator) -> Byte:
    """Cover the squares of a grid with the mean colour (GridMask, Chen et al. 2020), alike in all cameras of a frame.

    Half of each period is covered in either direction, as in MapTracker's training: a quarter of the image.
    """
    if generator.random() >= probability:
        return images
    sizes = images.shape[1:3]
    period = int(generator.integers(2, min(sizes)))
    row, column = ((np.arange(n) + generator.integers(period)) % period >= (period + 1) // 2 for n in sizes)
    colour = np.multiply(config.mean, 255.0) if config.kind == "window" else np.array(config.mean[::-1])
    covered = images.copy()
    covered[:, row[:, None] & column] = colour.round()
    return covered


def drop_camera(valid: Bool, settings: AugmentationSettings, generator: np.random.Generator) -> Bool:
    """Return which cameras ``(N,) bool`` still work when one of them may have failed; the last one never does."""
    working = np.flatnonzero(valid)
    if generator.random() >= settings.camera_dropout or len(working) < 2:
        return valid
    left = valid.copy()
    left[generator.choice(working)] = False
    return left


def disturb_pose(ego_to_global: Float, settings: AugmentationSettings, generator: np.random.Generator) -> Float:
    """Return a pose ``(4, 4)`` as a car measures it that does not know exactly where it is."""
    turn = np.radians(settings.pose_degrees) * generator.standard_normal()
    wrong = np.eye(4)
    wrong[:2, :2] = [[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]]
    wrong[:2, 3] = settings.pose_metres * generator.standard_normal(2)
    measured: Float = ego_to_global @ wrong
    return measured
