"""Auxiliary depth prediction on the image features (Sec. 3.6, after MapTRv2); used in training only."""

from __future__ import annotations

from torch import Tensor, nn

from predmapnet.config import DepthConfig
from predmapnet.network.layers import ConvNorm, Pointwise


class DepthHead(nn.Module):
    """Logits over depth bins, spaced evenly from ``near`` to ``far`` metres, for each pixel of the features."""

    def __init__(self, channels: int, config: DepthConfig) -> None:
        super().__init__()
        self.hidden = ConvNorm(channels, channels, 3)
        self.output = Pointwise(channels, config.bins)

    def forward(self, features: Tensor) -> Tensor:
        """Map ``(M, C, h', w')`` to logits ``(M, bins, h', w')``."""
        return self.output(self.hidden(features))
