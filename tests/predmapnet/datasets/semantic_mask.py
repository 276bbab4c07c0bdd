"""Masks of a frame's truth as the official files hold them; nothing in the package draws them."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from mapfusion.arrays import Float
from mapfusion.elements import ElementKind, RegionOfInterest
from predmapnet.datasets.ground_truth.raster import CANVAS, THICKNESS, Mask


def to_pixels(points: Float, roi: RegionOfInterest, canvas: tuple[int, int] = CANVAS) -> Float:
    """Metres in the ego frame to canvas coordinates; row 0 is the smallest y (not flipped).

    Args:
        points: ``(..., 2)``.
        roi: region that the canvas shows.
        canvas: columns and rows.

    Returns:
        ``(..., 2) float64``: column and row.
    """
    size = np.array(canvas)
    return np.asarray(points * (size / roi.size) + size / 2)


def semantic_mask(
    kinds: NDArray[np.int64],
    polylines: Sequence[Float],
    roi: RegionOfInterest,
    canvas: tuple[int, int] = CANVAS,
) -> Mask:
    """Draw a frame's truth: crossings filled, lines three pixels thick.

    Row 0 is the *smallest* y here, as in the official files; the network's BEV grid is this flipped along its rows.

    Args:
        kinds: ``(n,)`` of :class:`~mapfusion.ElementKind`.
        polylines: ``n`` arrays ``(k, 2)``, metres, ego frame, raw vertices.
        roi: region that the canvas shows.
        canvas: columns and rows.

    Returns:
        ``(3, rows, columns) uint8`` of 0 and 1, one layer per kind.
    """
    mask = np.zeros((len(ElementKind), canvas[1], canvas[0]), dtype=np.uint8)
    for kind, points in zip(kinds, polylines, strict=True):
        # The official code truncates toward zero; rounding would move lines by half a pixel.
        pixels = to_pixels(points[:, :2], roi, canvas).astype(np.int32)
        if kind == ElementKind.PED_CROSSING:
            cv2.fillPoly(mask[kind], [pixels], 1)
        else:
            cv2.polylines(mask[kind], [pixels], False, 1, thickness=THICKNESS, lineType=cv2.LINE_8)
    return mask
