"""Modulated deformable 3x3 convolution (DCNv2, Zhu et al. 2019)."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from predmapnet.network.kernels.bilinear_sampling import bilinear_corners, weighted_rows
from predmapnet.network.kernels.matrix_product import linear
from predmapnet.network.layers import Convolution

TAPS = 9


class DeformableConvolution(nn.Module):
    """A 3x3 convolution whose nine taps look where the features say, and count as much as the features say.

    It starts as an ordinary convolution with all taps counting half.
    """

    bias: nn.Parameter | None

    def __init__(self, channels_in: int, channels_out: int) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.empty(channels_out, channels_in, 3, 3))
        self.register_parameter("bias", None)
        self.offsets = Convolution(channels_in, 3 * TAPS, 3, padding=1)
        nn.init.kaiming_uniform_(self.weight, nonlinearity="relu")
        nn.init.zeros_(self.offsets.weight)
        assert self.offsets.bias is not None
        nn.init.zeros_(self.offsets.bias)

    def forward(self, features: Tensor) -> Tensor:
        """Map ``(N, C_in, h, w)`` to ``(N, C_out, h, w)``, channels-last in memory."""
        batch, channels, height, width = features.shape
        moves = self.offsets(features).permute(0, 2, 3, 1)
        y, x = self._positions(moves[..., : 2 * TAPS], height, width)
        indices, shares = bilinear_corners(x, y, width, height)
        first = torch.arange(batch, device=features.device, dtype=torch.int32) * (height * width)
        indices = (indices + first[:, None, None, None, None]).view(-1, 4)
        shares = shares * moves[..., 2 * TAPS :, None].sigmoid()
        pixels = features.permute(0, 2, 3, 1).reshape(-1, channels)
        samples = weighted_rows(pixels, indices, shares.view(-1, 4)).view(-1, TAPS * channels)
        kernel = self.weight.permute(0, 2, 3, 1).reshape(-1, TAPS * channels)
        return linear(samples, kernel, self.bias).view(batch, height, width, -1).permute(0, 3, 1, 2)

    @staticmethod
    def _positions(moves: Tensor, height: int, width: int) -> tuple[Tensor, Tensor]:
        """Return where the taps look, in pixels: y and x, each ``(N, h, w, 9)``; moves are pairs (dy, dx) per tap."""
        near = torch.arange(-1, 2, device=moves.device)
        row = torch.arange(height, device=moves.device)[:, None, None]
        column = torch.arange(width, device=moves.device)[:, None]
        dy, dx = moves.unflatten(-1, (TAPS, 2)).unbind(-1)
        return row + near.repeat_interleave(3) + dy, column + near.repeat(3) + dx
