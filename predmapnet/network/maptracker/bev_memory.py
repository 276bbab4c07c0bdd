"""BEV memory of the MapTracker encoder: past maps are kept, chosen by distance, warped to the present, and fused."""

from __future__ import annotations

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from predmapnet.config import BevFormerConfig, EncoderBevMemoryConfig, PredMapNetConfig
from predmapnet.network.ego_motion import relative_pose
from predmapnet.network.kernels.normalised_convolution import NormalisedConvolution
from predmapnet.network.layers import cell_centres
from predmapnet.network.maptracker.strided_selection import select_strided
from predmapnet.network.state import StreamState


@dataclass
class PastBevMaps:
    """Chosen past maps, from far to near: ``(B, S, C, H, W)``, and which ``slots`` of the memory they are.

    They are in the current ego frame, zeros where they do not reach and in slots without a (valid) map.
    """

    maps: Tensor
    slots: Tensor
    valid: Tensor


class BevMemoryFusion(nn.Module):
    """A convolution over the past maps and the current one, and a residual block; its output is a residual, >= 0."""

    def __init__(self, width: int, slots: int) -> None:
        super().__init__()
        self.slots = slots
        self.mix = NormalisedConvolution((slots + 1) * width, width, 3)
        self.first = NormalisedConvolution(width, width, 3)
        self.second = NormalisedConvolution(width, width, 3)

    def forward(self, history: Tensor, current: Tensor) -> Tensor:
        """Return what past maps ``(B, S, C, H, W)``, far to near, add to the current one ``(B, C, H, W)``.

        Fewer maps than slots count as zero maps in front.
        """
        batch, maps, width = history.shape[:3]
        missing = current.new_zeros(batch, self.slots - maps, width, *current.shape[2:])
        together = torch.cat([missing, history, current[:, None]], dim=1).flatten(1, 2)
        hidden = F.relu(self.mix(together.contiguous(memory_format=torch.channels_last)))
        return F.relu(self.second(F.relu(self.first(hidden))) + hidden)


def warp_past_maps(state: StreamState, ego_to_global: Tensor, config: PredMapNetConfig) -> PastBevMaps:
    """Choose past maps of a state and warp them to the current pose ``(B, 4, 4) float64``."""
    slots, chosen = choose_maps(state, ego_to_global, config)
    stream = torch.arange(len(slots), device=slots.device)[:, None]
    current_to_past = relative_pose(ego_to_global[:, None], state.bev_memory_pose[stream, slots])
    maps = state.bev_memory[stream, slots]
    grid = warp_grid(current_to_past, config).flatten(0, 1).to(maps.dtype)
    warped = F.grid_sample(maps.flatten(0, 1), grid, mode="bilinear", padding_mode="zeros", align_corners=False)
    warped = warped.unflatten(0, slots.shape).masked_fill(~chosen[:, :, None, None, None], 0.0)
    return PastBevMaps(warped, slots, chosen)


def choose_maps(state: StreamState, ego_to_global: Tensor, config: PredMapNetConfig) -> tuple[Tensor, Tensor]:
    """Return which maps of the memory are looked at ``(B, S) int64``, from far to near, and which of them are there."""
    travelled = (state.bev_memory_pose[..., :2, 3] - ego_to_global[:, None, :2, 3]).norm(dim=-1)
    return select_strided(travelled, state.bev_memory_valid, config.bev.memory.distances, fallback="latest")


def nearest_pose(state: StreamState, ego_to_global: Tensor, config: PredMapNetConfig) -> Tensor:
    """Return the pose ``(B, 4, 4) float64`` of the nearest map that is looked at; without one, of the last frame."""
    if state.bev_memory.shape[1] == 0:
        return state.ego_to_global
    slots, _ = choose_maps(state, ego_to_global, config)
    stream = torch.arange(len(slots), device=slots.device)
    return state.bev_memory_pose[stream, slots[:, -1]]


def store_bev_map(
    state: StreamState, bev: Tensor, ego_to_global: Tensor, config: EncoderBevMemoryConfig
) -> tuple[Tensor, Tensor, Tensor]:
    """Return the BEV memory (maps, poses, validity) with the map ``(B, C, H, W)`` of this frame; the oldest may go."""
    known = state.bev_memory_valid.new_ones(len(bev), 1)
    kept = slice(-config.capacity, None)
    return (
        torch.cat([state.bev_memory, bev[:, None]], dim=1)[:, kept],
        torch.cat([state.bev_memory_pose, ego_to_global[:, None]], dim=1)[:, kept],
        torch.cat([state.bev_memory_valid, known], dim=1)[:, kept],
    )


def warp_grid(current_to_past: Tensor, config: PredMapNetConfig) -> Tensor:
    """Find the cells of the current BEV grid in past maps, whose motion is ``(..., 4, 4) float64``.

    Rounded where the official code rounds: after :func:`predmapnet.network.ego_motion.warp_bev`, which does the same,
    the BEV features would differ by more than 2e-5 from the official ones.

    Returns:
        ``(..., H, W, 2) float32``, as ``grid_sample`` wants it: -1 and 1 are the borders of the map, y downwards.
    """
    cells = _cells(config, current_to_past.device)
    rotation, translation = current_to_past[..., :2, :2], current_to_past[..., :2, 3]
    past = cells.flatten(0, 1) @ rotation.transpose(-1, -2) + translation[..., None, :]
    x, y = past.float().unbind(-1)
    grid = torch.stack([x / (config.roi_length / 2), -y / (config.roi_width / 2)], dim=-1)
    return grid.unflatten(-2, cells.shape[:2])


def _cells(config: PredMapNetConfig, device: torch.device) -> Tensor:
    """Return the positions ``(H, W, 2) float64`` that are looked up, metres in the current ego frame."""
    length, width = config.roi_length, config.roi_width
    bev = config.bev
    if (
        isinstance(bev, BevFormerConfig) and bev.quirks.endpoint_warp_grid
    ):  # Released weights saw every past map zoomed by this, rounded to 32 bits.
        x = torch.linspace(-length / 2, length / 2, bev.columns, dtype=torch.float32, device=device)
        y = torch.linspace(width / 2, -width / 2, bev.rows, dtype=torch.float32, device=device)
        return torch.stack(torch.broadcast_tensors(x[None, :], y[:, None]), dim=-1).double()
    x, y = (cell_centres(bev.rows, bev.columns, device).double() - 0.5).unbind(-1)
    return torch.stack([x * length, y * width], dim=-1)
