"""Instance masks: the dot product of a query's mask embedding with the BEV features (end of Sec. 3.2)."""

from __future__ import annotations

from collections.abc import Sequence

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from predmapnet.config import PredMapNetConfig
from predmapnet.network.kernels.tracing import is_traced
from predmapnet.network.layers import Perceptron, Pointwise


class MaskHead(nn.Module):
    """One head for detections and tracks, at every layer that predicts masks."""

    def __init__(self, config: PredMapNetConfig) -> None:
        super().__init__()
        width, self.level = config.decoder.width, config.mask_level
        self.features = Pointwise(config.bev.widths[self.level], config.masks.channels)
        self.norm = nn.LayerNorm(width)
        self.embedding = Perceptron(width, width, config.masks.channels)
        self.bias = nn.Parameter(torch.tensor(-1.0))

    def mask_features(self, levels: Sequence[Tensor]) -> Tensor:
        """Return the features ``(B, C_m, H_m, W_m)`` that all queries are multiplied with, of levels fine to coarse."""
        return self.features(levels[self.level])

    def forward(self, queries: Tensor, mask_features: Tensor) -> Tensor:
        """Return mask logits ``(B, R, H_m, W_m)`` of queries ``(B, R, C)``."""
        embedding = self.embedding(self.norm(queries))
        return (embedding @ mask_features.flatten(2)).unflatten(-1, mask_features.shape[-2:]) + self.bias


def attention_cells(mask_logits: Tensor, size: tuple[int, int], threshold: float) -> Tensor:
    """Turn masks into the cells ``(B, R, rows * columns) bool`` that each query may attend to (eq. 1).

    A coarse cell is in the mask if any of the cells below it is, since map lines are one cell wide. A query whose mask
    is empty attends everywhere, as in Mask2Former.

    Args:
        mask_logits: ``(B, R, H_m, W_m)``.
        size: rows and columns of the level that is attended to.
        threshold: tau_L, a probability.
    """
    if mask_logits.shape[-2:] != size:
        mask_logits = largest_in_cells(mask_logits, size)
    inside = mask_logits.flatten(2).sigmoid() > threshold
    return inside | ~inside.any(dim=-1, keepdim=True)


def largest_in_cells(maps: Tensor, size: tuple[int, int]) -> Tensor:
    """Return the largest value ``(B, R, rows, columns)`` of maps ``(B, R, h, w)`` in each cell of a coarser grid."""
    if not is_traced():
        return F.adaptive_max_pool2d(maps, size)
    for axis, cells in zip((-2, -1), size, strict=True):  # ONNX pools evenly divided maps only.
        length = maps.shape[axis]
        cell = torch.arange(cells)
        first, last = cell * length // cells, -(-(cell + 1) * length // cells) - 1
        pooled = maps.index_select(axis, first)
        for step in range(1, -(-length // cells) + 1):
            pooled = torch.maximum(pooled, maps.index_select(axis, (first + step).minimum(last)))
        maps = pooled
    return maps
