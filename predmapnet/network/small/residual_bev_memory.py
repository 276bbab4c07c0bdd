"""BEV memory of the small network: past maps enter finished BEV features as a residual (lighter than MapTracker's)."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from predmapnet.config import LookupBevConfig, PredMapNetConfig
from predmapnet.network.ego_motion import cells_in_past, relative_motion, warp_bev
from predmapnet.network.kernels.bilinear_sampling import bilinear_corners, samples_by_rows, weighted_rows
from predmapnet.network.layers import Pointwise, zero_init
from predmapnet.network.state import StreamState


class ResidualBevMemory(nn.Module):
    """Past raw maps, chosen by distance and warped, enter the BEV features as residuals that start as zero.

    Raw (unfused) maps are stored, so that nothing is fed back and errors do not accumulate.
    """

    def __init__(self, config: PredMapNetConfig) -> None:
        super().__init__()
        assert isinstance(config.bev, LookupBevConfig)
        self.config = config.bev.memory
        self.roi = config.roi
        fine, middle, _ = config.bev.widths
        self.compress = Pointwise(fine, self.config.channels)
        inputs = len(self.config.distances) * (self.config.channels + 1) + self.config.channels
        self.mix = Pointwise(inputs, fine)
        self.fine_residual = nn.Conv2d(fine, fine, 3, padding=1)
        self.middle_residual = nn.Conv2d(fine, middle, 3, stride=2, padding=1)
        zero_init(self.fine_residual)
        zero_init(self.middle_residual)

    def forward(
        self, fine: Tensor, middle: Tensor, raw: Tensor, ego_to_global: Tensor, state: StreamState
    ) -> tuple[Tensor, Tensor]:
        """Fuse the memory of ``state`` into the current features; streams without memory are left as they are.

        Args:
            fine: ``(B, C_0, H, W)``.
            middle: ``(B, C_1, H / 2, W / 2)``.
            raw: ``(B, C_bev, H, W)``, the current map as :attr:`compress` makes it.
            ego_to_global: ``(B, 4, 4) float64``, current.
            state: of the last frame.
        """
        past, reached = self._look_back(ego_to_global, state)
        hidden = torch.relu(self.mix(torch.cat([past, reached, raw], dim=1)))
        known = state.bev_memory_valid.any(dim=1)[:, None, None, None].to(fine.dtype)
        return (
            torch.addcmul(fine, self.fine_residual(hidden), known),
            torch.addcmul(middle, self.middle_residual(hidden), known),
        )

    def _look_back(self, ego_to_global: Tensor, state: StreamState) -> tuple[Tensor, Tensor]:
        """Return the warped maps ``(B, D * C_bev, H, W)`` and where they reach ``(B, D, H, W)``."""
        chosen, valid = self._choose(ego_to_global, state)
        stream = torch.arange(len(chosen), device=chosen.device)[:, None]
        motion = relative_motion(ego_to_global[:, None], state.bev_memory_pose[stream, chosen])
        if samples_by_rows(state.bev_memory):
            return self._rows_of_maps(state.bev_memory, chosen, valid, motion)
        maps = state.bev_memory[stream, chosen].flatten(0, 1)
        warped = warp_bev(torch.cat([maps, torch.ones_like(maps[:, :1])], dim=1), motion.flatten(0, 1), self.roi)
        warped = (warped * valid.flatten()[:, None, None, None]).unflatten(0, chosen.shape)
        return warped[:, :, :-1].flatten(1, 2), warped[:, :, -1]

    def _rows_of_maps(self, maps: Tensor, chosen: Tensor, valid: Tensor, motion: Tensor) -> tuple[Tensor, Tensor]:
        """Return the same by :func:`weighted_rows`: a cell's samples of all maps lie side by side in memory.

        Args:
            maps: ``(B, K, C_bev, H, W)``.
            chosen: ``(B, D) int64``, which of them are warped.
            valid: ``(B, D) bool``.
            motion: ``(B, D, 2, 3)``, metres, from the current frame to theirs.
        """
        batch, kept, channels, rows, columns = maps.shape
        x, y = cells_in_past(rows, columns, motion, self.roi)
        cells, shares = bilinear_corners(x * columns - 0.5, (1.0 - y) * rows - 0.5, columns, rows)
        first = chosen.int() + torch.arange(batch, dtype=torch.int32)[:, None] * kept
        cells += (first * (rows * columns))[:, None, None, :, None]
        shares *= valid[:, None, None, :, None]
        table = maps.movedim(2, -1).reshape(-1, channels)
        warped = weighted_rows(table, cells.view(-1, 4), shares.view(-1, 4)).view(batch, rows, columns, -1)
        return warped.movedim(-1, 1), shares.sum(dim=-1).movedim(-1, 1)

    def _choose(self, ego_to_global: Tensor, state: StreamState) -> tuple[Tensor, Tensor]:
        """Find the nearest stored map for each distance ``(B, D)``; validity, as a map serves only one of them."""
        travelled = (state.bev_memory_pose[..., :2, 3] - ego_to_global[:, None, :2, 3]).norm(dim=-1).float()
        wanted = travelled.new_tensor(self.config.distances)
        error = (travelled[:, None] - wanted[:, None]).abs().masked_fill(~state.bev_memory_valid[:, None], torch.inf)
        chosen = error.argmin(dim=-1)
        repeated = (chosen[:, :, None] == chosen[:, None, :]).tril(diagonal=-1).any(dim=-1)
        return chosen, ~repeated & state.bev_memory_valid.any(dim=1, keepdim=True)


def store_raw_map(
    state: StreamState, raw: Tensor, ego_to_global: Tensor, spacing: float
) -> tuple[Tensor, Tensor, Tensor]:
    """Return the BEV memory (maps, poses, validity) with the raw map ``(B, C_bev, H, W)`` of this frame, newest last.

    The newest one is replaced until the car has moved ``spacing`` metres past the one before. Maps are channels-last in
    memory, as they are made and looked up.
    """
    pose, valid, maps = state.bev_memory_pose, state.bev_memory_valid, state.bev_memory
    if valid.shape[1] == 0:
        return maps, pose, valid
    keep_newest = valid[:, -1]
    if valid.shape[1] > 1:
        moved = (pose[:, -1, :2, 3] - pose[:, -2, :2, 3]).norm(dim=-1)
        keep_newest = keep_newest & (~valid[:, -2] | (moved >= spacing))
    step = keep_newest.long()[:, None]
    slots = torch.arange(valid.shape[1] - 1, device=valid.device)[None] + step
    stream = torch.arange(len(valid), device=valid.device)[:, None]
    return (
        torch.cat([maps.movedim(2, -1)[stream, slots], raw.movedim(1, -1)[:, None]], dim=1).movedim(-1, 2),
        torch.cat([pose[stream, slots], ego_to_global[:, None]], dim=1),
        torch.cat([valid[stream, slots], valid.new_ones(len(valid), 1)], dim=1),
    )


def empty_bev_memory(batch: int, config: PredMapNetConfig, device: torch.device) -> tuple[Tensor, Tensor, Tensor]:
    """Return an empty BEV memory: maps, poses and validity.

    The residual fusion has a fixed number of slots, none if it is switched off; the encoder's memory grows.
    """
    slots, channels = 0, config.bev.widths[0]
    if isinstance(config.bev, LookupBevConfig):
        memory = config.bev.memory
        slots, channels = memory.capacity if memory.enabled else 0, memory.channels
    maps = torch.zeros(batch, slots, channels, config.bev.rows, config.bev.columns, device=device)
    pose = torch.eye(4, dtype=torch.float64, device=device).expand(batch, slots, 4, 4).clone()
    return maps, pose, torch.zeros(batch, slots, dtype=torch.bool, device=device)
