"""Targets of the losses: resampled true polylines, their equivalent orders, and rasters on the BEV grid."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from torch import Tensor

from mapfusion.arrays import Byte, Float
from mapfusion.elements import ElementKind, RegionOfInterest
from mapfusion.geometry import resample
from predmapnet.scenes import FrameTruth

LINE_THICKNESS = 2
"""As OpenCV counts: with fractional coordinates it draws lines 3 cells (0.9 m) wide, as in MapTracker's target."""
SUBPIXEL_BITS = 4


@dataclass
class Targets:
    """Truth of ``B`` frames, flattened over frames: ``M`` pieces in all.

    Attributes:
        batch: number of frames ``B``.
        frame: ``(M,) int64``, which frame each piece belongs to, ascending.
        kinds: ``(M,) int64``.
        element_ids: ``(M,) int64``; unique per kind within a scene, -1 where unknown.
        points: ``(M, P, 2) float32``, normalised to the ROI; rings repeat their first point at the end.
        masks: ``(M, H, W) float32`` in {0, 1}; row 0 is the largest y. Without rows where nobody asked for rasters.
        segmentation: ``(B, 3, H, W) float32``, union of the masks per kind.
    """

    batch: int
    frame: Tensor
    kinds: Tensor
    element_ids: Tensor
    points: Tensor
    masks: Tensor
    segmentation: Tensor

    def __len__(self) -> int:
        return len(self.kinds)

    def to(self, device: torch.device) -> Targets:
        """Move every tensor to ``device``."""
        moved = {name: value.to(device) for name, value in vars(self).items() if isinstance(value, Tensor)}
        return Targets(batch=self.batch, **moved)


def equivalent_orders(count: int) -> tuple[Tensor, Tensor]:
    """List the orders of ``count`` points that describe the same shape.

    Returns:
        Index tables: ``(2, count)`` for open lines (both directions) and ``(2 * (count - 1), count)`` for closed
        rings whose last point repeats the first (every start, both directions).
    """
    forward, corners = torch.arange(count), count - 1
    start = torch.arange(corners)[:, None]
    ring = torch.cat([(start + forward) % corners, (start - forward) % corners])
    return torch.stack([forward, forward.flip(0)]), ring


def truth_targets(
    truths: Sequence[FrameTruth], roi: RegionOfInterest, points: int, grid: tuple[int, int] | None
) -> Targets:
    """Turn the truth of a batch of frames into targets of ``points`` points per polyline.

    ``grid`` is rows and columns of the rasters, which cover the region; None draws nothing (masks of zero size).
    """
    frame = [index for index, truth in enumerate(truths) for _ in truth.kinds]
    lines = [line for truth in truths for line in truth.polylines]
    kinds = np.concatenate([np.zeros(0, np.int64), *(truth.kinds for truth in truths)])
    element_ids = np.concatenate([np.zeros(0, np.int64), *(truth.element_ids for truth in truths)])
    resampled = np.stack([resample(line, points) for line in lines]) if lines else np.zeros((0, points, 2))
    rows, columns = grid or (0, 0)
    masks = np.zeros((len(lines), rows, columns), np.uint8)
    segmentation = np.zeros((len(truths), len(ElementKind), rows, columns), np.uint8)
    if grid:
        for index, line in enumerate(lines):
            draw_element(masks[index], line, ElementKind(kinds[index]), roi)
            segmentation[frame[index], kinds[index]] |= masks[index]
    return Targets(
        batch=len(truths),
        frame=torch.tensor(frame, dtype=torch.int64),
        kinds=torch.from_numpy(kinds),
        element_ids=torch.from_numpy(element_ids),
        points=torch.from_numpy((resampled / roi.size + 0.5).astype(np.float32)),
        masks=torch.from_numpy(masks).float(),
        segmentation=torch.from_numpy(segmentation).float(),
    )


def draw_element(mask: Byte, points: Float, kind: ElementKind, roi: RegionOfInterest) -> None:
    """Draw one element ``(n, 2)``, metres, ego frame: lines with a thickness, crossings filled.

    The ``mask (rows, columns)`` is set to 1 in place; row 0 is the largest y, column 0 the smallest x of the region.
    """
    rows, columns = mask.shape
    column = (points[:, 0] / roi.length + 0.5) * columns - 0.5
    row = (0.5 - points[:, 1] / roi.width) * rows - 0.5
    vertices = np.round(np.stack([column, row], axis=1) * 2**SUBPIXEL_BITS).astype(np.int32)
    if kind.is_ring:
        cv2.fillPoly(mask, [vertices], 1, shift=SUBPIXEL_BITS)
    else:
        cv2.polylines(mask, [vertices], False, 1, thickness=LINE_THICKNESS, shift=SUBPIXEL_BITS)
