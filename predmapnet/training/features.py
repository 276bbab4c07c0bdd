"""BEV features of all frames, computed once by the parts of the network that a stage of streams leaves as they are."""

from __future__ import annotations

from hashlib import sha256
from pathlib import Path

import torch

from predmapnet.config import LookupBevConfig
from predmapnet.errors import UserError
from predmapnet.network.predmapnet import PredMapNet
from predmapnet.scenes import Report
from predmapnet.training.data.batches import collate_frames
from predmapnet.training.data.draws import TrainingScenes
from predmapnet.training.data.streams import FeatureStore

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
            loaded = [scenes.load(scene, frame, store.mirrored(scene)) for frame in numbers]
            inputs = collate_frames(loaded, config).inputs(network)
            features.append(network.encode_bev(network.encode_images(inputs), inputs))
        store.write(scene, features)
        if rank == 0 and done % 10 == 0:
            report(f"BEV features: {done}/{len(missing)} scenes of this process")
    return store
