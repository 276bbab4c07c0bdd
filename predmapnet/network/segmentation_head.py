"""Semantic segmentation of the ground at twice the resolution of the BEV grid."""

from __future__ import annotations

import torch.nn.functional as F
from torch import Tensor, nn

from predmapnet.network.layers import ConvNorm


class SegmentationHead(nn.Module):
    """A 3x3 convolution and four sub-cells per cell (pixel shuffle)."""

    def __init__(self, channels: int, classes: int) -> None:
        super().__init__()
        self.hidden = ConvNorm(channels, 32, 3)
        self.output = nn.Conv2d(32, 4 * classes, 1)
        nn.init.constant_(self.output.bias, -2.0)  # type: ignore[arg-type]

    def forward(self, features: Tensor) -> Tensor:
        """Map ``(B, C, H, W)`` to logits ``(B, classes, 2 H, 2 W)``."""
        return F.pixel_shuffle(self.output(self.hidden(features)), 2)
