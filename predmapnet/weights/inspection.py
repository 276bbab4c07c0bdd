"""What a weights file holds, without building a network of it."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from math import prod
from pathlib import Path
from typing import Any

from safetensors import SafetensorError, safe_open

from predmapnet.errors import UserError

KEY = "predmapnet"
"""Of the metadata that PredMapNet writes."""


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
        """Numbers in it."""
        return prod(self.shape)


@dataclass(frozen=True)
class WeightsInfo:
    """What a file holds.

    Attributes:
        path: of the file.
        size: bytes.
        about: what PredMapNet wrote beside the tensors: format, version, configuration and facts; empty for a file
            of another program.
        tensors: in the order of the file.
    """

    path: Path
    size: int
    about: Mapping[str, Any]
    tensors: tuple[TensorInfo, ...]

    def parts(self) -> dict[str, int]:
        """Return how many numbers each part of the network has, in the order of the file."""
        counts: dict[str, int] = {}
        for tensor in self.tensors:
            part = tensor.name.split(".")[0]
            counts[part] = counts.get(part, 0) + tensor.count
        return counts


def inspect_file(path: Path) -> WeightsInfo:
    """Look into a safetensors file.

    Raises:
        UserError: there is no such file, or it is no whole safetensors file.
    """
    if not path.is_file():
        raise UserError(f"There is no weights file {path}.")
    try:
        with safe_open(path, framework="numpy") as file:
            about = json.loads((file.metadata() or {}).get(KEY, "{}"))
            slices = {name: file.get_slice(name) for name in file.keys()}  # noqa: SIM118
            tensors = tuple(
                TensorInfo(name, tuple(part.get_shape()), part.get_dtype()) for name, part in sorted(slices.items())
            )
    except (SafetensorError, OSError, json.JSONDecodeError) as error:
        hint = " A PyTorch checkpoint has to be imported first (predmapnet weights import)."
        raise UserError(
            f"{path} is not a whole safetensors file ({error}).{hint if path.suffix in {'.pth', '.pt'} else ''}"
        ) from None
    return WeightsInfo(path, path.stat().st_size, about, tensors)
