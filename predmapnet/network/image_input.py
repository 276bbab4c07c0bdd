"""Image input: scaling, the part that the network sees, and normalisation.

The mapper and the training use these same functions, so that both see the same pixels. What happens is decided by the
kind of the configuration: the window below the sky, or the whole image as MapTracker takes it.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

import cv2
import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor

from mapfusion.arrays import Float
from mapfusion.geometry import inverse_pose
from predmapnet.config import ImageConfig, ImageWindowConfig, WholeImageConfig
from predmapnet.scenes import Camera, Image, Rig

WindowPixels = NDArray[np.uint8] | NDArray[np.float32]
"""Pixels 0 to 255. Windows are rounded; whole images are not, since MapTracker stretches floating-point images."""


@dataclass(frozen=True)
class ImageWindow:
    """Size of one camera's image after scaling, pixels, and the first row of the network's window in it."""

    scaled_width: int
    scaled_height: int
    top: int


def image_window(camera: Camera, config: ImageConfig) -> ImageWindow:
    """Tell which part of a camera's image the network sees."""
    if isinstance(config, WholeImageConfig):
        return ImageWindow(config.width, config.height, top=0)
    return _window_below_sky(camera, config)


def _window_below_sky(camera: Camera, config: ImageWindowConfig) -> ImageWindow:
    """Place the window of one camera by its projected horizon.

    The horizon is where a level ray through the middle of the image is seen, so a pinhole camera of any pitch and
    focal length keeps the rows below it. The window never leaves an image that is tall enough.
    """
    scaled_height = round(camera.height * config.width / camera.width)
    axis = camera.camera_to_ego[:3, 2] * [1.0, 1.0, 0.0]
    ray = camera.camera_to_ego[:3, :3].T @ axis
    horizon = float(camera.intrinsics[1, 1] * ray[1] / max(ray[2], 1e-6) + camera.intrinsics[1, 2])
    top = round(horizon * scaled_height / camera.height - config.horizon * config.height)
    return ImageWindow(config.width, scaled_height, max(0, min(top, scaled_height - config.height)))


def window_intrinsics(camera: Camera, config: ImageConfig) -> Float:
    """Return the ``(3, 3)`` intrinsics of the part of one camera's image that the network sees."""
    window = image_window(camera, config)
    scale = np.diag([window.scaled_width / camera.width, window.scaled_height / camera.height, 1.0])
    intrinsics: Float = scale @ camera.intrinsics
    intrinsics[1, 2] -= window.top
    return intrinsics


def window_camera(camera: Camera, config: ImageConfig) -> Camera:
    """Return the camera that takes exactly the network's window of ``camera``, pixel for pixel."""
    intrinsics = window_intrinsics(camera, config)
    return replace(camera, width=config.width, height=config.height, intrinsics=intrinsics)


def ego_to_image(rig: Rig, config: ImageConfig) -> Float:
    """Return the projections ``(N, 4, 4)``: from metres of the ego frame to (u depth, v depth, depth, 1).

    u and v are pixels of the network's input, the centre of the first one at (0.5, 0.5).
    """
    projections = np.stack([inverse_pose(camera.camera_to_ego) for camera in rig])
    projections[:, :3] = np.stack([window_intrinsics(camera, config) for camera in rig]) @ projections[:, :3]
    return projections


def input_size(config: ImageConfig) -> tuple[int, int]:
    """Return rows and columns of the network's input."""
    if isinstance(config, WholeImageConfig):
        return -(-config.height // config.multiple) * config.multiple, -(
            -config.width // config.multiple
        ) * config.multiple
    return config.height, config.width


def crop_image(image: Image, camera: Camera, config: ImageConfig) -> WindowPixels:
    """Scale one stored image ``(camera.height, camera.width, 3) uint8``, RGB, and cut out what the network sees.

    Returns:
        ``(config.height, config.width, 3)``, RGB; rows that the image does not have are black.
    """
    window = image_window(camera, config)
    size = (window.scaled_width, window.scaled_height)
    if isinstance(config, WholeImageConfig):
        # No averaging: released weights have learned from images as coarse as this interpolation leaves them.
        stretched = cv2.resize(image.astype(np.float32), size, interpolation=cv2.INTER_LINEAR)
        return np.asarray(stretched, dtype=np.float32)
    cropped = _scaled_rows(image, window, window.top, window.top + config.height)
    missing = config.height - len(cropped)
    whole = np.pad(cropped, ((0, missing), (0, 0), (0, 0))) if missing else np.ascontiguousarray(cropped)
    return np.asarray(whole, dtype=np.uint8)


def _scaled_rows(image: Image, window: ImageWindow, first: int, last: int) -> NDArray[np.uint8]:
    """Return rows ``first`` to ``last`` of the scaled image, as many as there are; the others are not computed.

    Scaling turns blocks of whole rows into blocks of whole rows, so that it may begin at any of them.
    """
    if (window.scaled_height, window.scaled_width) == image.shape[:2]:
        return np.asarray(image[first:last], dtype=np.uint8)
    blocks = math.gcd(len(image), window.scaled_height)
    rows_in, rows_out = len(image) // blocks, window.scaled_height // blocks
    begin, end = first // rows_out, min(-(-last // rows_out), blocks)
    part, size = image[begin * rows_in : end * rows_in], (window.scaled_width, (end - begin) * rows_out)
    scaled = cv2.resize(part, size, interpolation=cv2.INTER_AREA)[first - begin * rows_out :]
    return np.asarray(scaled[: last - first], dtype=np.uint8)


def normalise_images(images: Tensor, config: ImageConfig) -> Tensor:
    """Turn windows of :func:`crop_image`, ``(..., h, w, 3)``, into the network's input.

    Returns:
        ``(..., 3, rows, columns) float32`` of :func:`input_size`, channels-last in memory. Red, green, blue for a
        window; blue, green, red for whole images.
    """
    # Of whole rows of pixels: an operation that begins anew with every pixel takes several times as long.
    pixels = images.shape[-2]
    mean = torch.tensor(config.mean, device=images.device).repeat(pixels)
    if isinstance(config, WholeImageConfig):
        rows, columns = input_size(config)
        centred = (images.float().flip(-1).flatten(-2) - mean).view(images.shape)
        margin = (0, 0, 0, columns - centred.shape[-2], 0, rows - centred.shape[-3])
        return F.pad(centred, margin).movedim(-1, -3)
    deviation = torch.tensor(config.deviation, device=images.device).repeat(pixels) * 255.0
    return ((images.flatten(-2).float() - mean * 255.0) / deviation).view(images.shape).movedim(-1, -3)


def stack_windows(images: Mapping[str, Image], rig: Rig, config: ImageConfig) -> tuple[WindowPixels, NDArray[np.bool_]]:
    """Cut the windows of one instant.

    Args:
        images: RGB uint8 images at their stored size, by camera name; cameras may be missing.
        rig: all cameras of the car.
        config: the network's image input.

    Returns:
        ``(N, h, w, 3)`` windows, black where there is no image, and ``(N,) bool``, which cameras have one.
    """
    blank = np.zeros((config.height, config.width, 3), np.float32 if config.kind == "whole" else np.uint8)
    windows = [crop_image(images[camera.name], camera, config) if camera.name in images else blank for camera in rig]
    return np.stack(windows), np.array([camera.name in images for camera in rig])
