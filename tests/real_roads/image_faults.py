"""Faults of photographs, put into decoded images.

Every fault takes an RGB image ``(h, w, 3) uint8``, a :class:`Shot` and a severity from 0, and returns a new image.
Severity 0 changes nothing; 1, 2 and 3 are the three that are measured. Lengths in pixels hold for images 800 wide and
grow with the width, so that a camera of more pixels is as ill as one of fewer.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from mapfusion.arrays import Float
from predmapnet.scenes import Camera, Image

WIDTH = 800
"""Pixels of the width that lengths are given for."""
FARTHEST = 150.0
"""Metres; what does not lie on the ground before that is taken to be that far away."""


@dataclass(frozen=True)
class Shot:
    """Which image it is: all chance comes from here.

    Attributes:
        scene: name of the scene.
        index: of the frame.
        camera: that took it; ``ground_height`` and mounting say how far the ground is in each pixel.
        seed: another one gives other rain.
    """

    scene: str
    index: int
    camera: Camera
    seed: int = 0

    def lasting(self) -> np.random.Generator:
        """Chance that is the same for all images of this camera in the scene."""
        return np.random.default_rng([self.seed, zlib.crc32(f"{self.scene}/{self.camera.name}".encode())])

    def passing(self) -> np.random.Generator:
        """Chance of this image alone."""
        key = zlib.crc32(f"{self.scene}/{self.camera.name}".encode())
        return np.random.default_rng([self.seed, key, self.index + 1])


Fault = Callable[[Image, Shot, float], Image]


def steps(values: Sequence[float], severity: float) -> float:
    """Strength at a severity: ``values`` at 0, 1, 2 and 3, straight lines between."""
    return float(np.interp(severity, np.arange(len(values)), values))


def brighter(image: Image, shot: Shot, severity: float) -> Image:
    """Exposure too long: values times 1.4, 1.8 and 2.4; what is above white burns out."""
    return _scaled(image, steps((1.0, 1.4, 1.8, 2.4), severity))


def darker(image: Image, shot: Shot, severity: float) -> Image:
    """Exposure too short: values times 0.7, 0.5 and 0.3."""
    return _scaled(image, steps((1.0, 0.7, 0.5, 0.3), severity))


def low_light(image: Image, shot: Shot, severity: float) -> Image:
    """Dusk with a sensor at its limit: 0.5, 0.3 and 0.18 of the values, and shot and read noise."""
    gain = steps((1.0, 0.5, 0.3, 0.18), severity)
    dark = image.astype(np.float32) * np.float32(gain)
    spread = np.sqrt(dark * np.float32(steps((0.0, 0.4, 0.8, 1.2), severity))) + steps((0.0, 2.0, 3.0, 4.0), severity)
    return _bytes(dark + spread * _normal(image.shape, shot.passing()))


def fog(image: Image, shot: Shot, severity: float) -> Image:
    """Fog with a visibility of 120, 60 and 30 m: Koschmieder's law over the distance of flat ground."""
    if severity <= 0:
        return image.copy()
    extinction = steps((0.0, 3.0 / 120.0, 3.0 / 60.0, 3.0 / 30.0), severity)
    clear = np.exp(-extinction * ground_distance(shot.camera)).astype(np.float32)[..., None]
    return _bytes(image * clear + np.float32(205.0) * (1.0 - clear))


def rain(image: Image, shot: Shot, severity: float) -> Image:
    """Rain: less contrast, bright streaks, and drops on the lens that blur what is behind them."""
    if severity <= 0:
        return image.copy()
    random, scale = shot.passing(), image.shape[1] / WIDTH
    height, width = image.shape[:2]
    veil = steps((0.0, 0.1, 0.2, 0.3), severity)
    result = image.astype(np.float32) * (1.0 - veil) + 150.0 * veil
    streaks = np.zeros((height, width), dtype=np.uint8)
    count = int(steps((0, 150, 350, 700), severity))
    lean = shot.lasting().normal(0.0, 0.12)
    for x, y, length in zip(*random.uniform([[0], [0], [12]], [[width], [height], [36]], (3, count)), strict=True):
        reach = length * scale
        cv2.line(streaks, (int(x), int(y)), (int(x + lean * reach), int(y + reach)), 255, max(1, round(scale)))
    bright = cv2.GaussianBlur(streaks, (0, 0), 0.6 * scale).astype(np.float32)[..., None] / 255.0
    result += bright * (70.0 * (1.0 - result / 255.0))
    drops = _blobs(image.shape[:2], steps((0.0, 0.03, 0.08, 0.16), severity), 5.0, 16.0, shot.lasting())
    blurred = cv2.GaussianBlur(result, (0, 0), 6.0 * scale)
    return _bytes(result * (1.0 - drops) + blurred * drops)


def motion_blur(image: Image, shot: Shot, severity: float) -> Image:
    """A long exposure while the car turns: smeared along rows by 5, 10 and 20 pixels."""
    length = max(1.0, steps((1.0, 5.0, 10.0, 20.0), severity) * image.shape[1] / WIDTH)
    half = int(np.ceil((length - 1.0) / 2.0))
    kernel = np.clip((length - 1.0) / 2.0 + 1.0 - np.abs(np.arange(-half, half + 1)), 0.0, 1.0)[None]
    return np.asarray(cv2.filter2D(image, -1, kernel / kernel.sum(), borderType=cv2.BORDER_REPLICATE), dtype=np.uint8)


def noise(image: Image, shot: Shot, severity: float) -> Image:
    """Noise of the sensor: 8, 16 and 32 grey levels in each channel of each pixel."""
    return _bytes(image + np.float32(steps((0.0, 8.0, 16.0, 32.0), severity)) * _normal(image.shape, shot.passing()))


def colour(image: Image, shot: Shot, severity: float) -> Image:
    """A camera with its own white balance and saturation, the same all along the scene."""
    random, strength = shot.lasting(), steps((0.0, 0.12, 0.25, 0.4), severity)
    tint = 1.0 + strength * (random.choice([-1.0, 1.0]) * np.array([1.0, 0.0, -1.0]) + random.uniform(-0.3, 0.3, 3))
    grey = image.mean(axis=2, keepdims=True, dtype=np.float32)
    saturated = grey + (image - grey) * np.float32(1.0 + strength * random.choice([-1.5, 1.5]))
    return _bytes(saturated * tint.astype(np.float32))


def dirt(image: Image, shot: Shot, severity: float) -> Image:
    """Mud on the lens over 4, 10 and 20 % of the image, at the same place all along the scene."""
    cover = _blobs(image.shape[:2], steps((0.0, 0.04, 0.10, 0.20), severity), 10.0, 45.0, shot.lasting())
    mud = np.array([74.0, 66.0, 56.0], dtype=np.float32)
    return _bytes(image * (1.0 - 0.95 * cover) + mud * (0.95 * cover))


IMAGE_FAULTS: dict[str, Fault] = {
    "exposure up": brighter,
    "exposure down": darker,
    "low light": low_light,
    "fog": fog,
    "rain": rain,
    "motion blur": motion_blur,
    "noise": noise,
    "colour": colour,
    "dirt": dirt,
}


def ground_distance(camera: Camera) -> Float:
    """Distance along the ray of each pixel's centre to the flat ground, ``(h, w)`` metres, at most :data:`FARTHEST`."""
    columns, rows = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    k = camera.intrinsics
    rays = np.stack([(columns - k[0, 2]) / k[0, 0], (rows - k[1, 2]) / k[1, 1], np.ones_like(rows)], axis=-1)
    down = -(rays @ camera.camera_to_ego[2, :3])
    height = camera.camera_to_ego[2, 3] - camera.ground_height
    with np.errstate(divide="ignore"):
        along = np.where(down > 1e-9, height / np.maximum(down, 1e-9), np.inf)
    return np.asarray(np.minimum(along * np.linalg.norm(rays, axis=-1), FARTHEST))


def _scaled(image: Image, gain: float) -> Image:
    table = np.clip(np.round(np.arange(256) * gain), 0, 255).astype(np.uint8)
    return np.asarray(table[image])


def _bytes(values: NDArray[np.floating]) -> Image:
    return np.asarray(np.clip(np.round(values), 0, 255), dtype=np.uint8)


def _normal(shape: tuple[int, ...], random: np.random.Generator) -> NDArray[np.float32]:
    return random.standard_normal(shape, dtype=np.float32)


def _blobs(
    size: tuple[int, int], share: float, smallest: float, largest: float, random: np.random.Generator
) -> NDArray[np.float32]:
    """Soft round spots that cover a share of an image, ``(h, w, 1)`` from 0 to 1; more share adds to the same spots."""
    height, width = size
    scale = width / WIDTH
    cover = np.zeros(size, dtype=np.uint8)
    while share > 0 and np.count_nonzero(cover) < share * cover.size:
        x, y, radius = random.uniform([0, 0, smallest * scale], [width, height, largest * scale])
        cv2.circle(cover, (int(x), int(y)), max(1, round(radius)), 255, -1)
    return np.asarray(cv2.GaussianBlur(cover, (0, 0), 2.0 * scale), dtype=np.float32)[..., None] / np.float32(255.0)
