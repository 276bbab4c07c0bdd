"""BEV features of all frames, computed once by the parts of the network that a stage of streams leaves as they are."""

from __future__ import annotations

from collections.abc import Sequence
from hashlib import sha256
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from predmapnet.augmentation.frames import load_frame
from predmapnet.config import LookupBevConfig
from predmapnet.errors import UserError
from predmapnet.files import write_file
from predmapnet.frame_cache.scene_cache import CachedScene, TrainingScenes
from predmapnet.network.predmapnet import PredMapNet
from predmapnet.network.state import BevFeatures
from predmapnet.scenes import Report
from predmapnet.training.data.batches import collate_frames

ENCODERS = ("image_backbone", "bev_encoder")
ENCODE_BATCH = 4


def feature_shapes(network: PredMapNet) -> tuple[tuple[int, ...], ...]:
    """Return the shapes ``(C, H, W)`` of the levels; halved sizes are rounded up.

    Raises:
        UserError: the network's BEV features have the past in them.
    """
    bev = network.config.bev
    if not isinstance(bev, LookupBevConfig):
        raise UserError(
            f"{network.config.name} has the past in its BEV features, so that they cannot be computed once."
        )
    sizes = [(-(-bev.rows // scale), -(-bev.columns // scale)) for scale in (1, 2, 4)]
    return tuple((width, *size) for width, size in zip(bev.widths, sizes, strict=True))


class FeatureStore:
    """BEV features of all frames in half precision, one file per scene, named after what is in the scene.

    Every other scene is stored mirrored, so that both hands of the world are seen.
    """

    def __init__(self, folder: Path, shapes: tuple[tuple[int, ...], ...], scenes: Sequence[CachedScene]) -> None:
        """Use a folder that belongs to the encoders, the shapes ``(C, H, W)`` of the levels, and the scenes."""
        self._shapes = shapes
        named = (f"{scene.digest()}{'-mirrored' * self.mirrored(at)}.npy" for at, scene in enumerate(scenes))
        self._paths = [folder / name for name in named]
        folder.mkdir(parents=True, exist_ok=True)

    @staticmethod
    def mirrored(scene: int) -> bool:
        """Whether a scene is stored mirrored."""
        return scene % 2 == 1

    def has(self, scene: int) -> bool:
        """Whether a scene is complete."""
        return self._paths[scene].exists()

    def write(self, scene: int, features: Sequence[BevFeatures]) -> None:
        """Store the features of all frames of a scene, in batches in their order."""
        rows = [torch.cat([level.flatten(1) for level in each.levels], 1).half().cpu() for each in features]
        with write_file(self._paths[scene]) as temporary:
            np.save(temporary, torch.cat(rows).numpy())

    def read(self, scenes: NDArray[np.int64], frames: NDArray[np.int64]) -> BevFeatures:
        """Return the features of one frame of each of several scenes."""
        files = (np.load(self._paths[scene], mmap_mode="r") for scene in scenes)
        rows = torch.from_numpy(np.stack([file[frame] for file, frame in zip(files, frames, strict=True)]))
        parts = rows.float().split([int(np.prod(shape)) for shape in self._shapes], 1)
        levels = [part.reshape(-1, *shape) for part, shape in zip(parts, self._shapes, strict=True)]
        return BevFeatures([level.contiguous(memory_format=torch.channels_last) for level in levels])


@torch.no_grad()
def fill_features(
    network: PredMapNet, scenes: TrainingScenes, folder: Path, rank: int, size: int, report: Report
) -> FeatureStore:
    """Encode the scenes that are not stored yet, shared out over the processes (``rank`` of ``size``).

    A folder below ``folder`` is named after the encoders, so that features of others are never mixed in. The network
    is left in evaluation mode.
    """
    config = network.config
    digest = sha256(f"{config.image} {config.bev} {config.roi}".encode())
    for part in ENCODERS:
        for value in network.get_submodule(part).state_dict().values():
            digest.update(value.cpu().contiguous().numpy().tobytes())
    store = FeatureStore(folder / f"features-{digest.hexdigest()[:12]}", feature_shapes(network), scenes.scenes)
    network.eval()
    missing = [index for index in range(rank, len(scenes.scenes), size) if not store.has(index)]
    for done, scene in enumerate(missing, start=1):
        features = []
        for start in range(0, frames := len(scenes.scenes[scene]), ENCODE_BATCH):
            numbers = range(start, min(start + ENCODE_BATCH, frames))
            loaded = [load_frame(scenes, scene, frame, store.mirrored(scene)) for frame in numbers]
            inputs = collate_frames(loaded, config).inputs(network)
            features.append(network.encode_bev(network.encode_images(inputs), inputs))
        store.write(scene, features)
        if rank == 0 and done % 10 == 0:
            report(f"BEV features: {done}/{len(missing)} scenes of this process")
    return store
