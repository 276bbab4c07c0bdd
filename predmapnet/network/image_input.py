"""From stored photographs to the network's input: scaling, the window below the sky, and normalisation.

The mapper and the training use these same functions, so that both see the same pixels.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from predmapnet.config import ImageConfig
from predmapnet.datasets.source import Camera, Image, Rig


@dataclass(frozen=True)
class ImageWindow:
    """How one camera's image is scaled and where the network's window lies in it.

    Attributes:
        scaled_width, scaled_height: pixels after scaling.
        top: first row of the window in the scaled image.
    """

    scaled_width: int
    scaled_height: int
    top: int


def image_window(camera: Camera, config: ImageConfig) -> ImageWindow:
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


def window_intrinsics(camera: Camera, config: ImageConfig) -> NDArray[np.float64]:
    """Return the ``(3, 3)`` intrinsics of the network's window of one camera."""
    window = image_window(camera, config)
    scale = np.diag([window.scaled_width / camera.width, window.scaled_height / camera.height, 1.0])
    intrinsics: NDArray[np.float64] = scale @ camera.intrinsics
    intrinsics[1, 2] -= window.top
    return intrinsics


def crop_image(image: Image, camera: Camera, config: ImageConfig) -> Image:
    """Scale one stored image and cut out the network's window.

    Args:
        image: ``(camera.height, camera.width, 3) uint8``, RGB.
        camera: the camera that took it.
        config: the network's image size.

    Returns:
        ``(config.height, config.width, 3) uint8``; rows that the image does not have are black.
    """
    window = image_window(camera, config)
    size = (window.scaled_width, window.scaled_height)
    scaled = image if size == image.shape[1::-1] else cv2.resize(image, size, interpolation=cv2.INTER_AREA)
    cropped = scaled[window.top : window.top + config.height]
    missing = config.height - len(cropped)
    return np.pad(cropped, ((0, missing), (0, 0), (0, 0))) if missing else np.ascontiguousarray(cropped)


def normalise_images(images: Tensor, config: ImageConfig) -> Tensor:
    """Turn ``(..., h, w, 3) uint8`` RGB windows into ``(..., 3, h, w) float32`` (channels-last in memory)."""
    deviation = torch.tensor(config.deviation, device=images.device) * 255.0
    mean = torch.tensor(config.mean, device=images.device) * 255.0
    return ((images.float() - mean) / deviation).movedim(-1, -3)


def stack_windows(
    images: Mapping[str, Image], rig: Rig, config: ImageConfig
) -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
    """Cut the windows of one instant.

    Args:
        images: RGB uint8 images at their stored size, by camera name; cameras may be missing.
        rig: all cameras of the car.
        config: the network's image size.

    Returns:
        ``(N, h, w, 3) uint8`` windows, black where there is no image, and ``(N,) bool``, which cameras have one.
    """
    blank = np.zeros((config.height, config.width, 3), dtype=np.uint8)
    windows = [crop_image(images[camera.name], camera, config) if camera.name in images else blank for camera in rig]
    return np.stack(windows), np.array([camera.name in images for camera in rig])


def preprocess_images(images: Mapping[str, Image], rig: Rig, config: ImageConfig) -> tuple[Tensor, Tensor]:
    """Prepare the images of one instant for the network.

    Args:
        images, rig, config: as for :func:`stack_windows`.

    Returns:
        ``(N, 3, h, w) float32`` images and ``(N,) bool``, which of them are there.
    """
    windows, valid = stack_windows(images, rig, config)
    return normalise_images(torch.from_numpy(windows), config), torch.from_numpy(valid)


def mirror_rig(rig: Rig) -> Rig:
    """Return the rig that sees the world mirrored at the x axis through horizontally flipped images.

    Training may flip images and negate y of the truth, for any rig, if it builds the look-up of this one.
    """
    mirror = np.diag([1.0, -1.0, 1.0])
    flip = np.diag([-1.0, 1.0, 1.0])
    cameras = []
    for camera in rig:
        pose = camera.camera_to_ego.copy()
        pose[:3, :3] = mirror @ pose[:3, :3] @ flip
        pose[:3, 3] = mirror @ pose[:3, 3]
        intrinsics = camera.intrinsics.copy()
        intrinsics[0, 2] = camera.width - intrinsics[0, 2]
        cameras.append(replace(camera, intrinsics=intrinsics, camera_to_ego=pose))
    return tuple(cameras)


def mirror_order(rig: Rig, tolerance: float = 1e-3) -> tuple[int, ...] | None:
    """For a mirror-symmetric rig, tell which camera takes whose place under :func:`mirror_rig`.

    ``images[:, order].flip(-1)`` with y of the truth negated is then an exact new sample of the same rig.

    Returns:
        One index per camera, or None if the rig is not symmetric within ``tolerance`` (metres, and relative pixels).
    """

    def same(first: Camera, second: Camera) -> bool:
        size_equal = (first.width, first.height) == (second.width, second.height)
        return (
            size_equal
            and np.allclose(first.camera_to_ego, second.camera_to_ego, atol=tolerance)
            and np.allclose(first.intrinsics, second.intrinsics, atol=tolerance * first.width)
        )

    mirrored = mirror_rig(rig)
    order = [next((i for i, other in enumerate(mirrored) if same(camera, other)), -1) for camera in rig]
    return None if -1 in order else tuple(order)
