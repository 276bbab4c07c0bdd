"""Convolution and batch norm as one operation where the statistics are fixed."""

from __future__ import annotations

import torch.nn.functional as F
from torch import Tensor, nn

from predmapnet.network.kernels.matrix_product import linear


class NormalisedConvolution(nn.Module):
    """Convolution without bias, then batch norm.

    In evaluation mode the norm is folded into the kernel, which saves two passes over the features; 1x1 convolutions
    are computed as the matrix products that they are. Features are channels-last in memory.
    """

    def __init__(self, channels_in: int, channels_out: int, kernel: int, stride: int = 1) -> None:
        super().__init__()
        self.convolution = nn.Conv2d(channels_in, channels_out, kernel, stride, (kernel - 1) // 2, bias=False)
        self.norm: nn.Module = nn.BatchNorm2d(channels_out)

    def forward(self, features: Tensor) -> Tensor:
        """Map ``(N, C_in, h, w)`` to ``(N, C_out, h / stride, w / stride)``."""
        convolution, norm = self.convolution, self.norm
        if norm.training:
            return norm(convolution(features))
        kernel, shift = convolution.weight, convolution.bias
        if isinstance(norm, nn.BatchNorm2d):
            kernel, shift = with_norm(kernel, norm)
        if convolution.kernel_size == (1, 1) and convolution.stride == (1, 1):
            return linear(features.permute(0, 2, 3, 1), kernel.flatten(1), shift).permute(0, 3, 1, 2)
        return F.conv2d(features.to(kernel.dtype), kernel, shift, convolution.stride, convolution.padding)


def with_norm(kernel: Tensor, norm: nn.BatchNorm2d) -> tuple[Tensor, Tensor]:
    """Fold a norm with fixed statistics into the kernel ``(C_out, ...)`` before it; return it and the bias."""
    assert norm.running_mean is not None and norm.running_var is not None
    scale = norm.weight * (norm.running_var + norm.eps).rsqrt()
    return kernel * scale.view(-1, *[1] * (kernel.ndim - 1)), norm.bias - norm.running_mean * scale
