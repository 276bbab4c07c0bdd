"""IoU of the BEV segmentation, pixels summed over the data set (MapTracker's raster evaluation)."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from mapfusion.elements import ElementKind

Masks = NDArray[np.bool_]


def segmentation_iou(pairs: Iterable[tuple[Masks, Masks]]) -> dict[str, float]:
    """Overlap of predicted and true masks per kind.

    Args:
        pairs: per frame predicted and true masks, each ``(3, rows, columns) bool`` on the same grid (row 0 is the
            largest y, as everywhere here; official truth masks lie the other way up).

    Returns:
        IoU by kind label, and their mean as ``mIoU``; a kind that never occurs counts as 0, as officially.
    """
    shared, union = np.zeros(len(ElementKind)), np.zeros(len(ElementKind))
    for predicted, truth in pairs:
        shared += (predicted & truth).sum(axis=(1, 2))
        union += (predicted | truth).sum(axis=(1, 2))
    iou = shared / (union + 1e-7)
    return {kind.label: float(iou[kind]) for kind in ElementKind} | {"mIoU": float(iou.mean())}
