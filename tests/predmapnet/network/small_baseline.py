"""MapTracker's baseline at a size for tests, two cameras, and frames for them."""

import numpy as np
import torch

from predmapnet.config import PredMapNetConfig
from predmapnet.network.calibration import Calibration, collate_calibrations
from predmapnet.network.predmapnet import PredMapNet
from predmapnet.network.state import FrameInputs
from predmapnet.network.track_selection import select
from predmapnet.presets import preset

SIZE = (64, 96)
SECTIONS = {
    "image": {"height": SIZE[0], "width": SIZE[1]},
    "backbone": {"channels": 32},
    "bev": {"rows": 10, "columns": 20, "width": 32, "heads": 4, "hidden": 32, "cameras": ("front", "back")},
    "temporal_bev": {"capacity": 6},
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


def small_config(name: str = "maptracker-nuscenes", **sections: dict[str, object]) -> PredMapNetConfig:
    """Return a preset with small sizes; keyword arguments change sections further."""
    values = preset(name).model_dump()
    for changes in (SECTIONS, sections):
        for section, change in changes.items():
            values[section] = change if "kind" in change else {**values[section], **change}
    return PredMapNetConfig.model_validate(values)


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
