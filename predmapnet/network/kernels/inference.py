"""Faster copy of a network that only infers."""

from __future__ import annotations

import copy
from typing import TypeVar

from torch import Tensor, nn

from predmapnet.network.kernels.normalised_convolution import NormalisedConvolution, with_norm
from predmapnet.network.layers import CellCode, ConvNorm
from predmapnet.network.maptracker.resnet import DeformableUnit
from predmapnet.network.small.bev_encoder import BevEncoder

_Network = TypeVar("_Network", bound=nn.Module)


def for_inference(network: _Network) -> _Network:
    """Return a copy in evaluation mode, in which norms with fixed statistics are part of the kernels before them.

    Codes of cells are computed once.

    Its results are the same but for rounding. It cannot be trained, and its state dict is its own.
    """
    copied = copy.deepcopy(network).eval().requires_grad_(False)
    for module in copied.modules():
        if isinstance(module, NormalisedConvolution | DeformableUnit):
            _fold(module.convolution, module.norm)
            module.norm = nn.Identity().eval()
        elif isinstance(module, ConvNorm):
            _fold(module[0], module[1])
            module[1] = nn.Identity().eval()
        elif isinstance(module, BevEncoder):
            _fold_into_sum(module)
        elif isinstance(module, CellCode):
            module.known = {}
    return copied


def _fold(convolution: nn.Module, norm: nn.Module) -> None:
    assert isinstance(convolution.weight, Tensor) and isinstance(norm, nn.BatchNorm2d)
    kernel, bias = with_norm(convolution.weight, norm)
    convolution.weight = nn.Parameter(kernel, requires_grad=False)
    convolution.bias = nn.Parameter(bias, requires_grad=False)


def _fold_into_sum(encoder: BevEncoder) -> None:
    """Fold the norm of the sum of what cells see and the position map into its terms; the map becomes channels-last."""
    assert isinstance(encoder.norm, nn.BatchNorm2d)
    position, shift = with_norm(encoder.position, encoder.norm)
    position = (position + shift[:, None, None]).movedim(0, -1).contiguous().movedim(-1, 0)
    encoder.position = nn.Parameter(position, requires_grad=False)
    for layer in (encoder.reduce, encoder.heights):
        if layer is not None:
            layer.weight = nn.Parameter(with_norm(layer.weight, encoder.norm)[0], requires_grad=False)
    encoder.norm = nn.Identity().eval()
