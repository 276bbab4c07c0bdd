"""Map decoder of the small network: queries look along their polylines in the BEV and move every point."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from mapfusion.elements import RegionOfInterest
from predmapnet.config import PointDecoderConfig, PredMapNetConfig
from predmapnet.network.kernels.bilinear_sampling import bilinear_corners, samples_by_rows, weighted_rows
from predmapnet.network.layers import (
    SINE_FREQUENCIES,
    Attention,
    FeedForward,
    Perceptron,
    Pointwise,
    sine_code,
    zero_init,
)
from predmapnet.network.map_decoder import DecoderInput, MapDecoder


class PointMixing(nn.Module):
    """Each point takes up what its two neighbours on the line know (a Linear over shifted copies)."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.perceptron = Perceptron(3 * width, width, width)
        self.norm = nn.LayerNorm(width)

    def forward(self, points: Tensor) -> Tensor:
        """Map ``(B, R, P, D)`` to ``(B, R, P, D)``; the ends see themselves as their missing neighbour."""
        before = torch.cat([points[:, :, :1], points[:, :, :-1]], dim=2)
        after = torch.cat([points[:, :, 1:], points[:, :, -1:]], dim=2)
        return self.norm(points + self.perceptron(torch.cat([before, points, after], dim=-1)))


class PointLayer(nn.Module):
    """One refinement of all queries and of all their points."""

    def __init__(self, config: PointDecoderConfig, roi: RegionOfInterest) -> None:
        super().__init__()
        width, point_width = config.width, config.point_width
        self.register_buffer("roi_size", torch.tensor([roi.length, roi.width]), persistent=False)
        self.roi_size: Tensor
        self.self_attention = Attention(width, config.heads)
        self.self_norm = nn.LayerNorm(width)
        self.place = nn.Linear(4 * SINE_FREQUENCIES + 4, point_width)
        self.index_code = nn.Parameter(torch.randn(config.points, point_width) * 0.1)
        self.from_query = nn.Linear(width, point_width)
        self.offsets = nn.Linear(point_width, 2 * config.sampling_offsets)
        self.from_samples = nn.Linear(config.sampling_offsets * point_width, point_width)
        self.point_norm = nn.LayerNorm(point_width)
        self.mixing = nn.Sequential(PointMixing(point_width), PointMixing(point_width))
        self.to_query = nn.Linear(2 * point_width, width)
        self.query_norm = nn.LayerNorm(width)
        self.feed_forward = FeedForward(width, 2 * width)
        self.move = nn.Linear(point_width, 2)
        self.classify = nn.Linear(width, config.classes)
        self._initialise()

    def _initialise(self) -> None:
        """Start with samples half a metre to both sides, points that stay, and few detections."""
        zero_init(self.offsets)
        zero_init(self.move)
        spread = torch.linspace(-0.5, 0.5, self.offsets.out_features // 2)
        with torch.no_grad():
            self.offsets.bias.copy_(spread[:, None].expand(-1, 2).flatten())
        nn.init.constant_(self.classify.bias, -3.0)

    def forward(
        self, queries: Tensor, hidden: Tensor | None, references: Tensor, bev: Tensor, allowed: Tensor
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Refine.

        Args:
            queries: ``(B, R, C)``.
            hidden: ``(B, R, P, D)`` from the layer before, or None.
            references: ``(B, R, P, 2)``, normalised, without gradient.
            bev: ``(B, D, H, W)``.
            allowed: ``(B, R, R) bool``, which rows each row may see.

        Returns:
            New queries, new hidden point features, logits ``(B, R, classes)``, and points ``(B, R, P, 2)``.
        """
        queries = self.self_norm(queries + self.self_attention(queries, queries, queries, allowed))
        points = self._describe(references) + self.index_code + self.from_query(queries)[:, :, None]
        if hidden is not None:
            points = points + hidden
        offsets = self.offsets(points).unflatten(-1, (-1, 2)) / self.roi_size
        samples = sample_bev(bev, references[..., None, :] + offsets)
        points = self.mixing(self.point_norm(points + self.from_samples(samples.flatten(-2))))
        summary = torch.cat([points.mean(dim=2), points.amax(dim=2)], dim=-1)
        queries = self.feed_forward(self.query_norm(queries + self.to_query(summary)))
        moved = references + self.move(points) / self.roi_size
        return queries, points, self.classify(queries), moved

    def _describe(self, references: Tensor) -> Tensor:
        """Encode where each point is and which way the line goes from it."""
        steps = torch.diff(references, dim=2) * self.roi_size / 10.0
        steps = torch.cat([F.pad(steps, (0, 0, 1, 0)), F.pad(steps, (0, 0, 0, 1))], dim=-1)
        return self.place(torch.cat([sine_code(references, SINE_FREQUENCIES), steps], dim=-1))


class PointDecoder(MapDecoder):
    """Layers of point refinement over the finest BEV level; references are detached before each layer."""

    learns_start = False

    def __init__(self, config: PredMapNetConfig) -> None:
        super().__init__()
        decoder = config.decoder
        assert isinstance(decoder, PointDecoderConfig)
        self.one_way = decoder.query_assignment == "one_way"
        self.input = Pointwise(config.bev.widths[0], decoder.point_width)
        self.layers = nn.ModuleList(PointLayer(decoder, config.roi) for _ in range(decoder.layers))

    def forward(self, start: DecoderInput, bev: Tensor) -> tuple[Tensor, list[tuple[Tensor, Tensor]]]:
        """Decode, as :class:`MapDecoder` says."""
        queries, references = start.queries, start.points
        detections = queries.shape[1] - start.track_valid.shape[1]
        allowed = visible_rows(start.track_valid, detections, self.one_way)
        values = self.input(bev)
        hidden = None
        predictions = []
        for layer in self.layers:
            queries, hidden, logits, points = layer(queries, hidden, references.detach(), values, allowed)
            predictions.append((logits, points))
            references = points
        return queries, predictions


def sample_bev(bev: Tensor, positions: Tensor) -> Tensor:
    """Interpolate the BEV ``(B, D, H, W)`` at normalised ``(B, R, P, K, 2)``, outside zeros: ``(B, R, P, K, D)``."""
    if samples_by_rows(bev):
        return _rows_of_bev(bev, positions)
    grid = torch.stack([positions[..., 0] * 2 - 1, 1 - positions[..., 1] * 2], dim=-1)
    sampled = F.grid_sample(bev, grid.flatten(1, 2), mode="bilinear", padding_mode="zeros", align_corners=False)
    return sampled.permute(0, 2, 3, 1).unflatten(1, positions.shape[1:3])


def _rows_of_bev(bev: Tensor, positions: Tensor) -> Tensor:
    """Return the same by :func:`weighted_rows`, on a CPU faster where channels are last in memory."""
    batch, width, rows, columns = bev.shape
    x, y = positions[..., 0] * columns - 0.5, (1.0 - positions[..., 1]) * rows - 0.5
    cells, shares = bilinear_corners(x, y, columns, rows)
    cells += torch.arange(batch, dtype=torch.int32)[:, None, None, None, None] * (rows * columns)
    table = bev.permute(0, 2, 3, 1).reshape(-1, width)
    return weighted_rows(table, cells.view(-1, 4), shares.view(-1, 4)).view(*positions.shape[:-1], width)


def visible_rows(track_valid: Tensor, queries: int, one_way: bool) -> Tensor:
    """Return which rows each row may attend to in the decoder: ``(B, T + Q, T + Q) bool``.

    Args:
        track_valid: ``(B, T) bool``; padded rows are seen by nobody.
        queries: number of detection queries, which follow the tracks.
        one_way: detections never see tracks, tracks see everything.
    """
    batch, tracks = track_valid.shape
    rows = tracks + queries
    seen = torch.cat([track_valid, track_valid.new_ones(batch, queries)], dim=1)
    allowed = seen[:, None, :].expand(batch, rows, rows)
    if one_way and tracks:
        is_detection = torch.arange(rows, device=track_valid.device) >= tracks
        allowed = allowed & (~is_detection[:, None] | is_detection[None, :])
    return allowed
