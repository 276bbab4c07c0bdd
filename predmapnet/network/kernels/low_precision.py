"""bfloat16 in the image backbone and the BEV encoder, for machines that multiply such numbers faster.

Only the products are: convolutions and linear layers, which are nearly all of the work. What decides where something is
looked up (sampling offsets, attention weights), the look-ups themselves, norms, and everything after the BEV encoder
stay in float32: with eight bits, positions would be off by up to 0.4 % of the map.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from predmapnet.machine import Precision
from predmapnet.network.calibration import Calibration
from predmapnet.network.kernels.deformable_attention import DeformableAttention
from predmapnet.network.kernels.deformable_convolution import DeformableConvolution
from predmapnet.network.maptracker.bevformer import BevFormer
from predmapnet.network.predmapnet import PredMapNet
from predmapnet.network.small.bev_encoder import BevEncoder
from predmapnet.network.state import ViewGeometry


def in_precision(network: PredMapNet, precision: Precision) -> PredMapNet:
    """Return the network with its image backbone and BEV encoder in a precision; it is changed in place.

    It has to be one made for inference (:func:`predmapnet.network.kernels.inference.for_inference`).
    """
    if precision is Precision.BFLOAT16:
        for name in ("image_backbone", "bev_encoder"):
            network.add_module(name, _LowPrecision(network.get_submodule(name)))
    return network


def keep_places_exact(network: nn.Module) -> None:
    """Let what decides about places compute in float32 where a training computes in bfloat16 (autocast)."""
    for module in network.modules():
        for layer in _decide_places(module):
            layer.register_forward_pre_hook(_leave_autocast)
            layer.register_forward_hook(_return_to_autocast, always_call=True)


def _leave_autocast(layer: nn.Module, inputs: tuple[Tensor, ...]) -> tuple[Tensor, ...]:
    outside = torch.autocast(inputs[0].device.type, enabled=False)
    outside.__enter__()
    layer.__dict__["outside"] = outside
    return tuple(value.float() for value in inputs)


def _return_to_autocast(layer: nn.Module, _inputs: object, _output: object) -> None:
    layer.__dict__.pop("outside").__exit__(None, None, None)


class _LowPrecision(nn.Module):
    """A part of the network whose products are bfloat16, and whose results are float32."""

    def __init__(self, part: nn.Module) -> None:
        super().__init__()
        self.part = part
        exact = {id(layer) for module in part.modules() for layer in _decide_places(module)}
        for module in part.modules():
            if isinstance(module, nn.Conv2d | nn.Linear | DeformableConvolution) and id(module) not in exact:
                for name, parameter in module.named_parameters(recurse=False):
                    low = nn.Parameter(parameter.to(torch.bfloat16), requires_grad=False)
                    module.register_parameter(name, low)

    def geometry(self, calibration: Calibration, size: tuple[int, int]) -> ViewGeometry:
        """Return the geometry of the BEV encoder, which is exact."""
        assert isinstance(self.part, BevEncoder | BevFormer)
        return self.part.geometry(calibration, size)

    def forward(self, *arguments: object) -> list[Tensor]:
        """Compute what the part computes."""
        return [level.float() for level in self.part(*arguments)]


def _decide_places(module: nn.Module) -> list[nn.Module]:
    """Return the layers that say where a module looks, and how much each place counts."""
    if isinstance(module, DeformableConvolution):
        return [module.offsets]
    if isinstance(module, DeformableAttention):
        return [module.sampling_offsets, module.attention_weights]
    return []
