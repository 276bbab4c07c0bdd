"""BEV encoder (BEVFormer, Li et al. 2022): learned queries of the ground cells look into the images.

Past BEV maps enter after every layer (MapTracker's BEV memory fusion).
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from predmapnet.config import BevFormerConfig, PredMapNetConfig
from predmapnet.network.calibration import Calibration
from predmapnet.network.kernels.deformable_attention import DeformableAttention, deformable_attention
from predmapnet.network.layers import ResidualPerceptron, flatten_cells
from predmapnet.network.maptracker.bev_memory import BevMemoryFusion, warp_past_maps
from predmapnet.network.maptracker.reference_points import (
    ReferencePoints,
    find_references,
    pillar_points,
    pixel_positions,
)
from predmapnet.network.state import FrameInputs, StreamState, ViewGeometry

IMAGE_LEVELS = 3
LEVEL_CODES = 4
"""One more than there are levels: released weights hold a fourth that is never used."""


class BevSelfAttention(DeformableAttention):
    """Deformable attention of the ground cells to each other.

    BEVFormer's temporal self-attention, of which MapTracker uses half: its queue of two maps holds the current map
    twice, so the two entries differ in where they look only.
    """

    QUEUE = 2
    POINTS = 4

    def __init__(self, config: BevFormerConfig, mirrored: bool) -> None:
        super().__init__(config.width, config.heads, self.QUEUE * self.POINTS, config.dropout, 2 * config.width)
        self.grid = (config.rows, config.columns)
        self.mirrored = mirrored

    def forward(self, cells: Tensor, code: Tensor) -> Tensor:
        """Attend among cells ``(B, H * W, C)`` with their position code ``(H * W, C)``; the input is included."""
        batch, count, _ = cells.shape
        both = torch.cat([cells, cells + code], dim=-1).flatten(0, 1)
        values = self.value(cells).view(batch * count, self.heads, -1)
        offsets = self.sampling_offsets(both).view(-1, self.heads, 1, self.QUEUE * self.POINTS, 2)
        weights = self.attention_weights(both).view(-1, self.heads, self.QUEUE, self.POINTS).softmax(dim=-1)
        weights = weights.view(-1, self.heads, 1, self.QUEUE * self.POINTS) / self.QUEUE
        row, column = self._references(cells.device)
        x = offsets[..., 0].unflatten(0, (batch, count)) + column[:, None, None, None]
        y = offsets[..., 1].unflatten(0, (batch, count)) + row[:, None, None, None]
        first_row = (torch.arange(batch, device=cells.device, dtype=torch.int32) * count).repeat_interleave(count)
        attended = deformable_attention(values, first_row, x.flatten(0, 1), y.flatten(0, 1), weights, [self.grid])
        return cells + self.dropout(self.output(attended.view(batch, count, -1)))

    def _references(self, device: torch.device) -> tuple[Tensor, Tensor]:
        """Return row and column ``(H * W)`` around which each cell looks."""
        rows, columns = self.grid
        row = torch.arange(rows, device=device)
        if self.mirrored:  # Released weights have learned to look at the far side of the car.
            row = row.flip(0)
        return row.repeat_interleave(columns), torch.arange(columns, device=device).repeat(rows)


class ImageCrossAttention(DeformableAttention):
    """Deformable attention of the ground cells to the images in which they are seen (spatial cross-attention)."""

    POINTS = 8
    """Samples of each head per camera and level; they take the heights of a pillar in turns."""

    def __init__(self, config: BevFormerConfig) -> None:
        super().__init__(config.width, config.heads, IMAGE_LEVELS * self.POINTS, config.dropout)

    def forward(self, cells: Tensor, tokens: Tensor, references: ReferencePoints, camera_valid: Tensor) -> Tensor:
        """Attend from cells ``(B, H * W, C)`` to tokens; the input is included.

        A cell takes the mean over the cameras that see it and are valid.

        Args:
            cells: of the ground.
            tokens: ``(B, N, pixels of all levels, C)``.
            references: of the calibration of these frames.
            camera_valid: ``(B, N) bool``.
        """
        valid = camera_valid.to(cells.dtype)
        cameras = (references.visible & camera_valid[:, :, None]).sum(dim=1).clamp(min=1)
        seen = self.look(cells, tokens, references) * valid.flatten()[references.camera, None]
        summed = torch.zeros_like(cells.flatten(0, 1)).index_add(0, references.cell, seen).view_as(cells)
        return cells + self.dropout(self.output(summed / cameras[..., None]))

    def look(self, cells: Tensor, tokens: Tensor, references: ReferencePoints) -> Tensor:
        """Return what each cell finds in each camera that sees it: ``(P, C)``."""
        values = self.value(tokens).view(-1, self.heads, cells.shape[-1] // self.heads)
        weights = self.attention_weights(cells).unflatten(-1, (self.heads, -1)).softmax(dim=-1)
        weights = weights.unflatten(-1, (IMAGE_LEVELS, self.POINTS)).flatten(0, 1)[references.cell]
        offsets = self.sampling_offsets(cells).unflatten(-1, (self.heads, IMAGE_LEVELS, self.POINTS, 2))
        offsets = offsets.flatten(0, 1)[references.cell]
        # Points take the heights of the pillar in turns: 0, 1, 2, 3, 0, 1, 2, 3.
        heights = references.positions.shape[1]
        pixels = pixel_positions(references.positions, references.level_sizes).transpose(1, 2)
        x, y = (offsets + pixels.repeat(1, 1, self.POINTS // heights, 1)[:, None]).unbind(-1)
        first_row = references.camera.int() * references.tokens
        return deformable_attention(values, first_row, x, y, weights, references.level_sizes)


class BevEncoderLayer(nn.Module):
    """Self-attention, image cross-attention, perceptron (each with a norm after the sum), and past maps."""

    def __init__(self, config: BevFormerConfig, past_maps: int, mirrored: bool) -> None:
        super().__init__()
        self.self_attention = BevSelfAttention(config, mirrored)
        self.image_attention = ImageCrossAttention(config)
        self.perceptron = ResidualPerceptron(config.width, config.hidden, config.dropout)
        self.norms = nn.ModuleList(nn.LayerNorm(config.width) for _ in range(3))
        self.fusion = BevMemoryFusion(config.width, past_maps)

    def forward(
        self,
        cells: Tensor,
        code: Tensor,
        tokens: Tensor,
        references: ReferencePoints,
        camera_valid: Tensor,
        history: Tensor,
    ) -> Tensor:
        """Map cells ``(B, H * W, C)`` to ``(B, H * W, C)``; ``history`` is ``(B, S, C, H, W)``."""
        cells = self.norms[0](self.self_attention(cells, code))
        cells = self.norms[1](self.image_attention(cells, tokens, references, camera_valid))
        cells = self.norms[2](self.perceptron(cells))
        bev = _as_map(cells, history.shape[-2:])
        return flatten_cells(bev + self.fusion(history, bev))


class BevFormer(nn.Module):
    """From image features to the BEV map."""

    def __init__(self, config: PredMapNetConfig) -> None:
        super().__init__()
        self.config = config
        bev = config.bev
        assert isinstance(bev, BevFormerConfig)
        width, self.grid = bev.width, (bev.rows, bev.columns)
        self.where_sum_is_positive = bev.quirks.propagate_where_sum_is_positive
        self.queries = nn.Parameter(torch.randn(bev.rows * bev.columns, width))
        self.row_code = nn.Parameter(torch.rand(bev.rows, width // 2))
        self.column_code = nn.Parameter(torch.rand(bev.columns, width // 2))
        self.level_code = nn.Parameter(torch.randn(LEVEL_CODES, width))
        self.camera_code = nn.Parameter(torch.randn(len(bev.cameras), width))
        past_maps, mirrored = len(bev.memory.distances), bev.quirks.mirrored_self_attention
        self.layers = nn.ModuleList(BevEncoderLayer(bev, past_maps, mirrored) for _ in range(bev.layers))
        self.register_buffer("pillars", pillar_points(bev, config.roi), persistent=False)
        self.pillars: Tensor

    def geometry(self, calibration: Calibration, size: tuple[int, int]) -> ReferencePoints:
        """Find where the cameras of some frames, whose input has ``size`` (rows, columns), see the BEV cells."""
        return find_references(calibration.ego_to_image, size, self.pillars)

    def forward(
        self, levels: Sequence[Tensor], inputs: FrameInputs, geometry: ViewGeometry, state: StreamState
    ) -> list[Tensor]:
        """Turn image features ``(B, N, C, h_i, w_i)``, fine to coarse, and the state's past maps into BEV features.

        Returns:
            A single level ``(B, C, H, W)``, channels-last in memory.
        """
        assert isinstance(geometry, ReferencePoints), "the geometry comes from this encoder"
        history = warp_past_maps(state, inputs.ego_to_global, self.config)
        cells = self.first_queries(history.maps, history.valid)
        code, tokens = self.position_code(), self.image_tokens(levels, inputs.calibration.camera_code)
        for layer in self.layers:
            cells = layer(cells, code, tokens, geometry, inputs.camera_valid, history.maps)
        return [_as_map(cells, self.grid)]

    def first_queries(self, history: Tensor, history_valid: Tensor) -> Tensor:
        """Return the queries ``(B, H * W, C)``: of the nearest past map where it reaches, learned ones elsewhere."""
        batch, slots = history_valid.shape
        if slots == 0:
            return self.queries.expand(batch, -1, -1)
        past = flatten_cells(history[:, -1])
        # Released weights take a cell for empty unless its channels add up to more than zero.
        reached = past.sum(dim=-1) > 0 if self.where_sum_is_positive else (past != 0).any(dim=-1)
        return torch.where((reached & history_valid[:, -1:])[..., None], past, self.queries)

    def position_code(self) -> Tensor:
        """Return the code ``(H * W, C)`` of the cells: of the column, then of the row."""
        rows, columns = self.grid
        column = self.column_code.expand(rows, -1, -1)
        row = self.row_code[:, None].expand(-1, columns, -1)
        return torch.cat([column, row], dim=-1).flatten(0, 1)

    def image_tokens(self, levels: Sequence[Tensor], cameras: Tensor) -> Tensor:
        """Return all pixels ``(B, N, pixels of all levels, C)`` with the codes of their camera ``(B, N)`` and level."""
        tokens = [
            features.permute(0, 1, 3, 4, 2).flatten(2, 3) + (self.camera_code[cameras][:, :, None] + code)
            for features, code in zip(levels, self.level_code[: len(levels)], strict=True)
        ]
        return torch.cat(tokens, dim=2)


def _as_map(cells: Tensor, grid: Sequence[int]) -> Tensor:
    """Turn ``(B, H * W, C)`` into ``(B, C, H, W)``, channels-last in memory."""
    return cells.unflatten(1, tuple(grid)).permute(0, 3, 1, 2)
