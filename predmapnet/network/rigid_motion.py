"""Poses in three dimensions: relative motion and quaternions."""

from __future__ import annotations

import torch
from torch import Tensor


def invert_pose(pose: Tensor) -> Tensor:
    """Invert rigid poses ``(..., 4, 4)`` in their own precision."""
    turned_back = pose[..., :3, :3].transpose(-1, -2)
    inverse = torch.zeros_like(pose)
    inverse[..., :3, :3] = turned_back
    inverse[..., :3, 3:] = -(turned_back @ pose[..., :3, 3:])
    inverse[..., 3, 3] = 1.0
    return inverse


def relative_pose(a_to_global: Tensor, b_to_global: Tensor) -> Tensor:
    """Return ``a_to_b (..., 4, 4) float64`` of two poses ``(..., 4, 4)``."""
    return invert_pose(b_to_global).double() @ a_to_global.double()


def quaternion(rotation: Tensor) -> Tensor:
    """Turn rotation matrices into unit quaternions.

    Args:
        rotation: ``(..., 3, 3)``.

    Returns:
        ``(..., 4)`` as (x, y, z, w); the largest component is positive.
    """
    m = rotation
    xx, yy, zz = m[..., 0, 0], m[..., 1, 1], m[..., 2, 2]
    ww = xx + yy + zz
    x, y, z = (m[..., i, j] - m[..., j, i] for i, j in ((2, 1), (0, 2), (1, 0)))
    xy, yz, zx = (m[..., i, j] + m[..., j, i] for i, j in ((0, 1), (1, 2), (2, 0)))
    # Four times the outer product of the quaternion with itself; the row of the largest component is the most exact.
    outer = torch.stack(
        [
            torch.stack([1 + xx - yy - zz, xy, zx, x], dim=-1),
            torch.stack([xy, 1 - xx + yy - zz, yz, y], dim=-1),
            torch.stack([zx, yz, 1 - xx - yy + zz, z], dim=-1),
            torch.stack([x, y, z, 1 + ww], dim=-1),
        ],
        dim=-2,
    )
    largest = torch.stack([xx, yy, zz, ww], dim=-1).argmax(dim=-1)
    row = outer.take_along_dim(largest[..., None, None], dim=-2).squeeze(-2)
    return row / row.norm(dim=-1, keepdim=True)
