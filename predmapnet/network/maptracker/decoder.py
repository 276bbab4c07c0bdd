"""MapTracker's decoder: queries of tracks and detections become polylines over six layers."""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn

from predmapnet.config import MapTrackerDecoderConfig, PredMapNetConfig
from predmapnet.network.kernels.deformable_attention import DeformableAttention, deformable_attention
from predmapnet.network.layers import ResidualPerceptron, flatten_cells, interleaved_sines
from predmapnet.network.map_decoder import DecoderInput, MapDecoder
from predmapnet.network.maptracker.vector_memory import RecalledQueries


class LineCrossAttention(DeformableAttention):
    """Deformable attention of rows to the BEV map: every head looks around each point of the row's line once."""

    def __init__(self, config: MapTrackerDecoderConfig, grid: tuple[int, int]) -> None:
        super().__init__(config.width, config.heads, config.points, config.dropout)
        self.grid = grid

    def forward(self, rows: Tensor, points: Tensor, cells: Tensor) -> Tensor:
        """Attend from rows ``(B, R, C)`` around their points ``(B, R, P, 2)``, normalised, to cells ``(B, H * W, C)``.

        The input is included.
        """
        batch, count, width = rows.shape
        height, length = self.grid
        values = self.value(cells).view(-1, self.heads, width // self.heads)
        offsets = self.sampling_offsets(rows).view(batch * count, self.heads, 1, -1, 2)
        weights = self.attention_weights(rows).view(batch * count, self.heads, -1).softmax(dim=-1)
        x = points[..., 0] * length - 0.5
        y = (1 - points[..., 1]) * height - 0.5
        stream = torch.arange(batch, device=rows.device, dtype=torch.int32) * (height * length)
        attended = deformable_attention(
            values,
            stream.repeat_interleave(count),
            offsets[..., 0] + x.view(batch * count, 1, 1, -1),
            offsets[..., 1] + y.view(batch * count, 1, 1, -1),
            weights[:, :, None],
            [self.grid],
        )
        return rows + self.dropout(self.output(attended.view(batch, count, width)))


class _RowAttention(nn.Module):
    """Base of the attentions whose queries are rows."""

    def __init__(self, config: MapTrackerDecoderConfig) -> None:
        super().__init__()
        self.attention = nn.MultiheadAttention(config.width, config.heads, dropout=config.dropout, batch_first=True)
        self.dropout = nn.Dropout(config.dropout)


class MemoryAttention(_RowAttention):
    """Attention of each track to its own recalled queries."""

    def forward(self, tracks: Tensor, memory: RecalledQueries) -> Tensor:
        """Map tracks ``(B, T, C)`` to ``(B, T, C)``, the input included."""
        # A padded row has no entries; it attends to zeros instead of to nothing.
        blocked = ~memory.valid & memory.valid.any(dim=-1, keepdim=True)
        keys = (memory.queries + memory.code).flatten(0, 1)
        query, values = tracks.flatten(0, 1)[:, None], memory.queries.flatten(0, 1)
        attended, _ = self.attention(query, keys, values, key_padding_mask=blocked.flatten(0, 1), need_weights=False)
        return tracks + self.dropout(attended.view_as(tracks))


class RowSelfAttention(_RowAttention):
    """Attention of all rows to each other."""

    def forward(self, rows: Tensor, valid: Tensor) -> Tensor:
        """Map rows ``(B, R, C)`` to ``(B, R, C)``, the input included; rows that are not valid are not looked at."""
        attended, _ = self.attention(rows, rows, rows, key_padding_mask=~valid, need_weights=False)
        return rows + self.dropout(attended)


class MapTrackerDecoderLayer(nn.Module):
    """Self-attention, BEV attention, memory attention and a perceptron."""

    def __init__(self, config: MapTrackerDecoderConfig, grid: tuple[int, int], norm_before: bool) -> None:
        super().__init__()
        self.norm_before = norm_before
        self.self_attention = RowSelfAttention(config)
        self.bev_attention = LineCrossAttention(config, grid)
        self.memory_attention = MemoryAttention(config)
        self.perceptron = ResidualPerceptron(config.width, config.hidden, config.dropout)
        self.norms = nn.ModuleList(nn.LayerNorm(config.width) for _ in range(4))

    def forward(self, rows: Tensor, points: Tensor, start: DecoderInput, cells: Tensor) -> Tensor:
        """Refine rows ``(B, T + Q, C)``.

        Args:
            rows: tracks, then detections.
            points: ``(B, T + Q, P, 2)``, where they are thought to be, normalised.
            start: validity, memory and age of the streams.
            cells: ``(B, H * W, C)`` of the BEV map.
        """
        rows = self.norms[0](self.self_attention(rows, start.valid))
        seen = self.bev_attention(rows, points, cells)
        if self.norm_before:  # Released weights add the norm of the BEV attention's input to its output.
            recalled = self._with_memory(self.norms[1](rows), start.memory)
            rows = torch.where(start.first_frame[:, None, None], seen, recalled + seen)
        else:
            rows = self._with_memory(self.norms[1](seen), start.memory)
        return self.norms[3](self.perceptron(self.norms[2](rows)))

    def _with_memory(self, rows: Tensor, memory: RecalledQueries | None) -> Tensor:
        """Replace the track rows, the first ones, by what their memory makes of them."""
        assert memory is not None
        tracks = memory.queries.shape[1]
        if tracks == 0:
            return rows
        return torch.cat([self.memory_attention(rows[:, :tracks], memory), rows[:, tracks:]], dim=1)


class MapTrackerDecoder(MapDecoder):
    """All layers, with one classifier and one polyline branch for all of them."""

    learns_start = True

    def __init__(self, config: PredMapNetConfig) -> None:
        super().__init__()
        decoder, self.grid = config.decoder, (config.bev.rows, config.bev.columns)
        assert isinstance(decoder, MapTrackerDecoderConfig)
        width, norm_before = decoder.width, decoder.quirks.norm_before_cross_attention
        self.input = nn.Conv2d(config.bev.widths[0], width, 1)
        self.layers = nn.ModuleList(
            MapTrackerDecoderLayer(decoder, self.grid, norm_before) for _ in range(decoder.layers)
        )
        self.classify = nn.Linear(width, decoder.classes)
        self.line = nn.Sequential(
            nn.Linear(width, 2 * width),
            nn.LayerNorm(2 * width),
            nn.ReLU(),
            nn.Linear(2 * width, 2 * width),
            nn.LayerNorm(2 * width),
            nn.ReLU(),
            nn.Linear(2 * width, 2 * decoder.points),
        )

    def forward(self, start: DecoderInput, bev: Tensor) -> tuple[Tensor, list[tuple[Tensor, Tensor]]]:
        """Decode, as :class:`MapDecoder` says."""
        cells = self.bev_cells(bev)
        rows, points, predictions = start.queries, start.points, []
        for layer in self.layers:
            rows = layer(rows, points, start, cells)
            logits, lines = self.read_out(rows)
            predictions.append((logits, lines))
            points = lines.detach()
        return rows, predictions

    def read_out(self, rows: Tensor) -> tuple[Tensor, Tensor]:
        """Turn embeddings ``(..., C)`` into logits ``(..., classes)`` and normalised polylines ``(..., P, 2)``."""
        return self.classify(rows), self.line(rows).sigmoid().unflatten(-1, (-1, 2))

    def bev_cells(self, bev: Tensor) -> Tensor:
        """Project the map and add a sine code of the position: ``(B, H * W, C)``."""
        projected = self.input(bev)
        return flatten_cells(projected + position_code(projected.shape[1], self.grid, projected.device))


def position_code(channels: int, grid: tuple[int, int], device: torch.device) -> Tensor:
    """Return DETR's sine code ``(C, H, W)`` of the cells: the first half tells the row, the second the column."""
    (rows, columns), half = grid, channels // 2

    def along(count: int) -> Tensor:
        place = torch.arange(1, count + 1, device=device, dtype=torch.float32) / (count + 1e-6) * (2 * math.pi)
        return interleaved_sines(place, half).T

    row = along(rows)[:, :, None].expand(-1, -1, columns)
    column = along(columns)[:, None].expand(-1, rows, -1)
    return torch.cat([row, column])
