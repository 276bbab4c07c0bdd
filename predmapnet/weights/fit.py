"""Weights and the network that they are to be put into: what fits, what is missing, what has another shape."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from torch import Tensor, nn

from predmapnet.errors import UserError

_SHOWN_NAMES = 4


def is_finite(tensor: Tensor) -> bool:
    """Whether no number of a tensor is NaN or infinite."""
    return bool(tensor.float().isfinite().all()) if tensor.is_floating_point() else True


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
    """Load weights of a network that may have fewer modules; return the names that keep their random beginning.

    Raises:
        UserError: the file ``where`` has what the network has not, or in another shape.
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
