"""Faster copy of a network that only infers."""

from __future__ import annotations

import copy
from typing import TypeVar

from torch import Tensor, nn

from predmapnet.network.kernels.normalised_convolution import NormalisedConvolution, with_norm
from predmapnet.network.layers import ConvNorm
from predmapnet.network.maptracker.resnet import DeformableUnit

_Network = TypeVar("_Network", bound=nn.Module)


def for_inference(network: _Network) -> _Network:
    """Return a copy in evaluation mode, in which norms with fixed statistics are part of the kernels before them.

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
    return copied


def _fold(convolution: nn.Module, norm: nn.Module) -> None:
    assert isinstance(convolution.weight, Tensor) and isinstance(norm, nn.BatchNorm2d)
    kernel, bias = with_norm(convolution.weight, norm)
    convolution.weight = nn.Parameter(kernel, requires_grad=False)
    convolution.bias = nn.Parameter(bias, requires_grad=False)
