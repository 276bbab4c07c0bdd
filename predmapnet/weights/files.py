"""Locate and hash weights files."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache
from hashlib import sha256
from pathlib import Path
from typing import Any

from mapfusion import json_text
from predmapnet.errors import UserError

SHIPPED = Path(__file__).with_name("lite.safetensors")
"""The weights that come with the package."""

KEY = "predmapnet"
"""Of the metadata that PredMapNet writes into a safetensors file."""


def existing_weights(path: Path | None = None) -> Path:
    """Return the weights file to use; None means the shipped weights.

    Raises:
        UserError: there is no such file.
    """
    if path is None and not SHIPPED.is_file():
        raise UserError(
            "This installation has no lite.safetensors beside its code. "
            "Install it again, or name a weights file (--weights FILE)."
        )
    path = SHIPPED if path is None else Path(path)
    if not path.is_file():
        raise UserError(f"There is no weights file {path}.")
    return path


def weights_hash(path: Path | None = None) -> str:
    """Return the SHA-256 of a weights file in hex; None for the shipped weights.

    Raises:
        UserError: there is no such file.
    """
    path = existing_weights(path)
    stamp = path.stat()
    return _hash(path, stamp.st_mtime_ns, stamp.st_size)


def description(metadata: Mapping[str, str] | None) -> dict[str, Any]:
    """Return what PredMapNet's metadata of a safetensors file say; nothing for those of another program.

    Raises ValueError for metadata that are not as they were written.
    """
    about = json_text.parse((metadata or {}).get(KEY, "{}").encode())
    if not isinstance(about, dict):
        raise ValueError(f"its description is no JSON object, but {str(about)[:40]}")
    return about


def unreadable(path: Path, error: Exception) -> UserError:
    """Return the error for a file that safetensors cannot read."""
    if path.suffix.lower() in {".pth", ".pt", ".ckpt"}:
        return UserError(
            f"{path} is a PyTorch checkpoint, which has to be imported first: "
            f"predmapnet weights import {path} --out weights.safetensors"
        )
    return UserError(f"{path} is not a whole safetensors file ({error}). Fetch or write it again.")


@cache
def _hash(path: Path, modified: int, size: int) -> str:
    return sha256(path.read_bytes()).hexdigest()
