"""Checkpoints as safetensors files: weights, configuration and facts about the training.

Nothing is ever unpickled. The metadata of a file has one key, ``predmapnet`` (several would come in random order), with
JSON: ``format``, ``version`` (of the package), ``configuration`` and ``facts`` (data, frames seen, scores).
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from math import prod
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch.overrides import TorchFunctionMode

from predmapnet import __version__
from predmapnet.config import PredMapNetConfig
from predmapnet.errors import UserError
from predmapnet.files import write_file
from predmapnet.network.predmapnet import PredMapNet
from predmapnet.presets import parse_config
from predmapnet.weights.files import KEY, description, existing_weights, unreadable, weights_hash
from predmapnet.weights.fit import is_finite

FORMAT = 1
MARGIN = 1 << 24
"""Numbers that are allocated beside the weights, at most."""
_SHOWN_NAMES = 4


@dataclass(frozen=True)
class Checkpoint:
    """A network as read from a file.

    Attributes:
        network: in evaluation mode, on the CPU, float32.
        facts: about the training.
        version: of the package that wrote it.
        sha256: of the file.
    """

    network: PredMapNet
    facts: Mapping[str, Any]
    version: str
    sha256: str


def save_checkpoint(
    path: Path, network: PredMapNet, facts: Mapping[str, Any] | None = None, half: bool = False
) -> None:
    """Write a network; the file appears whole or not at all.

    Args:
        path: ends in ``.safetensors``.
        network: whose weights and configuration are written.
        facts: about the training, JSON types only.
        half: store floating-point weights in 16 bits.
    """
    tensors = {}
    for name, tensor in network.state_dict().items():
        stored = tensor.half() if half and tensor.is_floating_point() else tensor
        tensors[name] = stored.detach().cpu().contiguous()
    about = {
        "format": FORMAT,
        "version": __version__,
        "configuration": network.config.model_dump(mode="json"),
        "facts": dict(facts or {}),
    }
    metadata = {KEY: json.dumps(about)}
    with write_file(path) as temporary:
        temporary.write_bytes(save(tensors, metadata))


def load_checkpoint(path: Path | None = None) -> Checkpoint:
    """Read a network that :func:`save_checkpoint` wrote; None for the shipped weights.

    Raises:
        UserError: the file is missing, damaged, from something else, or its weights do not fit its configuration.
    """
    path = existing_weights(path)
    try:
        with safe_open(path, framework="pt") as file:
            about = description(file.metadata())
            config, facts = _described(about, path)
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    except (SafetensorError, OSError, ValueError, KeyError) as error:
        raise unreadable(path, error) from None
    network = _fitting_network(config, tensors, path)
    network.load_state_dict({name: _full(tensor) for name, tensor in tensors.items()})
    network.eval()
    return Checkpoint(network, facts, str(about.get("version")), weights_hash(path))


def _described(about: Mapping[str, Any], path: Path) -> tuple[PredMapNetConfig, Mapping[str, Any]]:
    """Return the configuration and the facts of a description; raises UserError if it is of another format."""
    if about.get("format") != FORMAT:
        raise UserError(
            f"{path} does not hold PredMapNet weights of format {FORMAT} (it says: {about.get('format')}). "
            "Weights of other programs have to be imported first."
        )
    facts = about.get("facts")
    if not isinstance(facts, dict):
        raise UserError(f"{path}: its description has no object 'facts', but {str(facts)[:40]}.")
    return parse_config(json.dumps(about.get("configuration")), str(path)), facts


def _full(tensor: torch.Tensor) -> torch.Tensor:
    return tensor.float() if tensor.is_floating_point() else tensor


class _TooLargeError(Exception):
    """More numbers are asked for than a network that fits its weights can have."""


class _Bounded(TorchFunctionMode):
    """Lets no more than some number of numbers be allocated."""

    def __init__(self, numbers: int) -> None:
        super().__init__()
        self._left = numbers

    def __torch_function__(
        self, function: Any, types: Any, args: tuple[Any, ...] = (), kwargs: dict[str, Any] | None = None
    ) -> Any:
        if function in (torch.empty, torch.randn, torch.zeros, torch.ones):
            sizes = args[0] if args and not isinstance(args[0], int) else args
            self._left -= prod(sizes)
            if self._left < 0:
                raise _TooLargeError
        return function(*args, **(kwargs or {}))


def _fitting_network(config: PredMapNetConfig, tensors: Mapping[str, torch.Tensor], path: Path) -> PredMapNet:
    """Build the network of a configuration if the weights fit it; raises UserError if not.

    What does not fit may be of any size. Then a network without memory tells what is wrong; the first of these costs
    two seconds, so those that fit go without.
    """
    try:
        with _Bounded(2 * sum(tensor.numel() for tensor in tensors.values()) + MARGIN):
            network = PredMapNet(config)
    except _TooLargeError:
        with torch.device("meta"):
            network = PredMapNet(config)
    _check_fit(tensors, network, path)
    return network


def _check_fit(tensors: Mapping[str, torch.Tensor], network: PredMapNet, path: Path) -> None:
    """Compare names and shapes with the network's, and name what does not fit, or holds no numbers."""
    own = network.state_dict()
    wanted = {name: tensor.shape for name, tensor in own.items()}
    shapes = {name: tensor.shape for name, tensor in tensors.items()}
    faults = {
        "missing": [name for name in wanted if name not in shapes],
        "not known": [name for name in shapes if name not in wanted],
        "of another shape": [
            f"{name} {tuple(shapes[name])} instead of {tuple(shape)}"
            for name, shape in wanted.items()
            if name in shapes and shapes[name] != shape
        ],
        "of another kind": [
            f"{name} {tensor.dtype}"
            for name, tensor in tensors.items()
            if name in own and tensor.is_floating_point() != own[name].is_floating_point()
        ],
        "with NaN or infinity": [name for name, tensor in tensors.items() if not is_finite(tensor)],
    }
    said = [
        f"{len(names)} {what}: {', '.join(names[:_SHOWN_NAMES])}{' ...' if len(names) > _SHOWN_NAMES else ''}"
        for what, names in faults.items()
        if names
    ]
    if said:
        raise UserError(f"The weights in {path} do not fit their configuration ({'; '.join(said)}).")
