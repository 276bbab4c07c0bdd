"""Draw polylines as masks, pixel by pixel as the official code draws them."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw

from mapfusion.arrays import Float
from mapfusion.elements import ElementKind, RegionOfInterest

Mask = NDArray[np.uint8]

CANVAS = (200, 100)
"""Columns (x) and rows (y) of a semantic mask, whatever the size of the region."""
THICKNESS = 3
SMALL_MASK = 20
"""Instance masks with fewer pixels are dilated once."""
_SMALL_MASK_KERNEL = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (7, 7))


def instance_masks(kind: int, points: Float, roi: RegionOfInterest, canvas: tuple[int, int] = CANVAS) -> Mask:
    """Draw each polyline of one kind on a mask of its own, as for the official track ids.

    Args:
        kind: of all polylines.
        points: ``(n, k, 2)``, metres, ego frame (float32 or float64, kept as it is).
        roi: region that the canvas shows.
        canvas: columns and rows.

    Returns:
        ``(n, rows * columns) uint8`` of 0 and 1.
    """
    size = roi.size.astype(points.dtype)
    pixels = (points + size / 2) / size * np.array(canvas, dtype=points.dtype)
    masks = np.zeros((len(points), canvas[1], canvas[0]), dtype=np.uint8)
    polygons = kind == ElementKind.PED_CROSSING
    for mask, line in zip(masks, pixels if polygons else pixels.astype(np.int32), strict=True):
        if polygons:
            image = Image.new("L", canvas, 0)
            ImageDraw.Draw(image).polygon(line.ravel().tolist(), outline=1, fill=1)
            mask[:] = np.asarray(image)
        else:
            cv2.polylines(mask, [line], False, 1, thickness=THICKNESS, lineType=cv2.LINE_8)
        if cv2.countNonZero(mask) < SMALL_MASK:
            mask[:] = cv2.dilate(mask, _SMALL_MASK_KERNEL, iterations=1)
    return masks.reshape(len(points), canvas[0] * canvas[1])


def mask_iou(first: Mask, second: Mask) -> Float:
    """Intersection over union of every pair of masks ``(n, pixels)`` and ``(m, pixels)``; 0 where both are empty."""
    return packed_iou(packed_bits(first), packed_bits(second))


def packed_bits(masks: Mask) -> NDArray[np.uint64]:
    """``(n, pixels)`` of 0 and 1 as ``(n, words)`` of 64 pixels each."""
    bits = np.packbits(masks, axis=1)
    words = np.zeros((len(bits), -(-bits.shape[1] // 8)), dtype=np.uint64)
    words.view(np.uint8)[:, : bits.shape[1]] = bits
    return words


def packed_iou(first: NDArray[np.uint64], second: NDArray[np.uint64]) -> Float:
    """Intersection over union of every pair of :func:`packed_bits` masks ``(n, words)`` and ``(m, words)``."""
    # Counting bits is several times as fast as a product of matrices, and starts no threads.
    together = np.bitwise_count(first[:, None] & second[None]).sum(axis=2, dtype=np.int64)
    first_area = np.bitwise_count(first).sum(axis=1, dtype=np.int64)
    second_area = np.bitwise_count(second).sum(axis=1, dtype=np.int64)
    either = first_area[:, None] + second_area[None] - together
    iou: Float = np.divide(together, either, out=np.zeros(together.shape), where=either > 0)
    return iou
