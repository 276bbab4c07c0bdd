"""Past BEV maps: chosen by distance, and warped into the current ego frame."""

from __future__ import annotations

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor

from predmapnet.network.history_choice import choose_history
from predmapnet.network.layers import cell_centres
from predmapnet.network.maptracker_config import MapTrackerConfig
from predmapnet.network.rigid_motion import relative_pose


@dataclass
class BevHistory:
    """Chosen past maps, from far to near.

    Attributes:
        maps: ``(B, S, C, H, W)`` in the current ego frame, zeros where they do not reach and in slots without a map.
        slots: ``(B, S) int64``, which maps of the memory these are.
        valid: ``(B, S) bool``.
        nearest_pose: ``(B, 4, 4) float64``, of the last of them; None without any slot.
    """

    maps: Tensor
    slots: Tensor
    valid: Tensor
    nearest_pose: Tensor | None


def look_back(
    memory: Tensor, poses: Tensor, valid: Tensor, ego_to_global: Tensor, config: MapTrackerConfig
) -> BevHistory:
    """Choose past maps and warp them.

    Args:
        memory: ``(B, K, C, H, W)``, in time order.
        poses: ``(B, K, 4, 4) float64``.
        valid: ``(B, K) bool``; the valid ones are the last ones.
        ego_to_global: ``(B, 4, 4) float64``, current.
        config: distances and the region.
    """
    travelled = (poses[..., :2, 3] - ego_to_global[:, None, :2, 3]).norm(dim=-1)
    slots, chosen = choose_history(travelled, valid, config.history_distances, fallback="latest")
    stream = torch.arange(len(slots), device=slots.device)[:, None]
    current_to_past = relative_pose(ego_to_global[:, None], poses[stream, slots])
    maps = memory[stream, slots]
    grid = warp_grid(current_to_past, config).flatten(0, 1).to(maps.dtype)
    warped = F.grid_sample(maps.flatten(0, 1), grid, mode="bilinear", padding_mode="zeros", align_corners=False)
    warped = warped.unflatten(0, slots.shape).masked_fill(~chosen[:, :, None, None, None], 0.0)
    return BevHistory(warped, slots, chosen, poses[stream[:, 0], slots[:, -1]] if slots.shape[1] else None)


def warp_grid(current_to_past: Tensor, config: MapTrackerConfig) -> Tensor:
    """Find the cells of the current BEV grid in past maps.

    Args:
        current_to_past: ``(..., 4, 4) float64``.
        config: size of the grid and the quirk.

    Returns:
        ``(..., H, W, 2) float32``, as ``grid_sample`` wants it: -1 and 1 are the borders of the map, y downwards.
    """
    cells = _cells(config, current_to_past.device)
    rotation, translation = current_to_past[..., :2, :2], current_to_past[..., :2, 3]
    past = cells.flatten(0, 1) @ rotation.transpose(-1, -2) + translation[..., None, :]
    x, y = past.float().unbind(-1)
    grid = torch.stack([x / (config.roi_length / 2), -y / (config.roi_width / 2)], dim=-1)
    return grid.unflatten(-2, cells.shape[:2])


def _cells(config: MapTrackerConfig, device: torch.device) -> Tensor:
    """Return the positions ``(H, W, 2) float64`` that are looked up, metres in the current ego frame."""
    length, width = config.roi_length, config.roi_width
    if config.quirks.endpoint_warp_grid:  # Released weights saw every past map zoomed by this, rounded to 32 bits.
        x = torch.linspace(-length / 2, length / 2, config.columns, dtype=torch.float32, device=device)
        y = torch.linspace(width / 2, -width / 2, config.rows, dtype=torch.float32, device=device)
        return torch.stack(torch.broadcast_tensors(x[None, :], y[:, None]), dim=-1).double()
    x, y = (cell_centres(config.rows, config.columns, device).double() - 0.5).unbind(-1)
    return torch.stack([x * length, y * width], dim=-1)
