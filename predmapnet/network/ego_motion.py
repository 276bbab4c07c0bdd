"""The motion of the car between two instants: of points, of polylines and of BEV maps."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor

from mapfusion.elements import RegionOfInterest
from predmapnet.network.layers import cell_centres


def relative_motion(a_to_global: Tensor, b_to_global: Tensor) -> Tensor:
    """Motion of the ground plane from ego frame a to ego frame b.

    Args:
        a_to_global: ``(..., 4, 4) float64``.
        b_to_global: ``(..., 4, 4) float64``.

    Returns:
        ``(..., 2, 3) float32``: rotation and translation (metres) that map x, y of frame a to frame b. Computed in
        double precision, since global coordinates are large.
    """
    rotation = b_to_global[..., :3, :3].transpose(-1, -2)
    position = a_to_global[..., :3, 3:] - b_to_global[..., :3, 3:]
    a_to_b = torch.cat([rotation @ a_to_global[..., :3, :3], rotation @ position], dim=-1)
    return a_to_b[..., :2, [0, 1, 3]].float()


def move_points(points: Tensor, a_to_b: Tensor, roi: RegionOfInterest) -> Tensor:
    """Move normalised points to another ego frame.

    Args:
        points: ``(B, ..., 2)`` in frame a, normalised.
        a_to_b: ``(B, 2, 3)``, metres.
        roi: the region of both frames.

    Returns:
        ``(B, ..., 2)`` in frame b, normalised; points may lie outside [0, 1].
    """
    size = points.new_tensor([roi.length, roi.width])
    metres = ((points - 0.5) * size).flatten(1, -2)
    moved = metres @ a_to_b[:, :, :2].transpose(1, 2) + a_to_b[:, None, :, 2]
    return (moved / size + 0.5).view_as(points)


def warp_bev(maps: Tensor, current_to_past: Tensor, roi: RegionOfInterest) -> Tensor:
    """Show past BEV maps in the current ego frame, zeros where they do not reach.

    Args:
        maps: ``(M, C, H, W)``, in the past frame.
        current_to_past: ``(M, 2, 3)``, metres.
        roi: the region that the grid covers in both frames.

    Returns:
        ``(M, C, H, W)``, bilinearly interpolated at the cell centres of the current frame.
    """
    rows, columns = maps.shape[-2:]
    cells = cell_centres(rows, columns, maps.device).expand(len(maps), rows, columns, 2)
    past = move_points(cells, current_to_past, roi)
    grid = torch.stack([past[..., 0] * 2 - 1, 1 - past[..., 1] * 2], dim=-1).to(maps.dtype)
    return F.grid_sample(maps, grid, mode="bilinear", padding_mode="zeros", align_corners=False)
