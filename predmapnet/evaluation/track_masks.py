"""Instance masks by which elements of different instants are told to be the same (MapTracker's tracks).

Canvas of 200 x 100 pixels over the ROI whatever its size; lines three pixels wide, crossings filled.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw

from mapfusion.elements import ElementKind, RegionOfInterest

Float = NDArray[np.float64]
Integer = NDArray[np.int64]
Words = NDArray[np.uint64]

CANVAS = (200, 100)
"""Width (x) and height (y) in pixels."""
LINE_WIDTH = 3
FEWEST_PIXELS = 20
"""Smaller masks are dilated once by an ellipse of 7 x 7 pixels."""

_ELLIPSE = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (7, 7))
_WORDS = CANVAS[0] * CANVAS[1] // 64 + 1


def draw_masks(lines: Float | Sequence[Float], kinds: Integer, roi: RegionOfInterest) -> Words:
    """Draw each element alone.

    Args:
        lines: ``n`` arrays ``(p, 2)``, metres, ego frame.
        kinds: ``(n,)``.
        roi: what the canvas covers.

    Returns:
        ``(n, 313) uint64``: the pixels of each mask as bits.
    """
    width, height = CANVAS
    packed = np.zeros((len(lines), _WORDS * 8), dtype=np.uint8)
    for row, (points, kind) in enumerate(zip(lines, kinds, strict=True)):
        pixels = (points + roi.size / 2) / roi.size * CANVAS
        if kind == ElementKind.PED_CROSSING:
            # Pillow, not OpenCV: the official masks of crossings keep the fractions of the vertices.
            image = Image.new("L", CANVAS)
            ImageDraw.Draw(image).polygon(pixels.ravel().tolist(), outline=1, fill=1)
            mask = np.array(image)
        else:
            mask = np.zeros((height, width), dtype=np.uint8)
            cv2.polylines(mask, [pixels.astype(np.int32)], isClosed=False, color=1, thickness=LINE_WIDTH)
        if cv2.countNonZero(mask) < FEWEST_PIXELS:
            mask = cv2.dilate(mask, _ELLIPSE)
        packed[row, : width * height // 8] = np.packbits(mask)
    return packed.view(np.uint64)


def mask_iou(first: Words, second: Words) -> Float:
    """Overlap of every pair of masks, ``(n, m)``; 0 where both are empty."""
    shared = np.bitwise_count(first[:, None] & second[None]).sum(axis=2, dtype=np.int64)
    areas = np.bitwise_count(first).sum(axis=1, dtype=np.int64)
    other = np.bitwise_count(second).sum(axis=1, dtype=np.int64)
    union = areas[:, None] + other[None] - shared
    iou: Float = np.divide(shared, union, out=np.zeros(shared.shape), where=union > 0)
    return iou
