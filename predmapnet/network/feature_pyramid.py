"""Feature pyramid over the image levels (Lin et al. 2017), with batch norm after every convolution."""

from __future__ import annotations

from collections.abc import Sequence

import torch.nn.functional as F
from torch import Tensor, nn

from predmapnet.network.kernels.normalised_convolution import NormalisedConvolution


class FeaturePyramid(nn.Module):
    """Coarse levels inform fine ones; all levels get the same width."""

    def __init__(self, widths: Sequence[int], width: int) -> None:
        super().__init__()
        self.lateral = nn.ModuleList(NormalisedConvolution(channels, width, 1) for channels in widths)
        self.smooth = nn.ModuleList(NormalisedConvolution(width, width, 3) for _ in widths)

    def forward(self, levels: Sequence[Tensor]) -> list[Tensor]:
        """Map levels ``(N, C_i, h_i, w_i)``, fine to coarse, to ``(N, C, h_i, w_i)``."""
        merged = [lateral(level) for lateral, level in zip(self.lateral, levels, strict=True)]
        for level in reversed(range(len(merged) - 1)):
            size = merged[level].shape[-2:]
            merged[level] = merged[level] + F.interpolate(merged[level + 1], size, mode="nearest")
        return [smooth(level) for smooth, level in zip(self.smooth, merged, strict=True)]
