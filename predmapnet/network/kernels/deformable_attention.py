"""Deformable attention (Zhu et al. 2021): each head looks at a few positions around a reference, bilinearly."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import accumulate

import torch
from torch import Tensor, nn

from predmapnet.network.kernels.bilinear_sampling import bilinear_corners, weighted_rows
from predmapnet.network.kernels.matrix_product import Linear


class DeformableAttention(nn.Module):
    """Base of the deformable attentions: every head takes so many samples of the values around a reference.

    Queries are as wide as the values, or ``query_width``.
    """

    def __init__(self, width: int, heads: int, samples: int, dropout: float, query_width: int | None = None) -> None:
        super().__init__()
        self.heads = heads
        self.sampling_offsets = Linear(query_width or width, 2 * heads * samples)
        self.attention_weights = Linear(query_width or width, heads * samples)
        self.value = Linear(width, width)
        self.output = Linear(width, width)
        self.dropout = nn.Dropout(dropout)


def deformable_attention(
    values: Tensor,
    first_row: Tensor,
    x: Tensor,
    y: Tensor,
    weights: Tensor,
    level_sizes: Sequence[tuple[int, int]],
) -> Tensor:
    """Sum up weighted samples of feature maps: ``(R, heads * D)``.

    Args:
        values: ``(rows, heads, D)``: the pixels of all maps, level by level and row by row.
        first_row: ``(R) int32``, where in ``values`` the maps of each query begin.
        x, y: ``(R, heads, L, S)``, positions in pixels of the level; 0 is the centre of the first pixel.
        weights: likewise.
        level_sizes: rows and columns of each level.
    """
    queries, heads = x.shape[:2]
    corners = [
        bilinear_corners(x[:, :, level], y[:, :, level], columns, rows)
        for level, (rows, columns) in enumerate(level_sizes)
    ]
    starts = accumulate((rows * columns for rows, columns in level_sizes), initial=0)
    indices = torch.stack([index + start for (index, _), start in zip(corners, starts, strict=False)], dim=2)
    shares = torch.stack([share for _, share in corners], dim=2) * weights[..., None]
    head = torch.arange(heads, device=x.device, dtype=torch.int32)
    indices = (indices + first_row[:, None, None, None, None]) * heads + head[:, None, None, None]
    bags = queries * heads
    summed = weighted_rows(values.flatten(0, 1), indices.reshape(bags, -1), shares.reshape(bags, -1))
    return summed.view(queries, -1)
