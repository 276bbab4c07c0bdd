"""Semantic segmentation of the ground at twice the resolution of the BEV grid; the tracks do not read it."""

from __future__ import annotations

import torch.nn.functional as F
from torch import Tensor, nn

from predmapnet.network.layers import ConvNorm, Pointwise


class SegmentationHead(nn.Module):
    """A 3x3 convolution and four sub-cells per cell (pixel shuffle)."""

    def __init__(self, channels: int, classes: int) -> None:
        super().__init__()
        self.hidden = ConvNorm(channels, 32, 3)
        self.output = Pointwise(32, 4 * classes)
        nn.init.constant_(self.output.bias, -2.0)

    def forward(self, features: Tensor) -> Tensor:
        """Map ``(B, C, H, W)`` to logits ``(B, classes, 2 H, 2 W)``."""
        return F.pixel_shuffle(self.output(self.hidden(features)), 2)


class UpsamplingSegmentationHead(nn.Module):
    """MapTracker's: two convolutions with an upsampling between them."""

    def __init__(self, width: int, classes: int) -> None:
        super().__init__()
        self.before = nn.Conv2d(width, width, 3, padding=1, bias=False)
        self.after = nn.Conv2d(width, width, 3, padding=1)
        self.classify = nn.Conv2d(width, classes, 1)

    def forward(self, bev: Tensor) -> Tensor:
        """Map ``(B, C, H, W)`` to logits ``(B, classes, 2 H, 2 W)``."""
        hidden = F.interpolate(F.relu(self.before(bev)), scale_factor=2, mode="nearest")
        return self.classify(F.relu(self.after(hidden)))
