"""Checkpoint of a training run: tensors in safetensors, everything else in JSON, replaced in one step."""

from __future__ import annotations

import shutil
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from pathlib import Path

import orjson
import torch
from pydantic import ConfigDict, TypeAdapter, ValidationError
from safetensors.torch import load_file, save_file
from torch import Tensor

from predmapnet.errors import UserError

CHECKPOINT_PREFIX = "frames-"
KEPT = 3
"""The newest checkpoints that stay; one may turn out to be from after something went wrong."""


@dataclass
class Position:
    """Progress of a run, as checkpoints keep it.

    Attributes:
        stage: name of the current stage.
        step: optimiser steps of this stage so far.
        fall: steps at which the learning rate begins and ends to fall; empty while that is open.
        frames: frames seen so far, in all stages and processes.
        seconds: wall time of this stage.
        total_seconds: wall time of the stages before.
        cpu_seconds: processor time of all processes and stages.
        validated: how many tenths of the stage have been validated.
        best: of the validations so far, by stage: mAP.
        finished: names of the stages that are complete.
        average_updates: of the moving average.
        metrics_bytes: size of the metrics file.
        data: what the stage sees.
    """

    __pydantic_config__ = ConfigDict(extra="forbid")

    stage: str = ""
    step: int = 0
    fall: list[int] = field(default_factory=list)
    frames: int = 0
    seconds: float = 0.0
    total_seconds: float = 0.0
    cpu_seconds: float = 0.0
    validated: int = 0
    best: dict[str, float] = field(default_factory=dict)
    finished: list[str] = field(default_factory=list)
    average_updates: int = 0
    metrics_bytes: int = 0
    data: str = ""

    def begin(self, stage: str) -> None:
        """Stand at the beginning of a stage."""
        self.total_seconds += self.seconds
        self.stage, self.step, self.validated, self.average_updates = stage, 0, 0, 0
        self.seconds, self.fall = 0.0, []


_POSITION = TypeAdapter(Position)


def partial_folder(folder: Path, position: Position) -> Path:
    """Return the folder in which the parts of a checkpoint are gathered; names count frames over all stages."""
    return folder / f".{CHECKPOINT_PREFIX}{position.frames:012d}.partial"


def publish(partial: Path, position: Position) -> Path:
    """Write the position, give a gathered checkpoint its name, and delete all but the newest ones."""
    (partial / "position.json").write_bytes(orjson.dumps(asdict(position), option=orjson.OPT_INDENT_2))
    target = partial.with_name(partial.name.removeprefix(".").removesuffix(".partial"))
    shutil.rmtree(target, ignore_errors=True)
    partial.rename(target)
    for old in sorted(partial.parent.glob(f"{CHECKPOINT_PREFIX}*"))[:-KEPT]:
        shutil.rmtree(old)
    return target


def latest(folder: Path) -> Path | None:
    """Return the newest complete checkpoint below ``folder``, or None."""
    return max(folder.glob(f"{CHECKPOINT_PREFIX}*"), default=None)


def to_resume(folder: Path) -> Path:
    """Return the newest complete checkpoint below ``folder``. Raises UserError if there is none."""
    newest = latest(folder)
    if newest is None:
        raise UserError(f"There is no checkpoint in {folder} to resume from. Start without --resume.")
    return newest


def read_position(checkpoint: Path) -> Position:
    """Read where a run stood. Raises UserError if that is damaged."""
    try:
        position = _POSITION.validate_json((checkpoint / "position.json").read_bytes())
    except (OSError, ValidationError) as error:
        raise UserError(f"The checkpoint {checkpoint} is damaged or of another version: {error}.") from None
    counts = (position.step, position.frames, position.validated, position.metrics_bytes, *position.fall)
    if min(counts) < 0 or not min(position.seconds, position.total_seconds, position.cpu_seconds) >= 0.0:
        raise UserError(f"The checkpoint {checkpoint} is damaged: its position.json counts below zero.")
    return position


def write_tensors(path: Path, tensors: Mapping[str, Tensor]) -> None:
    """Write a safetensors file; tensors that share memory are written apart."""
    save_file({name: value.detach().cpu().contiguous().clone() for name, value in tensors.items()}, path)


def read_tensors(checkpoint: Path, part: str) -> dict[str, Tensor]:
    """Read one part (``network``, ``rank-0``) of a checkpoint. Raises UserError if it is damaged."""
    try:
        return load_file(checkpoint / f"{part}.safetensors")
    except Exception as error:
        raise UserError(f"The checkpoint {checkpoint} is damaged: {part} cannot be read ({error}).") from None


@contextmanager
def misfit_told(checkpoint: Path) -> Iterator[None]:
    """Raise as UserErrors what goes wrong while tensors are put back that do not belong there."""
    try:
        yield
    except (KeyError, IndexError, TypeError, ValueError, RuntimeError) as error:
        raise UserError(f"The checkpoint {checkpoint} is damaged or of another network: {error}.") from None


def with_prefix(prefix: str, tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Put ``prefix.`` before every name."""
    return {f"{prefix}.{name}": value for name, value in tensors.items()}


def below_prefix(prefix: str, tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Return the tensors whose name starts with ``prefix.``, without it."""
    return {name[len(prefix) + 1 :]: value for name, value in tensors.items() if name.startswith(prefix + ".")}


def optimiser_tensors(optimiser: torch.optim.Optimizer) -> dict[str, Tensor]:
    """Name the optimiser's tensors by group, parameter and slot."""
    return {
        f"{group}.{index}.{slot}": value
        for group, parameters in enumerate(optimiser.param_groups)
        for index, parameter in enumerate(parameters["params"])
        for slot, value in optimiser.state.get(parameter, {}).items()
    }


def restore_optimiser(optimiser: torch.optim.Optimizer, tensors: Mapping[str, Tensor]) -> None:
    """Put back what :func:`optimiser_tensors` named."""
    for name, value in tensors.items():
        group, index, slot = name.split(".")
        parameter = optimiser.param_groups[int(group)]["params"][int(index)]
        like = parameter if value.shape == parameter.shape else value
        # The memory layout of the weight, so that sums run in the same order as without the interruption.
        optimiser.state[parameter][slot] = torch.empty_like(like).copy_(value)


def random_states(device: torch.device) -> dict[str, Tensor]:
    """Return the random states of this process."""
    states = {"random": torch.get_rng_state()}
    return states | ({"random_cuda": torch.cuda.get_rng_state(device)} if device.type == "cuda" else {})


def restore_random_states(tensors: Mapping[str, Tensor], device: torch.device) -> None:
    """Put back what :func:`random_states` returned."""
    torch.set_rng_state(tensors["random"])
    if device.type == "cuda":
        torch.cuda.set_rng_state(tensors["random_cuda"], device)
