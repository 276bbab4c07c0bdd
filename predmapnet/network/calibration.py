"""Calibration of the cameras: an input of every frame, so that the network knows no car by heart."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from predmapnet.config import BevFormerConfig, PredMapNetConfig
from predmapnet.errors import UserError
from predmapnet.network.image_input import ego_to_image, image_window
from predmapnet.scenes import Rig


@dataclass(frozen=True)
class Calibration:
    """Cameras of ``B`` frames, ``N`` each, as the network's input shows them.

    Frames of a batch may come from different cars. Those with fewer cameras are padded with cameras that see nothing;
    ``camera_valid`` of :class:`predmapnet.network.state.FrameInputs` is False for them.

    Attributes:
        ego_to_image: ``(B, N, 3, 4) float64``: from metres of the ego frame, homogeneous, to (u depth, v depth, depth)
            in pixels of the network's input, the centre of the first one at (0.5, 0.5). Zeros in padding.
        image_size: ``(B, N, 2) float64``: width and height in pixels of the part of the input that shows the image.
        ground_height: ``(B, N) float64``: z of the road under the car in the ego frame, metres.
        camera_code: ``(B, N) int64``: which of its learned camera codes a network adds (MapTracker); 0 for others.
    """

    ego_to_image: Tensor
    image_size: Tensor
    ground_height: Tensor
    camera_code: Tensor

    @classmethod
    def empty(cls, batch: int, device: torch.device | None = None) -> Calibration:
        """Return the calibration of ``batch`` frames without cameras."""
        numbers = torch.zeros(batch, 0, 12, dtype=torch.float64, device=device)
        code = torch.zeros(batch, 0, dtype=torch.int64, device=device)
        return cls(numbers.unflatten(-1, (3, 4)), numbers[..., :2], numbers[..., 0], code)

    def to(self, device: torch.device | str) -> Calibration:
        """Return a copy on ``device``."""
        return Calibration(**{name: value.to(device) for name, value in vars(self).items()})

    def fingerprint(self) -> bytes:
        """Return what two calibrations share if they are equal in every bit."""
        return b"".join(value.cpu().numpy().tobytes() for value in vars(self).values())


def calibrate(rig: Rig, config: PredMapNetConfig) -> Calibration:
    """Describe the cameras of one frame, in the order in which their images come, as the network's input shows them.

    Raises:
        UserError: the network has a learned code for each camera, and none for one of these.
    """
    windows = [image_window(camera, config.image) for camera in rig]
    sizes = [(window.scaled_width, min(config.image.height, window.scaled_height - window.top)) for window in windows]
    return Calibration(
        ego_to_image=torch.from_numpy(ego_to_image(rig, config.image)[None, :, :3]),
        image_size=torch.tensor([sizes], dtype=torch.float64),
        ground_height=torch.tensor([[camera.ground_height for camera in rig]], dtype=torch.float64),
        camera_code=torch.tensor([_camera_codes(rig, config)]),
    )


def collate_calibrations(calibrations: Sequence[Calibration]) -> Calibration:
    """Put frames of any cars into one batch, padded to the largest number of cameras."""
    cameras = max(calibration.camera_code.shape[1] for calibration in calibrations)

    def together(name: str) -> Tensor:
        values = [getattr(calibration, name) for calibration in calibrations]
        padded = [F.pad(v, (*(0, 0) * (v.ndim - 2), 0, cameras - v.shape[1])) for v in values]
        return torch.cat(padded)

    return Calibration(**{name: together(name) for name in vars(calibrations[0])})


def pad_cameras(values: Sequence[np.ndarray]) -> Tensor:
    """Stack arrays ``(N_i, ...)`` of several frames to ``(B, N, ...)``; what is added is zero or False."""
    cameras = max(map(len, values))
    whole = np.zeros((len(values), cameras, *values[0].shape[1:]), values[0].dtype)
    for padded, value in zip(whole, values, strict=True):
        padded[: len(value)] = value
    return torch.from_numpy(whole)


def _camera_codes(rig: Rig, config: PredMapNetConfig) -> list[int]:
    """Find the learned code of each camera by its name; a network without such codes takes any camera."""
    if not isinstance(config.bev, BevFormerConfig):
        return [0] * len(rig)
    unknown = [camera.name for camera in rig if camera.name not in config.bev.cameras]
    if unknown:
        raise UserError(
            f"The weights of {config.name} have learned a code for each of {len(config.bev.cameras)} cameras "
            f"({', '.join(config.bev.cameras)}), but this car has {', '.join(unknown)}, which they do not know. "
            "Use weights that were trained with its cameras, or weights without such codes, as those that come with "
            "PredMapNet."
        )
    return [config.bev.cameras.index(camera.name) for camera in rig]
