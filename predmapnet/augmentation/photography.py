"""Photographs of the same scene by other cameras: exposure, tone, optics, sensor and file, the truth being the same.

Images of a frame are ``(N, h, w, 3) uint8``, RGB. Light is changed as a camera does it: values are decoded to linear
light, exposed, clipped and encoded with another tone curve, by one table per camera and channel.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache

import cv2
import numpy as np

from mapfusion.arrays import Byte, Float32

DISPLAY_GAMMA = 2.2
EXTREME_SHARE = 0.5
"""Share of the frames whose exposure may take any value; that of the others lies around what it was."""
DARK_SIDE = 1.3
"""Exposures fall that many times as far as they rise (as logarithms): too bright an image is empty sooner."""


@dataclass(frozen=True)
class PhotographySettings:
    """Differences between cameras. Every field may be zero, which switches its effect off.

    Attributes:
        exposure: largest rise of the exposure, natural logarithm of linear light; it falls by up to 1.3 times that.
        camera_exposure: standard deviation of the exposure between the cameras of a frame, as a logarithm.
        colour: standard deviation of the white balance, as a logarithm of linear light.
        tone: standard deviation of the tone curve's gamma, as a logarithm; contrast varies by as much.
        offset: largest shift of the black level, of 255.
        noise: largest standard deviation of the pixel noise, of 255.
        blur: probability of defocus or of motion blur.
        sharpening: probability of edges enhanced by the camera.
        resolution: probability of a photograph with fewer pixels than the network's input.
        jpeg: probability of visible compression.
        shadow: probability that shadows fall into a camera's image.
        veil: probability of stray light over a part of a camera's image.
        dirt: probability of a smeared spot on a camera's lens.
    """

    exposure: float = 2.0
    camera_exposure: float = 0.15
    colour: float = 0.10
    tone: float = 0.22
    offset: float = 12.0
    noise: float = 10.0
    blur: float = 0.2
    sharpening: float = 0.25
    resolution: float = 0.15
    jpeg: float = 0.3
    shadow: float = 0.15
    veil: float = 0.10
    dirt: float = 0.06


def tone_tables(cameras: int, settings: PhotographySettings, generator: np.random.Generator) -> Byte:
    """Draw how stored values change: ``(cameras, 256, 3) uint8``, from a byte to a byte."""
    exposure = _exposure(settings, generator) + settings.camera_exposure * generator.standard_normal((cameras, 1, 1))
    balance = settings.colour * generator.standard_normal((1, 1, 3))
    balance = balance - balance.mean() + 0.15 * settings.colour * generator.standard_normal((cameras, 1, 3))
    linear = (np.arange(256) / 255)[None, :, None] ** DISPLAY_GAMMA * np.exp(exposure + balance)
    # A film-like shoulder keeps some of what is too bright; without it, as in half of the frames, whites are cut off.
    shoulder = max(0.0, generator.uniform(-0.8, 0.8)) if settings.tone > 0 else 0.0
    knee = 1.0 - 0.6 * shoulder
    over = np.maximum(linear - knee, 0.0)
    room = 1.0 - knee
    soft = np.minimum(linear, knee) + (room * -np.expm1(-over / room) if room > 0 else 0.0)
    gamma, contrast = np.exp(settings.tone * generator.standard_normal(2) * [1.0, 1.6])
    pivot = 0.45
    display = pivot + (np.clip(soft, 0.0, 1.0) ** (gamma / DISPLAY_GAMMA) - pivot) * contrast
    levels = display * 255 + generator.uniform(-1, 1) * settings.offset
    tables: Byte = np.clip(np.rint(levels), 0, 255).astype(np.uint8)
    return tables


def _exposure(settings: PhotographySettings, generator: np.random.Generator) -> float:
    """Draw the exposure of a frame, as a logarithm: mostly near zero, for a share of the frames anywhere."""
    wide, narrow = generator.uniform(-1.0, 1.0), float(np.clip(generator.normal(0.0, 0.22), -1.0, 1.0))
    share = (wide if wide > 0 else DARK_SIDE * wide) if generator.random() < EXTREME_SHARE else narrow
    return settings.exposure * share


def add_stray_light(image: Byte, settings: PhotographySettings, generator: np.random.Generator) -> Byte:
    """Add shadows on the ground, veils of light, and dirt on the lens to one camera's image ``(h, w, 3)``."""
    shadow, veil, dirt = generator.random(3) < [settings.shadow, settings.veil, settings.dirt]
    height, width = image.shape[:2]
    if shadow:
        mask = _shadow_mask(height, width, generator)
        image = np.asarray(cv2.multiply(image, cv2.merge([mask] * 3), scale=1 / 255), np.uint8)
    if veil:
        strength = _spot(height, width, generator.uniform(0.4, 1.5), generator) * generator.uniform(0.2, 0.7)
        colour = np.minimum(generator.uniform(150, 255) * np.exp(generator.normal(0, 0.06, 3)), 255)
        image = np.asarray(cv2.blendLinear(image, np.full_like(image, colour), 1 - strength, strength), np.uint8)
    if dirt:
        strength = np.zeros((height, width), np.float32)
        for _ in range(int(generator.integers(1, 5))):
            strength = np.maximum(strength, _spot(height, width, generator.uniform(0.05, 0.25), generator))
        smeared = cv2.blur(image, (2 * (width // 24) + 1, 2 * (height // 16) + 1))
        smeared = cv2.convertScaleAbs(smeared, alpha=generator.uniform(0.4, 1.0))
        strength = np.minimum(1.0, 1.6 * strength) * generator.uniform(0.5, 0.95)
        image = np.asarray(cv2.blendLinear(image, smeared, 1 - strength, strength), np.uint8)
    return image


def _spot(height: int, width: int, size: float, generator: np.random.Generator) -> Float32:
    """A soft spot anywhere in the image, 1 in its middle, ``(h, w)``; ``size`` in image widths."""
    x, y = generator.uniform(0, width), generator.uniform(-0.3, 1.0) * height
    stretch, turn = math.exp(generator.normal(0, 0.4)), generator.uniform(0, math.pi)
    columns, rows = np.arange(width, dtype=np.float32)[None] - x, np.arange(height, dtype=np.float32)[:, None] - y
    along = (math.cos(turn) * columns + math.sin(turn) * rows) / (0.5 * size * width * stretch)
    across = (math.cos(turn) * rows - math.sin(turn) * columns) / (0.5 * size * width / stretch)
    spot: Float32 = np.exp(-(along * along + across * across))
    return spot


def _shadow_mask(height: int, width: int, generator: np.random.Generator) -> Byte:
    """Light left under shadows of poles, wires, trees and walls, ``(h, w)``, 255 where there is none."""
    mask = np.full((height, width), 255, dtype=np.uint8)
    horizon = 0.3 * height
    for _ in range(int(generator.integers(1, 5))):
        left = int(generator.integers(40, 190))
        kind = generator.random()
        far, near = generator.uniform(-0.5, 1.5, 2) * width
        if kind < 0.5:
            # Of a pole or a wire: it widens towards the camera.
            thick = generator.uniform(0.01, 0.12) * width
            corners = [[far, horizon], [far + 0.1 * thick, horizon], [near + thick, height], [near, height]]
            outline = np.array(corners)
        elif kind < 0.8:
            # Of a wall: a whole strip across the road.
            top, bottom = horizon + np.sort(generator.uniform(0.05, 0.9, 2)) * (height - horizon)
            tilt = generator.uniform(-0.3, 0.3, 2) * (height - horizon)
            outline = np.array([[0, top], [width, top + tilt[0]], [width, bottom + tilt[1]], [0, bottom]])
        else:
            middle = np.array([near, horizon + generator.uniform(0.1, 1.0) * (height - horizon)])
            angles = np.sort(generator.uniform(0, 2 * np.pi, 9))
            radius = generator.uniform(0.05, 0.3, 9) * width
            outline = middle + np.stack([np.cos(angles) * radius, 0.4 * np.sin(angles) * radius], axis=1)
        cv2.fillPoly(mask, [np.round(outline).astype(np.int32)], left, cv2.LINE_AA)
    return np.asarray(cv2.blur(mask, (3, 3)), dtype=np.uint8) if generator.random() < 0.5 else mask


def blur(images: Byte, settings: PhotographySettings, generator: np.random.Generator) -> Byte:
    """Blur by defocus or motion, the same for all cameras, or for one that is out of focus."""
    if generator.random() >= settings.blur:
        return images
    scale = images.shape[2] / 256
    narrow, wide = generator.uniform([0.35, 0.8], [0.8, 2.2]) * scale
    kernel = _motion_kernel(narrow, wide, generator.normal(0, 0.25)) if generator.random() < 0.5 else None
    blurred = images.copy()
    for index in range(len(images)) if generator.random() < 0.7 else [int(generator.integers(len(images)))]:
        if kernel is None:
            cv2.GaussianBlur(images[index], (0, 0), narrow, blurred[index], borderType=cv2.BORDER_REPLICATE)
        else:
            cv2.filter2D(images[index], -1, kernel, blurred[index], borderType=cv2.BORDER_REPLICATE)
    return blurred


def _motion_kernel(narrow: float, wide: float, turn: float) -> Float32:
    """A long kernel, turned from the horizontal by some radians; widths are standard deviations, pixels."""
    reach = max(2, round(1.8 * wide))
    rows, columns = np.mgrid[-reach : reach + 1, -reach : reach + 1].astype(np.float32)
    along, across = np.cos(turn) * columns + np.sin(turn) * rows, np.cos(turn) * rows - np.sin(turn) * columns
    kernel = np.exp(-0.5 * ((along / wide) ** 2 + (across / narrow) ** 2))
    normalised: Float32 = (kernel / kernel.sum()).astype(np.float32)
    return normalised


def add_noise(images: Byte, settings: PhotographySettings, generator: np.random.Generator) -> Byte:
    """Add noise, strong in few frames; all cameras have the same grains, each at places of its own."""
    deviation = settings.noise * generator.random() ** 2
    if deviation < 0.3:
        return images
    shape, size = images.shape[1:], images[0].size
    start = generator.integers(size)
    grain = _grains(size)[start : start + size].reshape(shape) * np.float32(deviation)
    if generator.random() < 0.3:
        # Noise reduction and demosaicing leave it in coarse grains.
        grain = np.asarray(cv2.GaussianBlur(grain, (3, 3), 0.8), dtype=np.float32) * 1.8
    if generator.random() < 0.4:
        grain[:] = grain[:, :, :1]
    twice = np.tile(np.rint(grain).astype(np.int16).ravel(), 2)
    noisy = np.empty_like(images)
    for index, shift in enumerate(generator.integers(0, size // 3, len(images)) * 3):
        cv2.add(images[index], twice[shift : shift + size].reshape(shape), noisy[index], dtype=cv2.CV_8U)
    return noisy


@cache
def _grains(size: int) -> Float32:
    """Normal noise for two images of that size: drawing it for every frame costs more than all else about noise."""
    return np.random.default_rng(0).standard_normal(2 * size, dtype=np.float32)


def save_and_load(images: Byte, settings: PhotographySettings, generator: np.random.Generator) -> Byte:
    """Sharpen, lower the resolution and compress, the same for all cameras of a frame."""
    sharper, smaller, packed = generator.random(3) < [settings.sharpening, settings.resolution, settings.jpeg]
    amount, share = float(generator.uniform(0.2, 1.2)), float(generator.uniform(0.45, 0.9))
    quality = int(generator.integers(20, 85))
    if not (sharper or smaller or packed):
        return images
    changed = images.copy()
    height, width = images.shape[1:3]
    for picture in changed:
        if sharper:
            cv2.addWeighted(picture, 1 + amount, cv2.GaussianBlur(picture, (0, 0), 1.0), -amount, 0, picture)
        if smaller:
            small = cv2.resize(picture, (round(width * share), round(height * share)), interpolation=cv2.INTER_AREA)
            cv2.resize(small, (width, height), picture, interpolation=cv2.INTER_LINEAR)
        if packed:
            colours = cv2.cvtColor(picture, cv2.COLOR_RGB2BGR)
            _, encoded = cv2.imencode(".jpg", colours, [cv2.IMWRITE_JPEG_QUALITY, quality])
            picture[:] = np.asarray(cv2.imdecode(encoded, cv2.IMREAD_COLOR_RGB))
    return changed
