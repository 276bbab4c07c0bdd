"""Small parts that several modules share: attention, perceptrons, convolutions and position codes."""

from __future__ import annotations

import math
from itertools import pairwise

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from predmapnet.network.kernels.matrix_product import Linear
from predmapnet.network.kernels.tracing import is_traced


class Attention(nn.Module):
    """Multi-head attention with separate query and key/value inputs.

    Args:
        width: of queries and outputs.
        heads: number of heads.
        key_width: of keys and values; the query's width by default.
    """

    def __init__(self, width: int, heads: int, key_width: int | None = None) -> None:
        super().__init__()
        self.heads = heads
        self.query = Linear(width, width)
        self.key = Linear(key_width or width, width)
        self.value = Linear(key_width or width, width)
        self.output = Linear(width, width)

    def forward(self, query: Tensor, key: Tensor, value: Tensor, allowed: Tensor | None = None) -> Tensor:
        """Attend from ``(B, R, C)`` to ``(B, S, C_k)``; ``allowed (B, R, S) bool`` must allow each row something."""
        q, k, v = (
            tokens.unflatten(-1, (self.heads, -1)).transpose(1, 2)
            for tokens in (self.query(query), self.key(key), self.value(value))
        )
        mask = None if allowed is None else allowed[:, None]
        attended = F.scaled_dot_product_attention(q, k, v, attn_mask=mask)
        return self.output(attended.transpose(1, 2).flatten(-2))


class Perceptron(nn.Sequential):
    """Linear layers with ReLU between them."""

    def __init__(self, *widths: int, zero_last: bool = False) -> None:
        layers: list[nn.Module] = []
        for width_in, width_out in pairwise(widths):
            layers += [nn.Linear(width_in, width_out), nn.ReLU()]
        super().__init__(*layers[:-1])
        if zero_last:
            zero_init(self[-1])


class FeedForward(nn.Module):
    """Residual two-layer perceptron with layer norm after the sum."""

    def __init__(self, width: int, hidden: int) -> None:
        super().__init__()
        self.perceptron = Perceptron(width, hidden, width)
        self.norm = nn.LayerNorm(width)

    def forward(self, tokens: Tensor) -> Tensor:
        """Map ``(..., C)`` to ``(..., C)``."""
        return self.norm(tokens + self.perceptron(tokens))


class ResidualPerceptron(nn.Module):
    """Two linear layers with ReLU between them, and the input."""

    def __init__(self, width: int, hidden: int, dropout: float) -> None:
        super().__init__()
        self.first = Linear(width, hidden)
        self.second = Linear(hidden, width)
        self.dropout = nn.Dropout(dropout)

    def forward(self, tokens: Tensor) -> Tensor:
        """Map ``(..., C)`` to ``(..., C)``."""
        return tokens + self.dropout(self.second(self.dropout(torch.relu(self.first(tokens)))))


class Pointwise(Linear):
    """A 1x1 convolution as the matrix product that it is."""

    def forward(self, features: Tensor) -> Tensor:
        """Map ``(B, C_in, h, w)`` to ``(B, C_out, h, w)``, channels-last in memory."""
        return super().forward(features.permute(0, 2, 3, 1)).permute(0, 3, 1, 2)


class Convolution(nn.Conv2d):
    """A convolution in the precision of its weights."""

    def forward(self, features: Tensor) -> Tensor:
        """Map ``(B, C_in, h, w)`` to ``(B, C_out, h / stride, w / stride)``."""
        return super().forward(features.to(self.weight.dtype))


class ConvNorm(nn.Sequential):
    """Convolution without bias and batch norm; ReLU if asked for."""

    def __init__(self, channels_in: int, channels_out: int, kernel: int, stride: int = 1, relu: bool = True) -> None:
        plain = kernel == stride == 1
        convolution = (
            Pointwise(channels_in, channels_out, bias=False)
            if plain
            else Convolution(channels_in, channels_out, kernel, stride, (kernel - 1) // 2, bias=False)
        )
        super().__init__(convolution, nn.BatchNorm2d(channels_out))
        if relu:
            self.append(nn.ReLU(inplace=True))


class ResidualBlock(nn.Module):
    """Basic block: two 3x3 convolutions and a shortcut."""

    def __init__(self, channels_in: int, channels_out: int, stride: int = 1) -> None:
        super().__init__()
        self.first = ConvNorm(channels_in, channels_out, 3, stride)
        self.second = ConvNorm(channels_out, channels_out, 3, relu=False)
        plain = channels_in == channels_out and stride == 1
        self.shortcut = nn.Identity() if plain else ConvNorm(channels_in, channels_out, 1, stride, relu=False)

    def forward(self, features: Tensor) -> Tensor:
        """Map ``(B, C_in, h, w)`` to ``(B, C_out, h / stride, w / stride)``."""
        return F.relu(self.second(self.first(features)) + self.shortcut(features), inplace=True)


def zero_init(layer: nn.Module) -> None:
    """Set the weight and bias of a linear or convolution layer to zero: a residual branch that starts as nothing."""
    assert isinstance(layer, nn.Linear | nn.Conv2d)
    nn.init.zeros_(layer.weight)
    if layer.bias is not None:
        nn.init.zeros_(layer.bias)


SINE_FREQUENCIES = 6
"""Octaves of :func:`sine_code` for positions in the region: periods from twice its length down to 1/16 of it."""


def sine_code(positions: Tensor, frequencies: int) -> Tensor:
    """Encode coordinates ``(..., d)`` in [0, 1] by sines and cosines of octaves from half a period up.

    Returns:
        ``(..., d * 2 * frequencies)``: all sines, then all cosines.
    """
    octaves = math.pi * 2.0 ** torch.arange(frequencies, device=positions.device, dtype=positions.dtype)
    angles = (positions[..., None] * octaves).flatten(-2)
    return torch.cat([angles.sin(), angles.cos()], dim=-1)


def interleaved_sines(values: Tensor, width: int) -> Tensor:
    """Encode numbers ``(...)`` by ``(..., width)`` sines and cosines in turns, of periods rising to 10,000."""
    steps = torch.arange(0, width, 2, device=values.device, dtype=torch.float32)
    angles = values[..., None] * torch.exp(steps * (-math.log(10000.0) / width))
    return torch.stack([angles.sin(), angles.cos()], dim=-1).flatten(-2)


def cell_centres(rows: int, columns: int, device: torch.device | None = None) -> Tensor:
    """Return the centres (x, y) of a grid's cells over the ROI, 0 to 1: ``(rows, columns, 2)``; y falls by rows."""
    x = (torch.arange(columns, device=device) + 0.5) / columns
    y = 1.0 - (torch.arange(rows, device=device) + 0.5) / rows
    return torch.stack(torch.broadcast_tensors(x[None, :], y[:, None]), dim=-1)


class CellCode(nn.Linear):
    """Code of the places of a grid's cells: a linear layer of their sines.

    Attributes:
        known: codes by rows, columns and device, in a network whose weights no longer change
            (:func:`predmapnet.network.kernels.inference.for_inference`); None in others.
    """

    def __init__(self, width: int) -> None:
        super().__init__(4 * SINE_FREQUENCIES, width)
        self.known: dict[tuple[int, int, torch.device], Tensor] | None = None

    def of_grid(self, rows: int, columns: int) -> Tensor:
        """Return the code ``(rows * columns, C)`` of a grid over the ROI."""
        key = rows, columns, self.weight.device
        if self.known is not None and key in self.known:
            return self.known[key]
        code: Tensor = self(sine_code(cell_centres(rows, columns, self.weight.device), SINE_FREQUENCIES).flatten(0, 1))
        if self.known is not None and not is_traced():
            self.known[key] = code
        return code


def flatten_cells(features: Tensor) -> Tensor:
    """Turn a map ``(B, C, h, w)`` into tokens ``(B, h * w, C)``, row by row."""
    return features.flatten(2).transpose(1, 2)
