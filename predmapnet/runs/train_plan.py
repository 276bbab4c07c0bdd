"""A plan as a table: what each stage does, and about how much memory and disk it takes. Nothing is trained."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import fields, is_dataclass, replace
from typing import Any

import numpy as np
import torch
from rich.table import Table
from torch import Tensor

from predmapnet.config import BevFormerConfig
from predmapnet.demo_world.rig import DEMO_RIG
from predmapnet.network.calibration import calibrate
from predmapnet.network.image_input import input_size
from predmapnet.network.predmapnet import PredMapNet
from predmapnet.network.state import FrameInputs
from predmapnet.training.features import feature_shapes
from predmapnet.training.loop import LoopSettings
from predmapnet.training.plan import PlannedStage
from predmapnet.training.run_checkpoint import KEPT
from predmapnet.training.settings import Stage

GIB = 2**30


def plan_table(plan: Sequence[PlannedStage], network: PredMapNet, frames: int, settings: LoopSettings) -> Table:
    """Return the plan of a run.

    Args:
        plan: its stages.
        network: that is going to be trained; its weights are gone afterwards.
        frames: to train on.
        settings: precision and memory.
    """
    table = Table(title=f"{network.config.name}, {frames} frames", title_justify="left")
    for name in ("stage", "epochs", "steps", "batch", "rate", "frozen", "memory", "disk"):
        table.add_column(name, overflow="fold")
    weights = sum(value.numel() * value.element_size() for value in network.state_dict().values())
    trainable = {each.stage.name: _trainable_bytes(network, each.stage) for each in plan}
    images, bev, decoded = _activations(network)
    if settings.low_precision:
        images, bev = images / 2, bev / 2
    for each in plan:
        stage = each.stage
        trained = sum(stage.trains_images(number, stage.frames) for number in range(stage.frames))
        kept = (decoded if stage.vectors else 0) * stage.frames
        encoded = images * trained + bev * stage.frames
        if settings.save_memory:
            encoded = max(images * (trained > 0), bev)
        if stage.data == "streams":
            encoded = 0
        states = trainable[stage.name] * 3 + weights * (2 if stage.optimiser.average_decay else 1)
        disk = KEPT * (states - trainable[stage.name])
        if stage.data == "streams":
            disk += frames * sum(2 * int(np.prod(shape)) for shape in feature_shapes(network))
        table.add_row(
            stage.name,
            f"{stage.epochs}" if each.minutes is None else f"{each.minutes:.0f} min",
            "by time" if each.steps is None else f"{each.steps}",
            f"{each.devices} x {each.parts} x {each.share} {stage.data}" + f" of {stage.frames}" * (stage.frames > 1),
            f"{each.rate:.3g}",
            ", ".join(part for part in stage.frozen if getattr(network, part) is not None) or "-",
            f"{(states + each.share * (encoded + kept)) / GIB:.1f} GiB",
            f"{disk / GIB:.1f} GiB",
        )
    return table


def _trainable_bytes(network: PredMapNet, stage: Stage) -> int:
    return sum(p.numel() * 4 for name, p in network.named_parameters() if name.split(".")[0] not in stage.frozen)


def _activations(network: PredMapNet) -> tuple[float, float, float]:
    """Bytes that images, BEV features and decoder keep of a frame for the backward pass; nothing is computed."""
    config, rig = network.config, DEMO_RIG
    if isinstance(config.bev, BevFormerConfig):
        names = config.bev.cameras
        rig = tuple(replace(DEMO_RIG[number % len(DEMO_RIG)], name=name) for number, name in enumerate(names))
    calibration = calibrate(rig, config)
    geometry = _without_values(network.view_geometry(calibration))
    network.to("meta").train()
    network.training = False  # Which cameras are there cannot be asked of tensors without values.
    shape = (1, len(rig), 3, *input_size(config.image))
    with torch.device("meta"):
        inputs = FrameInputs(
            torch.zeros(shape), torch.ones(shape[:2], dtype=torch.bool), torch.eye(4).double()[None], calibration
        )
        inputs = _without_values(inputs)
        with _counted() as of_images:
            images = network.encode_images(inputs)
        with _counted() as of_bev:
            bev = network.encode_bev(images, inputs, None, geometry)
        with _counted() as of_decoder:
            network.decode_bev(bev, inputs, network.initial_state(1))
    return of_images(), of_bev(), of_decoder()


@contextmanager
def _counted() -> Iterator[Callable[[], float]]:
    """Count the bytes of what a block keeps for the backward pass."""
    kept: dict[int, int] = {}

    def keep(value: Tensor) -> Tensor:
        if not isinstance(value, torch.nn.Parameter):
            storage = value.untyped_storage()
            kept[storage._cdata] = storage.nbytes()
        return value

    with torch.autograd.graph.saved_tensors_hooks(keep, lambda value: value):
        yield lambda: float(sum(kept.values()))


def _without_values(value: Any) -> Any:
    """Return a tensor, or all tensors of a dataclass or list, with their shapes only."""
    if isinstance(value, Tensor):
        return value.to("meta")
    if is_dataclass(value) and not isinstance(value, type):
        return replace(value, **{each.name: _without_values(getattr(value, each.name)) for each in fields(value)})
    return [_without_values(each) for each in value] if isinstance(value, list) else value
