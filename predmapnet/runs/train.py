"""A training run from its options to its weights: data, processes, stages, export."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path

import torch
from lightning_fabric import Fabric
from rich.table import Table

from predmapnet.config import PredMapNetConfig
from predmapnet.errors import UserError
from predmapnet.frame_cache.fill_cache import expected_bytes
from predmapnet.frame_cache.prepare import DataOptions, PreparedData, count_frames, prepare_data
from predmapnet.network.predmapnet import PredMapNet
from predmapnet.runs.train_plan import plan_table
from predmapnet.scenes import Report
from predmapnet.training import run_checkpoint
from predmapnet.training.features import fill_features
from predmapnet.training.loop import LoopSettings, Trainer
from predmapnet.training.plan import PlanOptions, plan_stages
from predmapnet.training.processes import by_torchrun, check_devices, in_processes, leads
from predmapnet.training.settings import Stage, choose_stages
from predmapnet.training.stage_data import StageData
from predmapnet.training.validation import validate
from predmapnet.weights.checkpoint import load_checkpoint, save_checkpoint
from predmapnet.weights.files import weights_hash
from predmapnet.weights.fit import check_fit, load_weights, start_from
from predmapnet.weights.inspection import parts_of

WEIGHTS = "weights.safetensors"


@dataclass(frozen=True)
class RunOptions:
    """A run as a user chooses it.

    Attributes:
        config: of the network.
        data: what it learns from.
        folder: where checkpoints, metrics and weights go.
        stage: name of one, or ``all``.
        plan: sizes.
        loop: precision, memory, seed.
        device: ``cpu`` or ``cuda``.
        threads: of each process.
        workers: processes that load images, for each training process.
        resume: go on from the newest checkpoint in ``folder``.
        initial: weights to start from, or None.
    """

    config: PredMapNetConfig
    data: DataOptions
    folder: Path
    stage: str = "all"
    plan: PlanOptions = field(default_factory=PlanOptions)
    loop: LoopSettings = field(default_factory=LoopSettings)
    device: str = "cpu"
    threads: int = 1
    workers: int = 0
    resume: bool = False
    initial: Path | None = None


def train_network(options: RunOptions, report: Report = print) -> Path | None:
    """Prepare the data, train, and write the weights.

    Returns:
        The weights file, or None if the run was interrupted (it can be resumed).

    Raises:
        UserError: data, checkpoint, weights or devices do not fit.
    """
    _check_folder(options)
    _check_weights(options)
    devices, data = options.plan.devices, None
    if not by_torchrun():
        check_devices(options.device, devices)
        data = prepare_data(options.data, options.config, devices, report)
    finished = in_processes(devices, options.device, run_stages, options, data, report)
    return export(options) if finished and leads() else None


def dry_run(options: RunOptions) -> Table:
    """Return the plan of a run as a table; nothing is trained or made. Raises UserError where it cannot be."""
    frames, images = count_frames(options.data, options.config)
    plan = plan_stages(choose_stages(options.config, options.stage), frames, options.plan)
    table = plan_table(plan, PredMapNet(options.config), frames, options.loop)
    size = expected_bytes(images, options.config) / 1e9
    table.caption = f"The cache of {images} images in {options.data.cache} takes about {size:.1f} GB."
    return table


def run_stages(fabric: Fabric, options: RunOptions, data: PreparedData | None, report: Report) -> bool:
    """Run all stages in one process; return whether they were finished."""
    torch.set_num_threads(options.threads)
    report = report if fabric.is_global_zero else (lambda _line: None)
    if data is None:
        with fabric.rank_zero_first(local=True):
            data = prepare_data(options.data, options.config, options.threads, report)
    scenes, validation = data
    torch.manual_seed(options.loop.seed)
    network = PredMapNet(options.config)
    if options.initial is not None and not options.resume:
        initial = load_checkpoint(options.initial).network.state_dict()
        if fresh := start_from(network, initial, options.initial):
            report(f"Not in {options.initial.name}, so begun at random: {', '.join(parts_of(fresh))}.")
    trainer = Trainer(fabric, network, options.folder, options.loop, report)
    if options.resume:
        trainer.resume()
    stages = choose_stages(options.config, options.stage)
    if all(stage.name in trainer.position.finished for stage in stages):
        report(f"Nothing to train: all stages of {options.folder} were finished before.")
    frames = round(sum(len(scene) * weight for scene, weight in zip(scenes.scenes, scenes.weights, strict=True)))

    def measure(measured: PredMapNet, stage: Stage) -> dict[str, float]:
        return validate(measured, validation, stage.data != "frames") if stage.vectors and validation else {}

    rank, size, seed = fabric.global_rank, fabric.world_size, options.loop.seed
    for planned in plan_stages(stages, frames, replace(options.plan, devices=size)):
        if planned.stage.name in trainer.position.finished:
            continue
        store, seen = None, scenes.digest
        if planned.stage.data == "streams":
            seen += f" {planned.batch} {size}"
            store = fill_features(trainer.result.to(fabric.device), scenes, options.folder, rank, size, report)
            fabric.barrier()
        if trainer.position.stage == planned.stage.name and trainer.position.data not in ("", seen):
            raise UserError(
                f"Stage {planned.stage.name} of {options.folder} has begun with other data. Go on with the same "
                "--data, --towns and, in streams, --batch and --devices, or begin another run with --init."
            )
        trainer.position.data = seen
        if not trainer.run(planned, StageData(planned, scenes, seed, rank, size, options.workers, store), measure):
            return False
    return True


def export(options: RunOptions) -> Path:
    """Write the weights of the newest checkpoint of a run, averaged where they are, as a file of their own.

    Raises:
        UserError: there is no checkpoint.
    """
    newest = run_checkpoint.to_resume(options.folder)
    network, tensors = PredMapNet(options.config), run_checkpoint.read_tensors(newest, "network")
    weights = run_checkpoint.below_prefix("average", tensors) or run_checkpoint.below_prefix("network", tensors)
    load_weights(network, weights, newest)
    position = run_checkpoint.read_position(newest)
    facts = {name: getattr(position, name) for name in ("frames", "finished", "cpu_seconds", "best")}
    facts |= {"data": str(options.data), "towns": options.data.towns, "seed": options.loop.seed}
    if options.initial is not None:
        facts["initial_sha256"] = weights_hash(options.initial)
    path = options.folder / WEIGHTS
    save_checkpoint(path, network, facts)
    return path


def _check_folder(options: RunOptions) -> None:
    """Refuse to mix runs, and to train tracks on a network that sees nothing."""
    started = run_checkpoint.latest(options.folder) is not None
    if started and not options.resume:
        raise UserError(f"{options.folder} holds a run already. Go on with --resume, or choose another --out.")
    first, usual = (choose_stages(options.config, name)[0].name for name in (options.stage, "all"))
    if not (first == usual or options.resume or options.initial):
        raise UserError(f"Stage {first} needs a network that sees: give --resume or --init WEIGHTS.")


def _check_weights(options: RunOptions) -> None:
    """Refuse weights to begin with that are not there or do not fit, before anything is rendered."""
    if options.resume:
        where = run_checkpoint.to_resume(options.folder)
        tensors = run_checkpoint.below_prefix("network", run_checkpoint.read_tensors(where, "network"))
    elif options.initial is not None:
        where, tensors = options.initial, load_checkpoint(options.initial).network.state_dict()
    else:
        return
    with torch.device("meta"):
        check_fit(PredMapNet(options.config), tensors, where)
