"""A training run from its options to its weights: data, processes, stages, export."""

from __future__ import annotations

import multiprocessing
import os
from dataclasses import dataclass, replace
from pathlib import Path

import torch

from predmapnet.config import PredMapNetConfig
from predmapnet.errors import UserError
from predmapnet.machine import end_with_parent
from predmapnet.network.predmapnet import PredMapNet
from predmapnet.presets import load_config
from predmapnet.training import run_checkpoint
from predmapnet.training.clips import ClipTraining
from predmapnet.training.data.draws import TrainingScenes
from predmapnet.training.data.prepare import DataOptions, prepare_data
from predmapnet.training.data.scene_cache import CachedScene
from predmapnet.training.loop import Trainer
from predmapnet.training.process_group import ProcessGroup
from predmapnet.training.settings import CLIP_STAGES, Report, TrainingSettings
from predmapnet.training.single_frame import SingleFrameStage
from predmapnet.training.temporal import TemporalStage
from predmapnet.training.validation import validate
from predmapnet.weights.checkpoint import load_checkpoint, save_checkpoint
from predmapnet.weights.files import weights_hash
from predmapnet.weights.inspection import parts_of

WEIGHTS = "weights.safetensors"
Data = tuple[TrainingScenes, list[CachedScene]]
"""What is trained on, and what is validated on."""


@dataclass(frozen=True)
class RunOptions:
    """What a user chooses.

    Attributes:
        config: of the network.
        data: what it learns from.
        folder: where checkpoints, metrics and weights go.
        processes: training processes that share every step.
        threads: of each process.
        settings: how it trains.
        resume: go on from the newest checkpoint in ``folder``.
        initial: weights to start from, or None.
        device: where the network is trained, as torch names it.
    """

    config: PredMapNetConfig
    data: DataOptions
    folder: Path
    processes: int
    threads: int
    settings: TrainingSettings
    resume: bool = False
    initial: Path | None = None
    device: str = "cpu"


def train_network(options: RunOptions, report: Report = print) -> Path | None:
    """Prepare the data, train, and write the averaged weights.

    Returns:
        The weights file, or None if the run was interrupted (it can be resumed).

    Raises:
        UserError: data, checkpoint or weights do not fit.
    """
    _check_device(options)
    _check_folder(options)
    _check_beginning(options)
    data = prepare_data(options.data, options.config, options.processes, report)
    meeting_point = options.folder / f".meeting-{os.getpid()}"
    options.folder.mkdir(parents=True, exist_ok=True)
    meeting_point.unlink(missing_ok=True)
    context = multiprocessing.get_context("spawn")
    others = [
        context.Process(target=_other_process, args=(options, data, rank, meeting_point), daemon=True)
        for rank in range(1, options.processes)
    ]
    for process in others:
        process.start()
    try:
        finished = _train_process(options, data, ProcessGroup(0, options.processes), meeting_point, report)
        for process in others:
            process.join()
    finally:
        meeting_point.unlink(missing_ok=True)
    return export(options) if finished else None


def export(options: RunOptions) -> Path:
    """Write the averaged weights of the newest checkpoint of a run as a file of their own.

    Raises:
        UserError: there is no checkpoint.
    """
    newest = run_checkpoint.latest(options.folder)
    if newest is None:
        raise UserError(f"There is no checkpoint in {options.folder}.")
    network = PredMapNet(options.config)
    average = run_checkpoint.below_prefix("average", run_checkpoint.read(newest, "network"))
    run_checkpoint.load_weights(network, average, newest)
    position = run_checkpoint.read_json(newest / "position.json")
    facts = {name: position[name] for name in ("frames", "finished", "cpu_seconds")}
    facts |= {"data": str(options.data), "towns": options.data.towns, "seed": options.settings.seed}
    if options.initial is not None:
        facts["initial_sha256"] = weights_hash(options.initial)
    path = options.folder / WEIGHTS
    save_checkpoint(path, network, facts)
    return path


def _other_process(options: RunOptions, data: Data, rank: int, meeting_point: Path) -> None:
    """Body of every process but the first; it says nothing."""
    end_with_parent()
    _train_process(options, data, ProcessGroup(rank, options.processes), meeting_point, lambda _line: None)


def _train_process(
    options: RunOptions, data: Data, processes: ProcessGroup, meeting_point: Path, report: Report
) -> bool:
    """Run all stages in one process; return whether they were finished."""
    torch.set_num_threads(options.threads)
    processes.join(meeting_point)
    try:
        return _run_stages(options, data, processes, report)
    finally:
        processes.leave()


def _run_stages(options: RunOptions, data: Data, processes: ProcessGroup, report: Report) -> bool:
    settings = options.settings
    torch.manual_seed(settings.seed)
    network = PredMapNet(options.config)
    if options.initial is not None and not options.resume:
        initial = load_checkpoint(options.initial).network.state_dict()
        if fresh := run_checkpoint.start_from(network, initial, options.initial):
            report(f"Not in {options.initial.name}, so begun at random: {', '.join(parts_of(fresh))}.")
    network.to(options.device)
    trainer = Trainer(network, settings, options.folder, processes, report)
    if options.resume:
        trainer.resume()
    scenes, validation = data

    def measure(average: PredMapNet, stage: str) -> dict[str, float]:
        return validate(average, validation, streaming=stage != SingleFrameStage.name)

    for clip_stage, budget in settings.clip_stages:
        clips = ClipTraining(clip_stage, network, scenes, settings, processes)
        optimiser = replace(settings.clip_optimiser, rates=clip_stage.rates, final_fraction=clip_stage.final_rate)
        if not trainer.run(clips, budget, optimiser, measure if clip_stage.vectors else _no_measure):
            return False
    if settings.single is not None:
        single = SingleFrameStage(network, scenes, settings, processes)
        if not trainer.run(single, settings.single, settings.optimiser, measure):
            return False
    if settings.temporal is not None:
        temporal = TemporalStage(network, scenes, settings, options.folder, processes, report)
        return trainer.run(temporal, settings.temporal, settings.temporal_optimiser, measure)
    return True


def _no_measure(_average: PredMapNet, _stage: str) -> dict[str, float]:
    """A network that has not learned polylines yet is not measured."""
    return {}


def _check_device(options: RunOptions) -> None:
    """Refuse a device that is not there, or that several processes would have to share."""
    if options.device.startswith("cuda") and not torch.cuda.is_available():
        raise UserError(f"There is no device {options.device} here, or this torch was built without CUDA.")
    if options.device != "cpu" and options.processes > 1:
        raise UserError(f"Training on {options.device} takes one process: give --processes 1.")


def _check_folder(options: RunOptions) -> None:
    """Refuse to mix runs, and to train tracks on a network that sees nothing."""
    started = run_checkpoint.latest(options.folder) is not None
    if started and not options.resume:
        raise UserError(f"{options.folder} holds a run already. Go on with --resume, or choose another --out.")
    clips = options.settings.clip_stages
    if clips and (clips[0][0] is CLIP_STAGES[0] or options.resume or options.initial):
        return
    if clips:
        raise UserError(f"Stage {clips[0][0].name} needs a network that sees: give --resume or --init weights.")
    if options.settings.single is None and not (options.resume or options.initial):
        raise UserError("The temporal stage needs a network that sees: give --resume or --init weights.safetensors.")


def _check_beginning(options: RunOptions) -> None:
    """Refuse weights to begin with that are not there or do not fit, before anything is rendered."""
    if not options.resume and options.initial is None:
        return
    with torch.device("meta"):
        network = PredMapNet(options.config)
    if options.resume:
        newest = run_checkpoint.to_resume(options.folder)
        run_checkpoint.check_fit(
            network, run_checkpoint.below_prefix("network", run_checkpoint.read(newest, "network")), newest
        )
    elif options.initial is not None:
        run_checkpoint.check_fit(network, load_checkpoint(options.initial).network.state_dict(), options.initial)


def configuration(preset: str) -> PredMapNetConfig:
    """Return a preset, or the configuration in a JSON file. Raises UserError."""
    return load_config(preset)
