"""Content of a weights file, read without building the network."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from math import prod
from pathlib import Path
from typing import Any

from safetensors import SafetensorError, safe_open

from predmapnet.errors import UserError
from predmapnet.presets import parse_config
from predmapnet.weights.files import description, existing_weights, unreadable, weights_hash


@dataclass(frozen=True)
class TensorInfo:
    """One tensor of a file.

    Attributes:
        name: within the network.
        shape: sizes.
        kind: of its numbers, as safetensors calls it (``F32``).
    """

    name: str
    shape: tuple[int, ...]
    kind: str

    @property
    def count(self) -> int:
        """Parameters in it."""
        return prod(self.shape)


@dataclass(frozen=True)
class WeightsInfo:
    """Content of a weights file.

    Attributes:
        path: of the file.
        size: bytes.
        about: metadata of PredMapNet: format, version, configuration and facts; empty for a file
            of another program.
        tensors: in the order of the file.
        sha256: of the file.
    """

    path: Path
    size: int
    about: Mapping[str, Any]
    tensors: tuple[TensorInfo, ...]
    sha256: str

    @property
    def modules(self) -> tuple[str, ...] | None:
        """The modules of the paper that are switched on; None for a configuration that this version cannot read."""
        try:
            config = parse_config(json.dumps(self.about["configuration"]), str(self.path))
        except (UserError, KeyError):
            return None
        switches = {
            "semantic-aware query generator": config.semantic_queries.enabled,
            "history rasterized map memory": config.history_map.memory,
            "history-map guidance": config.history_map.guidance,
            "short-term future guidance": config.future.enabled,
        }
        return tuple(name for name, on in switches.items() if on)

    def parts(self) -> dict[str, int]:
        """Return how many parameters each part of the network has, in the order of the file."""
        counts: dict[str, int] = {}
        for tensor in self.tensors:
            part = tensor.name.split(".")[0]
            counts[part] = counts.get(part, 0) + tensor.count
        return counts


def parts_of(names: Iterable[str]) -> list[str]:
    """Return the parts of the network that tensors belong to, each once, in their order."""
    return list(dict.fromkeys(name.split(".")[0] for name in names))


def inspect_file(path: Path | None = None) -> WeightsInfo:
    """Look into a safetensors file; None for the weights that come with the package.

    Raises:
        UserError: there is no such file, or it is no whole safetensors file.
    """
    path = existing_weights(path)
    try:
        with safe_open(path, framework="numpy") as file:
            about = description(file.metadata())
            slices = {name: file.get_slice(name) for name in file.keys()}  # noqa: SIM118
            tensors = tuple(
                TensorInfo(name, tuple(part.get_shape()), part.get_dtype()) for name, part in sorted(slices.items())
            )
    except (SafetensorError, OSError, ValueError) as error:
        raise unreadable(path, error) from None
    return WeightsInfo(path, path.stat().st_size, about, tensors, weights_hash(path))
