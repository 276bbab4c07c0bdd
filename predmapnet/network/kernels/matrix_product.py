"""Matrix products of many rows, by the fastest way that torch has on a CPU."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from predmapnet.network.kernels.tracing import is_traced

MANY_ROWS = 512
"""Fewer rows are no work for a convolution."""

MANY_PRODUCTS = 2**26
"""Multiply-adds from which on a convolution's greater overhead pays; below, MKL is as fast or faster."""

ONEDNN = torch.backends.mkldnn.is_available()

SMALLEST_BATCH = 16
"""From this batch on, torch gives 1x1 convolutions to oneDNN with any number of threads."""


def linear(tokens: Tensor, weight: Tensor, bias: Tensor | None = None) -> Tensor:
    """Multiply tokens ``(..., C_in)`` by a weight ``(C_out, C_in)`` and add the bias, in the precision of the weight.

    On a CPU, torch multiplies matrices by MKL, which runs below the machine's rate unless Intel made it, and
    convolutions by oneDNN, which does not. So large products are put as 1x1 convolutions, rows as pixels.
    """
    tokens = tokens.to(weight.dtype)
    if is_traced():
        return F.linear(tokens, weight, bias)
    rows = tokens.numel() // weight.shape[1]
    is_large = rows >= MANY_ROWS and rows * weight.numel() >= MANY_PRODUCTS
    batch = _divisor(rows) if is_large and tokens.device.type == "cpu" else None
    if batch is None or not ONEDNN:
        return F.linear(tokens, weight, bias)
    pixels = tokens.reshape(batch, rows // batch, 1, -1).permute(0, 3, 1, 2)
    product = F.conv2d(pixels, weight[:, :, None, None], bias)
    return product.permute(0, 2, 3, 1).reshape(*tokens.shape[:-1], -1)


def _divisor(rows: int) -> int | None:
    """Return a number that the rows can be divided by, for a batch of images."""
    return next((batch for batch in range(SMALLEST_BATCH, 4 * SMALLEST_BATCH) if rows % batch == 0), None)


class Linear(nn.Linear):
    """A linear layer for many rows: cells of a map, pixels of images."""

    def forward(self, tokens: Tensor) -> Tensor:
        """Map ``(..., C_in)`` to ``(..., C_out)``."""
        return linear(tokens, self.weight, self.bias)
