"""The motion of the car between two instants: as poses, and of points, polylines and BEV maps."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor

from mapfusion.elements import RegionOfInterest
from predmapnet.network.layers import cell_centres


def relative_motion(a_to_global: Tensor, b_to_global: Tensor) -> Tensor:
    """Return the motion of the ground from ego frame a to ego frame b, of poses ``(..., 4, 4) float64``.

    Returns:
        ``(..., 2, 3) float32``: rotation and translation (metres) that map x, y of frame a to frame b. Computed in
        double precision, since global coordinates are large.
    """
    rotation = b_to_global[..., :3, :3].transpose(-1, -2)
    position = a_to_global[..., :3, 3:] - b_to_global[..., :3, 3:]
    a_to_b = torch.cat([rotation @ a_to_global[..., :3, :3], rotation @ position], dim=-1)
    return plane_motion(a_to_b).float()


def plane_motion(a_to_b: Tensor) -> Tensor:
    """Return the part ``(..., 2, 3)`` of poses ``(..., 4, 4)`` or ``(..., 3, 4)`` that moves x and y of the ground."""
    return torch.cat([a_to_b[..., :2, :2], a_to_b[..., :2, 3:]], dim=-1)


def move_points(points: Tensor, a_to_b: Tensor, roi: RegionOfInterest) -> Tensor:
    """Move normalised points ``(B, ..., 2)`` from ego frame a to ego frame b; they may then lie outside [0, 1].

    Args:
        points: in frame a.
        a_to_b: ``(B, 2, 3)``, metres, in the precision of the points.
        roi: the region of both frames.
    """
    x, y = (points - 0.5).flatten(1, -2).unbind(-1)
    metres = torch.stack([x * roi.length, y * roi.width], dim=-1)
    moved = metres @ a_to_b[:, :, :2].transpose(1, 2) + a_to_b[:, None, :, 2]
    x, y = moved.unbind(-1)
    return (torch.stack([x / roi.length, y / roi.width], dim=-1) + 0.5).view_as(points)


def warp_bev(maps: Tensor, current_to_past: Tensor, roi: RegionOfInterest) -> Tensor:
    """Show past BEV maps in the current ego frame, bilinearly at its cell centres; zeros where they do not reach.

    Args:
        maps: ``(M, C, H, W)``, in the past frame.
        current_to_past: ``(M, 2, 3)``, metres.
        roi: the region that the grid covers in both frames.
    """
    rows, columns = maps.shape[-2:]
    cells = cell_centres(rows, columns, maps.device).expand(len(maps), rows, columns, 2)
    past = move_points(cells, current_to_past, roi)
    grid = torch.stack([past[..., 0] * 2 - 1, 1 - past[..., 1] * 2], dim=-1).to(maps.dtype)
    return F.grid_sample(maps, grid, mode="bilinear", padding_mode="zeros", align_corners=False)


def cells_in_past(rows: int, columns: int, current_to_past: Tensor, roi: RegionOfInterest) -> tuple[Tensor, Tensor]:
    """Return where the cells of the current grid lie in past frames: x and y ``(B, H, W, D)``, normalised.

    Args:
        rows, columns: of the grid.
        current_to_past: ``(B, D, 2, 3)``, metres.
        roi: the region that the grid covers in all frames.
    """
    cells = cell_centres(rows, columns, current_to_past.device) - 0.5
    x, y = cells[0, :, 0, None] * roi.length, cells[:, 0, 1, None, None] * roi.width

    def moved(row: Tensor, size: float) -> Tensor:
        along_x, along_y, shift = (row / size)[:, None, None].unbind(-1)
        return (x * along_x + (shift + 0.5)) + y * along_y

    return moved(current_to_past[:, :, 0], roi.length), moved(current_to_past[:, :, 1], roi.width)


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
    """Turn rotations ``(..., 3, 3)`` into unit quaternions ``(..., 4)``: x, y, z, w, the largest one positive."""
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
