"""Checkpoint of a training run: tensors in safetensors, everything else in JSON, replaced in one step."""

from __future__ import annotations

import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import orjson
import torch
from safetensors.torch import load_file, save_file
from torch import Tensor, nn

from predmapnet.errors import UserError

CHECKPOINT_PREFIX = "step-"
_SHOWN_NAMES = 4


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


def with_prefix(prefix: str, tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Put ``prefix.`` before every name."""
    return {f"{prefix}.{name}": value for name, value in tensors.items()}


def below_prefix(prefix: str, tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Return the tensors whose name starts with ``prefix.``, without it."""
    return {name[len(prefix) + 1 :]: value for name, value in tensors.items() if name.startswith(prefix + ".")}


def write_tensors(path: Path, tensors: Mapping[str, Tensor]) -> None:
    """Write a safetensors file; tensors that share memory are written apart."""
    save_file({name: value.detach().cpu().contiguous().clone() for name, value in tensors.items()}, path)


def partial_folder(folder: Path, order: int) -> Path:
    """Name of the folder in which the parts of a checkpoint are gathered; later ones have a larger ``order``."""
    return folder / f".{CHECKPOINT_PREFIX}{order:09d}.partial"


def prepare(folder: Path, order: int) -> None:
    """Make that folder, empty."""
    partial = partial_folder(folder, order)
    shutil.rmtree(partial, ignore_errors=True)
    partial.mkdir(parents=True)


def publish(partial: Path) -> Path:
    """Give a gathered checkpoint its name, then delete the older ones."""
    target = partial.with_name(partial.name.removeprefix(".").removesuffix(".partial"))
    shutil.rmtree(target, ignore_errors=True)
    partial.rename(target)
    for older in partial.parent.glob(f"{CHECKPOINT_PREFIX}*"):
        if older != target:
            shutil.rmtree(older)
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


def write_json(path: Path, value: Mapping[str, Any]) -> None:
    """Write JSON, readable by a person."""
    path.write_bytes(orjson.dumps(value, option=orjson.OPT_INDENT_2))


def read(checkpoint: Path, part: str) -> dict[str, Tensor]:
    """Read one part (``network``, ``streams-0``) of a checkpoint. Raises UserError if it is damaged."""
    try:
        return load_file(checkpoint / f"{part}.safetensors")
    except Exception as error:
        raise UserError(f"The checkpoint {checkpoint} is damaged: {part} cannot be read ({error}).") from None


def read_json(path: Path) -> dict[str, Any]:
    """Read a JSON object. Raises UserError if it is damaged."""
    try:
        value: dict[str, Any] = orjson.loads(path.read_bytes())
    except (OSError, orjson.JSONDecodeError) as error:
        raise UserError(f"{path} cannot be read: {error}.") from None
    return value


def check_fit(network: nn.Module, tensors: Mapping[str, Tensor], where: Path) -> list[str]:
    """Compare weights with the network that they are for; only names and shapes are looked at.

    Args:
        network: of any device, ``meta`` included.
        tensors: a state dict.
        where: its file, for the message.

    Returns:
        Names of the network that the state dict does not have.

    Raises:
        UserError: the file has what the network has not, or in another shape.
    """
    own = network.state_dict()
    faults = [
        name if name not in own else f"{name} {tuple(tensor.shape)} instead of {tuple(own[name].shape)}"
        for name, tensor in tensors.items()
        if name not in own or own[name].shape != tensor.shape
    ]
    if faults:
        raise UserError(
            f"The weights in {where} do not fit the network that is to be trained ({_some(faults)}). "
            "Choose the --preset that they were made with, or one with more modules on the same baseline."
        )
    return [name for name in own if name not in tensors]


def start_from(network: nn.Module, tensors: Mapping[str, Tensor], where: Path) -> list[str]:
    """Begin a training run with the weights of a network that may have fewer modules switched on.

    Args:
        network: to be trained.
        tensors: the state dict to begin with.
        where: its file, for the message.

    Returns:
        Names that the file does not fill: they keep their random beginning.

    Raises:
        UserError: the file has what the network has not, or in another shape.
    """
    fresh = check_fit(network, tensors, where)
    network.load_state_dict(dict(tensors), strict=False)
    return fresh


def load_weights(network: nn.Module, tensors: Mapping[str, Tensor], where: Path) -> None:
    """Load a whole state dict; a mismatch (another preset or version) is the user's error."""
    if absent := check_fit(network, tensors, where):
        raise UserError(f"The weights in {where} lack some of this network ({_some(absent)}): choose their --preset.")
    network.load_state_dict(dict(tensors))


def _some(names: list[str]) -> str:
    return f"{len(names)} tensors: {', '.join(names[:_SHOWN_NAMES])}{' ...' if len(names) > _SHOWN_NAMES else ''}"
