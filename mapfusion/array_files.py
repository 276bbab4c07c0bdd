"""Files of named arrays (``.npz``): never a pickle, and never more than the memory takes."""

from __future__ import annotations

import zipfile
from collections.abc import Collection
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

MOST_BYTES = 2 << 30
"""Most that a file may take when it is unpacked."""


def read_arrays(path: Path, without: Collection[str] = ()) -> dict[str, NDArray[Any]]:
    """Read the arrays of a file, all but some.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: it is damaged or no such archive, too large, or holds what would have to be unpickled.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            members = {member.filename.removesuffix(".npy"): member for member in archive.infolist()}
            unpacked = sum(member.file_size for member in members.values())
            if unpacked > MOST_BYTES:
                raise ValueError(f"it would take {unpacked:,} bytes when it is unpacked")
            arrays: dict[str, NDArray[Any]] = {}
            for name, member in members.items():
                if name not in without:
                    with archive.open(member) as file:
                        arrays[name] = np.lib.format.read_array(file, allow_pickle=False)
            return arrays
    except FileNotFoundError:
        raise
    except Exception as error:  # a damaged file may raise anything while its headers are parsed
        raise ValueError(str(error) or type(error).__name__) from error
