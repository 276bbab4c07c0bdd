"""Compilation of the inner loops: machine code that is kept between runs, on one thread each."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar, cast

import numba
import numba.core.config

Function = TypeVar("Function", bound=Callable[..., Any])

_CONFIG: Any = numba.core.config
if not os.access(Path(__file__).parent, os.W_OK) and not _CONFIG.CACHE_DIR:
    # An installation that may not be written to: numba would refuse to cache where the home folder is sealed too.
    _CONFIG.CACHE_DIR = str(Path(tempfile.gettempdir()) / f"predmapnet-numba-{os.getuid()}")


_OPTIONS: dict[str, Any] = {
    "cache": True,
    "nogil": True,
    "error_model": "numpy",
    "_nrt": False,
    "fastmath": {"reassoc", "contract", "arcp", "nsz"},
    "no_cfunc_wrapper": True,
}
_INSIDE: dict[str, Any] = {"forceinline": True, "no_cpython_wrapper": True}
"""Of parts, which Python never calls: compiling them takes less long without an entrance for it."""


def kernel(function: Function) -> Function:
    """Compile ``function`` with numba; it releases the GIL, so threads render cameras side by side.

    Infinities keep their meaning (depth of the sky), so only the harmless part of "fast math" is on. Kernels may not
    allocate: without numba's reference counting, which would count every array of every argument of every call inside
    the loops over pixels, they run several times as fast. Scratch space comes from the caller.
    """
    return cast(Function, numba.njit(**_OPTIONS)(function))


def part(function: Function) -> Function:
    """Compile a part of kernels that is copied into its callers, whose many arguments are then not passed at all.

    The cache of a kernel notices changes of the kernel's own file only: after editing a part of another file, clear
    the compiled files (``__pycache__/*.nb?``) or touch the kernel's file.
    """
    return cast(Function, numba.njit(**_OPTIONS, **_INSIDE)(function))
