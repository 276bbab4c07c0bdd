"""Cached frames as the network takes them, put side by side."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import torch
from torch import Tensor

from predmapnet.config import PredMapNetConfig
from predmapnet.frame_cache.scene_cache import CachedFrame
from predmapnet.network.calibration import Calibration, collate_calibrations, pad_cameras
from predmapnet.network.image_input import normalise_images
from predmapnet.network.predmapnet import PredMapNet
from predmapnet.network.state import BevFeatures, FrameInputs
from predmapnet.training.data.targets import Targets, truth_targets

RASTER_GRID = (100, 200)
"""Rows and columns at which truth is drawn; the losses bring it to the size of what they compare."""


@dataclass
class Batch:
    """Frames of ``B`` streams at one instant, of any cars; ``N`` is the largest number of cameras.

    Attributes:
        images: ``(B, N, h, w, 3) uint8``; without cameras where features are cached.
        camera_valid: ``(B, N) bool``; False for missing cameras and in padding.
        ego_to_global: ``(B, 4, 4) float64``.
        calibration: of the cameras.
        targets: truth of these frames.
        depth: ``(B, N, h', w') int64`` of :func:`~predmapnet.frame_cache.depth_targets.depth_of_frame`, or None.
    """

    images: Tensor
    camera_valid: Tensor
    ego_to_global: Tensor
    calibration: Calibration
    targets: Targets
    depth: Tensor | None = None

    def inputs(self, network: PredMapNet) -> FrameInputs:
        """Return what a network takes of these frames, on its device."""
        device, images = network.device, self.images.to(network.device)
        if images.dtype == torch.uint8 and images.numel():
            images = normalise_images(images, network.config.image)
        valid, poses = self.camera_valid.to(device), self.ego_to_global.to(device)
        return FrameInputs(images, valid, poses, self.calibration.to(device))


@dataclass
class StreamSegment:
    """A few frames of every stream: single ones, clips, or what comes next in streams that go on.

    Attributes:
        instants: the frames, one batch per instant.
        features: BEV features of each instant; images are absent then. Empty where there are images.
        fresh: ``(B,) bool``, streams that begin here and must forget what was before; None for all of them.
        after: truth of the instant after the last one, nothing for streams that end; None where none comes.
    """

    instants: list[Batch]
    features: list[BevFeatures] = field(default_factory=list)
    fresh: Tensor | None = None
    after: Targets | None = None


def collate_frames(frames: Sequence[CachedFrame], config: PredMapNetConfig) -> Batch:
    """Put frames of any cars into one batch."""
    depths = [frame.depth for frame in frames if frame.depth is not None]
    return Batch(
        images=pad_cameras([frame.images for frame in frames]),
        camera_valid=pad_cameras([frame.camera_valid for frame in frames]),
        ego_to_global=torch.from_numpy(np.stack([frame.ego_to_global for frame in frames])),
        calibration=collate_calibrations([frame.calibration for frame in frames]),
        targets=truth_targets([frame.truth for frame in frames], config.roi, config.decoder.points, RASTER_GRID),
        depth=pad_cameras(depths) if depths else None,
    )
