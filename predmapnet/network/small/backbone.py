"""Image backbone of the small network: a residual network and a feature pyramid to stride 4."""

from __future__ import annotations

import torch.nn.functional as F
from torch import Tensor, nn

from predmapnet.config import SmallBackboneConfig
from predmapnet.network.layers import ConvNorm, Pointwise, ResidualBlock

STRIDE = 4
"""Pixels of the input per pixel of the features."""


class ImageBackbone(nn.Module):
    """Two stride-2 convolutions, three stages of basic blocks at strides 4, 8 and 16, and a top-down pyramid."""

    def __init__(self, config: SmallBackboneConfig) -> None:
        super().__init__()
        first, second = config.stem
        self.stem = nn.Sequential(ConvNorm(3, first, 3, stride=2), ConvNorm(first, second, 3, stride=2))
        widths = (second, *config.widths)
        self.stages = nn.ModuleList(
            nn.Sequential(
                ResidualBlock(widths[stage], widths[stage + 1], stride=1 if stage == 0 else 2),
                *(ResidualBlock(widths[stage + 1], widths[stage + 1]) for _ in range(blocks - 1)),
            )
            for stage, blocks in enumerate(config.blocks)
        )
        self.laterals = nn.ModuleList(Pointwise(width, config.channels) for width in config.widths)
        self.output = ConvNorm(config.channels, config.channels, 3)

    def forward(self, images: Tensor) -> list[Tensor]:
        """Map ``(M, 3, h, w)`` to features of a single level, ``(M, channels, h / 4, w / 4)``."""
        features = self.stem(images)
        pyramid = []
        for stage, lateral in zip(self.stages, self.laterals, strict=True):
            features = stage(features)
            pyramid.append(lateral(features))
        merged = pyramid.pop()
        while pyramid:
            finer = pyramid.pop()
            merged = finer + F.interpolate(merged, size=finer.shape[-2:], mode="nearest")
        return [self.output(merged)]
