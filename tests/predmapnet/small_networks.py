"""The networks of all tests: presets at small sizes, weights that are nowhere zero, and frames for them."""

from typing import Any, TypeVar

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional

from predmapnet.config import PredMapNetConfig
from predmapnet.network.calibration import Calibration, collate_calibrations
from predmapnet.network.predmapnet import PredMapNet
from predmapnet.network.state import FrameInputs
from predmapnet.network.track_selection import select
from predmapnet.presets import preset

Module = TypeVar("Module", bound=nn.Module)
Sections = dict[str, Any]
"""Values of a configuration by name, sections within them."""
LITE: Sections = {
    "image": {"width": 64, "height": 24},
    "bev": {
        "rows": 26,
        "columns": 52,
        "widths": (16, 24, 32),
        "backbone": {"stem": (8, 8), "widths": (8, 8, 16), "blocks": (1, 1, 1), "channels": 8},
        "memory": {"channels": 4, "capacity": 5},
    },
    "masks": {"channels": 16},
    "decoder": {"queries": 8, "points": 6, "width": 32, "heads": 4, "layers": 2, "point_width": 16},
    "future": {"hidden": 32},
}
SIZE = (64, 96)
MAPTRACKER: Sections = {
    "image": {"height": SIZE[0], "width": SIZE[1]},
    "bev": {
        "rows": 10,
        "columns": 20,
        "width": 32,
        "heads": 4,
        "hidden": 32,
        "cameras": ("front", "back"),
        "memory": {"capacity": 6},
    },
    "masks": {"channels": 16},
    "future": {"hidden": 32},
    "decoder": {
        "queries": 12,
        "points": 5,
        "width": 32,
        "heads": 4,
        "layers": 2,
        "hidden": 32,
        "memory_capacity": 6,
    },
    # An untrained network scores everything about 0.5.
    "tracking": {"tau_t": 0.4, "first_tau_d": 0.4, "tau_d": 0.52},
}


def small_config(name: str = "maptracker-nuscenes", **sections: Sections) -> PredMapNetConfig:
    """Return a preset with small sizes; keyword arguments change sections further."""
    values = preset(name).model_dump()
    for changes in (LITE if name == "lite" else MAPTRACKER, sections):
        values = changed(values, changes)
    return PredMapNetConfig.model_validate(values)


def changed(values: Sections, changes: Sections) -> Sections:
    """Change some of the values, in sections as well; a section of a kind of its own takes the place of another."""
    new = {
        name: changed(values[name], value) if isinstance(value, dict) and "kind" not in value else value
        for name, value in changes.items()
    }
    return {**values, **new}


def small_network(config: PredMapNetConfig, seed: int = 0) -> PredMapNet:
    """Return a network in evaluation mode whose sampling offsets and biases are away from zero."""
    torch.manual_seed(seed)
    network = PredMapNet(config).eval()
    with torch.no_grad():
        for name, parameter in network.named_parameters():
            if name.startswith(("history_guidance", "future_guidance")):
                continue
            if parameter.ndim == 1:
                parameter.add_(0.1 * torch.randn_like(parameter))
            elif name.endswith("offsets.weight"):
                parameter.add_(0.05 * torch.randn_like(parameter))
    return network


class PlainBackbone(nn.Module):
    """One convolution in place of a ResNet-50, at the same strides."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.convolution = nn.Conv2d(3, channels, 8, stride=8)

    def forward(self, images: Tensor) -> list[Tensor]:
        fine = torch.relu(self.convolution(images / 30.0))
        return [fine, functional.avg_pool2d(fine, 2), functional.avg_pool2d(fine, 4, ceil_mode=True)]


def opened(module: Module, seed: int = 0) -> Module:
    """Give branches and biases that begin as zero the weights that training would, and switch to evaluation."""
    generator = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        for parameter in module.parameters():
            if not parameter.any():
                parameter.normal_(0, 0.3, generator=generator)
    return module.eval()


def two_cameras() -> Calibration:
    """One camera looks forward, one back, 1.5 m above the ground."""
    intrinsics = np.array([[60.0, 0, 48, 0], [0, 60.0, 32, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
    forward = np.array([[0.0, -1, 0, 0], [0, 0, -1, 1.5], [1, 0, 0, 0], [0, 0, 0, 1]])
    backward = np.array([[0.0, 1, 0, 0], [0, 0, -1, 1.5], [-1, 0, 0, 0], [0, 0, 0, 1]])
    return Calibration(
        ego_to_image=torch.from_numpy(np.stack([intrinsics @ forward, intrinsics @ backward])[None, :, :3]),
        image_size=torch.tensor(SIZE[::-1], dtype=torch.float64).expand(1, 2, 2),
        ground_height=torch.zeros(1, 2, dtype=torch.float64),
        camera_code=torch.tensor([[0, 1]]),
    )


def frames(count: int, seed: int, step: float = 1.7) -> list[FrameInputs]:
    """Return frames of one stream that drives forward."""
    generator = torch.Generator().manual_seed(seed)
    inputs = []
    for number in range(count):
        pose = torch.eye(4, dtype=torch.float64)[None]
        pose[0, :2, 3] = torch.tensor([1000.0 + step * number, -500.0 + seed], dtype=torch.float64)
        images = 30 * torch.randn(1, 2, 3, *SIZE, generator=generator)
        inputs.append(FrameInputs(images, torch.ones(1, 2, dtype=torch.bool), pose, two_cameras()))
    return inputs


def together(streams: list[FrameInputs]) -> FrameInputs:
    """Put frames of several streams into one batch."""
    tensors = {
        name: torch.cat([getattr(one, name) for one in streams]) for name in vars(streams[0]) if name != "calibration"
    }
    return FrameInputs(**tensors, calibration=collate_calibrations([one.calibration for one in streams]))


def step(network, inputs, state):
    """One frame of a stream: outputs, and the state after it."""
    outputs = network(inputs, state)
    selection = select(outputs, state, network.config)
    return outputs, network.advance(state, outputs, selection.instances, inputs)
