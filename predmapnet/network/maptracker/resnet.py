"""Image backbone of MapTracker: ResNet-50 (caffe style, deformable in the last two stages) and a feature pyramid."""

from __future__ import annotations

from collections.abc import Sequence

import torch.nn.functional as F
from torch import Tensor, nn

from predmapnet.network.kernels.deformable_convolution import DeformableConvolution
from predmapnet.network.kernels.normalised_convolution import NormalisedConvolution

BLOCKS = (3, 4, 6, 3)
STAGE_WIDTHS = (64, 128, 256, 512)
EXPANSION = 4
DEFORMABLE = (False, False, True, True)
LEVEL_WIDTHS = tuple(EXPANSION * width for width in STAGE_WIDTHS[1:])
"""Channels of the three levels that are returned, at strides 8, 16 and 32."""


class DeformableUnit(nn.Module):
    """Deformable 3x3 convolution, then batch norm."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.convolution = DeformableConvolution(width, width)
        self.norm: nn.Module = nn.BatchNorm2d(width)

    def forward(self, features: Tensor) -> Tensor:
        """Map ``(N, C, h, w)`` to ``(N, C, h, w)``."""
        return self.norm(self.convolution(features))


class Bottleneck(nn.Module):
    """1x1, 3x3, 1x1 and a shortcut. Caffe style: the stride is in the first 1x1 convolution."""

    def __init__(self, channels_in: int, width: int, stride: int, deformable: bool) -> None:
        super().__init__()
        channels_out = EXPANSION * width
        self.reduce = NormalisedConvolution(channels_in, width, 1, stride)
        self.spatial = DeformableUnit(width) if deformable else NormalisedConvolution(width, width, 3)
        self.expand = NormalisedConvolution(width, channels_out, 1)
        plain = channels_in == channels_out and stride == 1
        self.shortcut = nn.Identity() if plain else NormalisedConvolution(channels_in, channels_out, 1, stride)

    def forward(self, features: Tensor) -> Tensor:
        """Map ``(N, C_in, h, w)`` to ``(N, 4 width, h / stride, w / stride)``."""
        hidden = F.relu(self.reduce(features), inplace=True)
        hidden = F.relu(self.spatial(hidden), inplace=True)
        return F.relu(self.expand(hidden).add_(self.shortcut(features)), inplace=True)


class ResNet50(nn.Module):
    """Image backbone. Its batch norms always use their stored statistics, as in MapTracker's training."""

    def __init__(self) -> None:
        super().__init__()
        self.stem = NormalisedConvolution(3, STAGE_WIDTHS[0], 7, stride=2)
        self.pool = nn.MaxPool2d(3, stride=2, padding=1)
        stages, channels = [], STAGE_WIDTHS[0]
        for stage, (blocks, width, deformable) in enumerate(zip(BLOCKS, STAGE_WIDTHS, DEFORMABLE, strict=True)):
            first = Bottleneck(channels, width, 1 if stage == 0 else 2, deformable)
            channels = EXPANSION * width
            rest = [Bottleneck(channels, width, 1, deformable) for _ in range(blocks - 1)]
            stages.append(nn.Sequential(first, *rest))
        self.stages = nn.ModuleList(stages)

    def train(self, mode: bool = True) -> ResNet50:
        """Set the mode of everything but the batch norms."""
        super().train(mode)
        for module in self.modules():
            if isinstance(module, nn.BatchNorm2d):
                module.eval()
        return self

    def forward(self, images: Tensor) -> list[Tensor]:
        """Map images ``(N, 3, h, w)`` (BGR, mean subtracted) to three levels, fine to coarse."""
        features = self.pool(F.relu(self.stem(images), inplace=True))
        levels = []
        for stage in self.stages:
            features = stage(features)
            levels.append(features)
        return levels[1:]


class FeaturePyramid(nn.Module):
    """Feature pyramid (Lin et al. 2017) with batch norm: coarse levels inform fine ones, all get the same width."""

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


class ResNet50Pyramid(nn.Module):
    """ResNet-50 and a feature pyramid over its levels."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.resnet = ResNet50()
        self.pyramid = FeaturePyramid(LEVEL_WIDTHS, channels)

    def forward(self, images: Tensor) -> list[Tensor]:
        """Map ``(M, 3, h, w)`` to ``(M, channels, h / s, w / s)`` for the strides s = 8, 16 and 32."""
        return self.pyramid(self.resnet(images))
