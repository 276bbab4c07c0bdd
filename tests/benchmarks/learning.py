"""Whether the training loop learns: ``python -m tests.benchmarks.learning drives|frame|paper [--steps N]``.

``drives``
    One run of ``lite`` over data that are as different as they get: two demo towns with different cars, an Argoverse 2
    log in its own layout with its seven cameras (drawn by the renderer), and the real street, read as anybody's log.
    Streams grow while the temporal stage runs, and long ones are harder; so its losses are measured on the same
    streams of full length, before and after.
``frame``
    ``lite``, from the shipped weights and without augmentation, on a single frame of the real street, until it knows it
    by heart: chamfer AP at 1.5 m of the classes in the frame.
``paper``
    ``paper-nuscenes`` with small images, its last stage with all losses, on one clip of a demo town.

Prints each loss, mean of the first and of the last tenth of the steps in which there is one (temporal: before, after).
What is learned is thrown away. Reads ``$PREDMAPNET_REFERENCE``.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import islice, repeat
from pathlib import Path

import numpy as np
import orjson
import torch
from lightning_fabric import Fabric

from predmapnet.demo_world.catalogue import default_cache
from predmapnet.errors import UserError
from predmapnet.evaluation.chamfer_ap import chamfer_average_precision
from predmapnet.evaluation.frames import EvaluationFrame
from predmapnet.frame_cache.prepare import DataOptions, DataSet, prepare_data
from predmapnet.frame_cache.scene_cache import CachedScene, TrainingScenes
from predmapnet.network.predmapnet import PredMapNet
from predmapnet.presets import preset
from predmapnet.runs.train import RunOptions, train_network
from predmapnet.training.data.batches import StreamSegment, collate_frames
from predmapnet.training.features import fill_features
from predmapnet.training.instants import StageTraining
from predmapnet.training.loop import LoopSettings, Trainer
from predmapnet.training.plan import PlanOptions, plan_stages
from predmapnet.training.settings import LITE_STAGES, NUSCENES_STAGES
from predmapnet.training.stage_data import StageData
from predmapnet.training.validation import map_frames
from predmapnet.weights.checkpoint import load_checkpoint
from predmapnet.weights.files import SHIPPED
from tests.benchmarks.real_roads import reference_folder
from tests.real_roads.argoverse_folder import write_with_images

OWN_CAMERAS = "7fab2350-7eaf-3b7e-a39d-6937a4c1bede"
"""The log of the reference data whose calibration is there."""
LOG_FRAMES, LOG_SCALE = 12, 0.25
STREET_FRAME = 12
"""At 2 Hz; the car drives by then."""
FULL_STREAMS = 40
"""Steps over which losses on full streams are measured; those count in which all streams have begun."""
SMALL_IMAGES = (160, 96)
OFTEN = LoopSettings(log_steps=1, checkpoint_minutes=1e6)
NOT_LOSSES = ("lr", "norm", "seconds", "cpu_seconds", "seconds_per_step", "frames", "step", "stage")
Say = Callable[[str], None]


class Repeated(StageData):
    """The same segment at every step."""

    def __init__(self, segment: StreamSegment) -> None:
        self.segment = segment

    def segments(self, _first: int) -> Iterator[StreamSegment]:
        return repeat(self.segment)

    def name(self, _number: int) -> str:
        return "the one segment"


def learned(lines: Sequence[Mapping[str, float]]) -> dict[str, tuple[float, float]]:
    """Return each loss at the beginning and at the end of a stage; where it is zero there was nothing to learn from."""
    names = dict.fromkeys(name for line in lines for name in line if name not in NOT_LOSSES)
    found = {}
    for name in names:
        values = [line[name] for line in lines if line.get(name, 0.0) > 0]
        tenth = max(1, len(values) // 10)
        if values:
            found[name] = float(np.mean(values[:tenth])), float(np.mean(values[-tenth:]))
    return found


def tell(folder: Path, say: Say) -> bool:
    """Say what each loss of a run was and has become; return whether all have fallen."""
    lines = [orjson.loads(line) for line in (folder / "metrics.jsonl").read_bytes().splitlines()]
    fell = True
    for stage in dict.fromkeys(line["stage"] for line in lines):
        own = [line for line in lines if line["stage"] == stage]
        fell &= told(f"{stage}, {len(own)} steps", "first tenth", "last tenth", learned(own), say)
    return fell


def told(title: str, first: str, last: str, losses: Mapping[str, tuple[float, float]], say: Say) -> bool:
    """Say what each loss was and has become; return whether all have fallen."""
    say(f"{title:26}{first:>12}{last:>12}")
    for name, (before, after) in losses.items():
        say(f"  {name:24}{before:12.4f}{after:12.4f}{'' if after < before else '   NOT FALLEN'}")
    return all(after < before for before, after in losses.values())


@torch.no_grad()
def on_full_streams(network: PredMapNet, scenes: TrainingScenes, folder: Path) -> dict[str, float]:
    """Mean losses of the temporal stage on the same streams of full length, whatever the network."""
    stage = LITE_STAGES[1]
    (planned,) = plan_stages([stage], sum(map(len, scenes.scenes)), PlanOptions())
    store = fill_features(network, scenes, folder, 0, 1, lambda _line: None)
    data = StageData(planned, scenes, seed=0, store=store)
    training = StageTraining(network.train(), stage)
    torch.manual_seed(0)
    lines = []
    for step, segment in enumerate(islice(data.segments(stage.growth_steps), FULL_STREAMS)):
        terms = training(segment, step)
        if step >= stage.longest // stage.frames:  # All streams have begun by then.
            lines.append({name: float(term) for name, term in terms.items()})
    return {name: float(np.mean([line[name] for line in lines if line[name] > 0])) for name in lines[0]}


def drives(folder: Path, steps: int, say: Say) -> bool:
    """Train ``lite`` from the shipped weights on all kinds of drives."""
    street, logs = reference_folder() / "real_street", reference_folder() / "ground_truth" / "av2" / "logs"
    write_with_images(logs / OWN_CAMERAS, folder / "av2", LOG_FRAMES, LOG_SCALE)
    sets = (DataSet("demo"), DataSet("argoverse2", folder / "av2"), DataSet("log", street))
    data = DataOptions(sets, default_cache() / "training", towns=2, validation=0)
    plan = PlanOptions(steps=steps, learning_rate=3e-4)  # It begins with weights that know something.
    single = RunOptions(preset("lite"), data, folder / "single", "single", plan, OFTEN, initial=SHIPPED)
    seen = train_network(single, lambda line: None)
    fell = tell(single.folder, say)
    after = train_network(replace(single, folder=folder / "run", stage="temporal", initial=seen), lambda line: None)
    assert seen is not None and after is not None, "nobody interrupts"
    scenes = prepare_data(data, preset("lite"), 1, lambda _line: None)[0]
    began, ended = (on_full_streams(load_checkpoint(path).network, scenes, folder / "run") for path in (seen, after))
    losses = {name: (value, ended[name]) for name, value in began.items()}
    return told(f"temporal, {steps} steps", "before", "after", losses, say) and fell


def frame(folder: Path, steps: int, say: Say) -> bool:
    """Let ``lite`` learn one real frame by heart; return whether it finds all of it within 1.5 m."""
    network, config = load_checkpoint(None).network, preset("lite")
    street = DataOptions((DataSet("log", reference_folder() / "real_street"),), folder / "cache")
    scene = prepare_data(street, config, 1, lambda _line: None)[0].scenes[0]
    seen = scene.frame(STREET_FRAME)
    say(f"before: {ap_of(network, scene)}")
    stage = replace(LITE_STAGES[0], optimiser=replace(LITE_STAGES[0].optimiser, average_decay=0.0, warmup_steps=20))
    (planned,) = plan_stages([stage], 1, PlanOptions(batch=1, steps=steps, learning_rate=5e-4))
    trainer = Trainer(Fabric(accelerator="cpu", devices=1), network, folder / "run", OFTEN, lambda _line: None)
    trainer.run(planned, Repeated(StreamSegment([collate_frames([seen], config)])), lambda *_: {})
    fell, found = tell(folder / "run", say), ap_of(network, scene)
    say(f"after: {found}")
    return fell and all(precision == 1.0 for precision in found.values())


def ap_of(network: PredMapNet, scene: CachedScene) -> dict[str, float]:
    """Chamfer AP at 1.5 m of the classes that the frame holds."""
    network.eval()
    (predicted,) = map_frames(network, scene, [STREET_FRAME], streaming=False)
    truth = scene.frame(STREET_FRAME, images=False).truth
    result = chamfer_average_precision([EvaluationFrame(scene.name, STREET_FRAME, predicted, truth)])
    return {
        of_kind.kind.label: curve.average_precision
        for of_kind in result.kinds
        for curve in of_kind.curves
        if curve.threshold == 1.5 and int(of_kind.kind) in truth.kinds
    }


def paper(folder: Path, steps: int, say: Say) -> bool:
    """Train the last stage of the paper's network on one clip, with images of another size."""
    config = preset("paper-nuscenes")
    width, height = SMALL_IMAGES
    config = config.model_copy(update={"image": config.image.model_copy(update={"width": width, "height": height})})
    town = DataOptions((DataSet("demo"),), default_cache() / "training", towns=1, validation=0)
    (scene,) = prepare_data(town, config, 1, lambda _line: None)[0].scenes
    clip = StreamSegment([collate_frames([scene.frame(number)], config) for number in (4, 6)])
    torch.manual_seed(0)
    network = PredMapNet(config)
    torch.nn.init.zeros_(network.map_decoder.get_parameter("classify.bias"))  # Tracks from the first step on.
    stage = replace(NUSCENES_STAGES[2], frames=len(clip.instants))
    stage = replace(stage, optimiser=replace(stage.optimiser, warmup_steps=max(1, steps // 5)), memory_from_step=0)
    (planned,) = plan_stages([stage], 1, PlanOptions(batch=1, steps=steps))
    trainer = Trainer(Fabric(accelerator="cpu", devices=1), network, folder / "run", OFTEN, say)
    trainer.run(planned, Repeated(clip), lambda *_: {})
    return tell(folder / "run", say)


PARTS: dict[str, tuple[Callable[[Path, int, Say], bool], int]] = {
    "drives": (drives, 200),
    "frame": (frame, 300),
    "paper": (paper, 50),
}
"""What there is, and its usual number of steps."""


def main(arguments: list[str] | None = None) -> int:
    """Print the tables. Returns 1 if something has not been learned."""
    parser = argparse.ArgumentParser(prog="python -m tests.benchmarks.learning", description=__doc__.splitlines()[0])
    parser.add_argument("part", choices=list(PARTS))
    parser.add_argument("--steps", type=int, help="of each stage")
    options = parser.parse_args(arguments)
    run, usual = PARTS[options.part]
    torch.set_num_threads(1)
    try:
        with tempfile.TemporaryDirectory() as folder:
            fell = run(Path(folder), options.steps or usual, lambda line: print(line, flush=True))
    except UserError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    return 0 if fell else 1


if __name__ == "__main__":
    sys.exit(main())
