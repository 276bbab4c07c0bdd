"""Track ids of polylines over the frames of a scene, as the official consistency metric forms them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import linear_sum_assignment

from mapfusion.arrays import Float, Integer
from mapfusion.elements import ElementKind, RegionOfInterest
from mapfusion.geometry import inverse_pose, resample
from predmapnet.datasets.ground_truth.raster import Mask, instance_masks, mask_iou
from predmapnet.scenes import FrameTruth

POINTS = 20
"""Points per element, as in the official training."""
NORMALISATION_EPSILON = 1e-5
MINIMUM_IOU = 0.01
"""Masks must overlap by more than this for the same element in two frames."""


@dataclass(frozen=True)
class TrackFrame:
    """Polylines ``(n, 20, 2)`` of one frame, normalised over the region, ready to be tracked."""

    kinds: Integer
    points: Float
    ego_to_global: Float


def track_frame(truth: FrameTruth, ego_to_global: Float, roi: RegionOfInterest) -> TrackFrame:
    """Bring a frame's truth to the form that is tracked: 20 points per element, normalised."""
    points = [normalised(resample(line, POINTS), roi) for line in truth.polylines]
    return TrackFrame(truth.kinds, np.array(points).reshape(-1, POINTS, 2), ego_to_global)


def official_track_ids(frames: Sequence[TrackFrame], roi: RegionOfInterest) -> list[Integer]:
    """Give ids ``(n,)`` to the true elements of all frames of one scene in order.

    An element inherits the id of the element of the frame before that overlaps it best after the ego motion; nothing
    is remembered for longer than one frame. Ids count from 0 within each kind, new ones in row order.
    """
    ids = [np.full(len(frame.kinds), -1, dtype=np.int64) for frame in frames]
    for kind in ElementKind:
        next_id = 0
        for index, frame in enumerate(frames):
            rows = np.flatnonzero(frame.kinds == kind)
            current = np.full(len(rows), -1, dtype=np.int64)
            previous_rows = np.flatnonzero(frames[index - 1].kinds == kind) if index else rows[:0]
            if len(rows) and len(previous_rows):
                warped = warp(frames[index - 1].points[previous_rows], frames[index - 1], frame, roi)
                before = instance_masks(kind, from_normalised(warped, roi), roi)
                now = instance_masks(kind, from_normalised(frame.points[rows], roi), roi)
                old, new = match_masks(before, now, MINIMUM_IOU)
                current[new] = ids[index - 1][previous_rows[old]]
            fresh = np.flatnonzero(current < 0)
            current[fresh] = next_id + np.arange(len(fresh))
            next_id += len(fresh)
            ids[index][rows] = current
    return ids


def normalised(points: Float, roi: RegionOfInterest) -> Float:
    """Coordinates ``(..., 2)`` over the region: 0 at its lower left corner, just under 1 at the opposite one.

    They may leave [0, 1] by rounding.
    """
    return (points + roi.size / 2) / (roi.size + NORMALISATION_EPSILON)


def from_normalised(points: Float, roi: RegionOfInterest) -> Float:
    """Normalised points to metres, as the official tracking does it (without the epsilon of the normalisation).

    The type, float32 or float64, is kept.
    """
    size: Float = roi.size.astype(points.dtype)
    return np.asarray(points * size - size / 2)


def warp(
    points: Float, before: TrackFrame, now: TrackFrame, roi: RegionOfInterest, single_precision: bool = True
) -> Float:
    """Move normalised points into the ego frame of another instant; what leaves the region is pressed onto its border.

    Args:
        points: ``(n, k, 2)``, normalised, ego frame of ``before``.
        before, now: the two instants.
        roi: the region.
        single_precision: normalise in float32, as the official code does for ground truth; predictions are rounded
            to float32 and then normalised in float64.
    """
    metres = from_normalised(points, roi)
    lifted = np.concatenate([metres, np.zeros_like(metres[..., :1]), np.ones_like(metres[..., :1])], axis=-1)
    before_to_now = inverse_pose(now.ego_to_global) @ before.ego_to_global
    moved = (lifted @ before_to_now.T)[..., :2].astype(np.float32)
    precise = moved if single_precision else moved.astype(np.float64)
    size: Float = roi.size.astype(precise.dtype)
    clipped: Float = np.clip((precise + size / 2) / size, 0.0, 1.0)
    return clipped


def match_masks(before: Mask, now: Mask, minimum_iou: float) -> tuple[Integer, Integer]:
    """Assign masks of two frames to each other for the greatest sum of IoU, each above the minimum: rows of both."""
    iou = mask_iou(before, now)
    rows, columns = linear_sum_assignment(-iou)
    keep = iou[rows, columns] > minimum_iou
    return rows[keep], columns[keep]
