"""Three steps of every stage on painted scenes: their weighted losses, to be compared with recorded ones.

After a change of the network that is meant to change them: ``python -m tests.predmapnet.training.recorded_losses``.
"""

from __future__ import annotations

import json
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from predmapnet.augmentation.frames import load_frame
from predmapnet.frame_cache.scene_cache import TrainingScenes
from predmapnet.network.calibration import Calibration, collate_calibrations
from predmapnet.network.predmapnet import PredMapNet
from predmapnet.scenes import FrameTruth
from predmapnet.training.data.batches import Batch, StreamSegment
from predmapnet.training.data.targets import truth_targets
from predmapnet.training.instants import StageTraining
from predmapnet.training.settings import choose_stages
from tests.predmapnet.training.painted_scenes import painted_scenes, tiny_config
from tests.predmapnet.training.paper_clips import PlainBackbone
from tests.predmapnet.training.tiny_clips import tiny_paper_config

RECORD = Path(__file__).with_name("recorded_losses.json")
STEPS, STREAMS, FRAMES = 3, 2, 10
GRID = (100, 200)
STAGES = ("single", "temporal", "bev", "warmup", "joint")


def tiny_network(name: str) -> PredMapNet:
    """A network without dropout whose first scores are high enough for tracks."""
    config = tiny_config() if name in ("single", "temporal") else tiny_paper_config()
    if name not in ("single", "temporal"):
        calm = {"bev": {**config.bev.model_dump(), "dropout": 0.0}}
        calm["decoder"] = {**config.decoder.model_dump(), "dropout": 0.0}
        config = type(config).model_validate(config.model_dump() | calm)
    torch.manual_seed(0)
    network = PredMapNet(config)
    if name not in ("single", "temporal"):
        network.image_backbone = PlainBackbone(config.bev.width)
        torch.nn.init.constant_(network.map_decoder.classify.bias, 0.0)
    with torch.no_grad():
        for parameter in network.parameters():
            if not parameter.any():
                parameter.normal_(0, 0.02)  # Branches that start as zero hide what they compute.
    return network.train()


def batch_of(scenes: TrainingScenes, frames: list[tuple[int, int]], mirrored: bool = False) -> Batch:
    """Frames of some scenes as they are stored."""
    config = tiny_config()
    loaded = [load_frame(scenes, scene, frame, mirrored) for scene, frame in frames]
    generator = torch.Generator().manual_seed(frames[0][1])
    images = torch.from_numpy(np.stack([frame.images for frame in loaded]))
    cells = (len(frames), images.shape[1], images.shape[2] // 8, images.shape[3] // 8)
    return Batch(
        images=images,
        camera_valid=torch.ones(images.shape[:2], dtype=torch.bool),
        ego_to_global=torch.from_numpy(np.stack([frame.ego_to_global for frame in loaded])),
        calibration=collate_calibrations([frame.calibration for frame in loaded]),
        targets=truth_targets([frame.truth for frame in loaded], config.roi, 20, GRID),
        depth=torch.randint(-1, 68, cells, generator=generator),
    )


@torch.no_grad()
def segment_of(network: PredMapNet, scenes: TrainingScenes, step: int, fresh: list[bool]) -> StreamSegment:
    """The next two frames of two streams, with the features of the untrained network."""
    instants = [batch_of(scenes, [(s, 2 * step + offset) for s in range(STREAMS)]) for offset in (0, 1)]
    features = []
    network.eval()
    for instant in instants:
        inputs = instant.inputs(network)
        features.append(network.encode_bev(network.encode_images(inputs), inputs))
        instant.images, instant.calibration = torch.zeros(STREAMS, 0, 0, 0, 3), Calibration.empty(STREAMS)
        instant.camera_valid = torch.zeros(STREAMS, 0, dtype=torch.bool)
    network.train()
    truths: list[FrameTruth] = [scenes.scenes[s].frame(2 * step + 2, images=False).truth for s in range(STREAMS)]
    after = truth_targets(truths, network.config.roi, 20, None)
    return StreamSegment(instants, features, torch.tensor(fresh), after)


def record(name: str, folder: Path) -> list[dict[str, float]]:
    """Return the weighted losses of the steps of one stage."""
    network = tiny_network(name)
    scenes = painted_scenes(folder, FRAMES, network.config)
    (stage,) = choose_stages(network.config, name)
    if name == "single":
        batches = [StreamSegment([batch_of(scenes, [(0, at), (1, at + 3)], at % 2 == 1)]) for at in range(STEPS)]
    elif name == "temporal":
        assert stage.tracks is not None
        stage = replace(stage, tracks=replace(stage.tracks, score=0.03))
        batches = [segment_of(network, scenes, step, [step == 0, step != 1]) for step in range(STEPS)]
    else:
        clips = [[batch_of(scenes, [(0, step + i), (1, step + 3 + i)]) for i in range(3)] for step in range(STEPS)]
        batches = [StreamSegment(clip) for clip in clips]
    training = StageTraining(network, stage, (0, 0, 2 if name == "temporal" else 3))
    optimiser = torch.optim.SGD([p for p in network.parameters() if p.requires_grad], lr=1e-2)
    lines = []
    for step, batch in enumerate(batches):
        at = 500 * (step > 1) + step if name == "warmup" else step
        terms = training(batch, at)
        optimiser.zero_grad()
        torch.stack(list(terms.values())).sum().backward()
        torch.nn.utils.clip_grad_norm_(network.parameters(), 1.0)
        optimiser.step()
        lines.append({term: float(value.detach()) for term, value in sorted(terms.items())})
    return lines


def main() -> None:
    torch.set_num_threads(1)
    found = {}
    for name in STAGES:
        with tempfile.TemporaryDirectory() as folder:
            found[name] = record(name, Path(folder))
    RECORD.write_text(json.dumps(found, indent=1) + "\n")


if __name__ == "__main__":
    main()
