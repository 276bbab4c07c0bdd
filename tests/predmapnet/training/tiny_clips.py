"""The paper's network with all of its parts, made small, and clips of painted scenes for it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch

from predmapnet.config import PredMapNetConfig
from predmapnet.datasets.nuscenes_tables import NUSCENES_CAMERAS
from predmapnet.network.calibration import collate_calibrations
from predmapnet.network.predmapnet import PredMapNet
from predmapnet.training.data.batches import Batch
from predmapnet.training.data.targets import truth_targets
from tests.predmapnet.small_networks import small_config
from tests.predmapnet.training.painted_scenes import painted_scene

GRID = (100, 200)


def tiny_paper_config() -> PredMapNetConfig:
    """All parts of ``paper-nuscenes``; the image backbone is as deep, the rest narrow."""
    return small_config(
        "paper-nuscenes",
        bev={"rows": 12, "columns": 24, "cameras": NUSCENES_CAMERAS, "memory": {"capacity": 20}},
        decoder={"points": 20, "memory_capacity": 20},
        tracking={"tau_t": 0.5, "first_tau_d": None, "tau_d": 0.4},
    )


def tiny_network(config: PredMapNetConfig, seed: int = 0) -> PredMapNet:
    """A network in training mode that is confident enough for tracks from the first step on."""
    torch.manual_seed(seed)
    network = PredMapNet(config).train()
    torch.nn.init.constant_(network.map_decoder.classify.bias, 0.0)
    return network


def painted_clip(folder: Path, config: PredMapNetConfig, frames: int, streams: int = 2) -> list[Batch]:
    """The first frames of painted scenes, with random depth."""
    scenes = [painted_scene(folder / f"scene-{seed}", frames, seed, config) for seed in range(streams)]
    generator = torch.Generator().manual_seed(0)
    clip = []
    for index in range(frames):
        loaded = [scene.frame(index) for scene in scenes]
        images = torch.from_numpy(np.stack([frame.images for frame in loaded]))
        cells = (streams, images.shape[1], config.image.height // 8, config.image.width // 8)
        clip.append(
            Batch(
                images=images,
                camera_valid=torch.ones(images.shape[:2], dtype=torch.bool),
                ego_to_global=torch.from_numpy(np.stack([frame.ego_to_global for frame in loaded])),
                calibration=collate_calibrations([frame.calibration for frame in loaded]),
                targets=truth_targets([frame.truth for frame in loaded], config.roi, config.decoder.points, GRID),
                depth=torch.randint(-1, config.depth.bins, cells, generator=generator),
            )
        )
    return clip
