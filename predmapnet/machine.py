"""The machine under a run: options of the network, CPU threads and memory of a process, worker processes."""

from __future__ import annotations

import ctypes
import multiprocessing
import os
import signal
import sys
import threading
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path

THREADS_PER_SCENE = 1
"""CPU threads with which a scene is mapped unless a user says otherwise, alone or beside others: the order of sums, and
with it the last digits of a map, depends on them."""


WORKER_MEMORY = 2 * 2**30
"""Memory that a worker of a batch may need, bytes."""


class Precision(StrEnum):
    """Numbers that the image backbone and the BEV encoder compute with; everything else computes in float32."""

    FLOAT32 = "float32"
    BFLOAT16 = "bfloat16"


class EngineKind(StrEnum):
    """Program that computes the network."""

    TORCH = "torch"
    ONNX = "onnx"


@dataclass(frozen=True)
class NetworkOptions:
    """The network of a run and how this machine computes with it.

    Attributes:
        weights: a ``.safetensors`` checkpoint, or a folder of exported graphs; None for the shipped ``lite`` weights.
        device: ``auto`` (a GPU if there is one), or a device by torch's name.
        precision: of the image backbone and the BEV encoder.
        compiled: whether these two are compiled, which delays the first frames.
        engine: what computes the network; ``onnx`` exports a checkpoint first, a folder of graphs is always its.
        ahead: whether other threads compute the next frames' features meanwhile; where as many scenes are mapped at
            a time as there are cores, it gains nothing.
    """

    weights: Path | None = None
    device: str = "auto"
    precision: Precision = Precision.FLOAT32
    compiled: bool = False
    engine: EngineKind = EngineKind.TORCH
    ahead: bool = True


def use_threads(count: int) -> int:
    """Let PyTorch, numba and OpenCV use ``count`` threads each; 0 means all cores that this process may use.

    Memory that tensors leave is kept for the next ones.

    Call it before they are imported where possible: thread pools that exist already can only shrink.

    Returns:
        The number of threads.
    """
    threads = count or available_cores()
    for variable in ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS"):
        if not (variable == "NUMBA_NUM_THREADS" and "numba" in sys.modules):
            os.environ[variable] = str(threads)
    # Threads that wait must not spin: measured on two busy cores, mapping is twice as fast and takes a third of the
    # CPU time, because the thread that reads images ahead and the recording get their turn.
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    _keep_freed_memory()
    import cv2
    import torch

    torch.set_num_threads(threads)
    cv2.setNumThreads(threads)
    return threads


def _keep_freed_memory() -> None:
    """Tell glibc to keep the memory of freed tensors instead of giving it back to the system.

    Otherwise every tensor above 32 MB costs as much in page faults as in arithmetic: a quarter of the CPU time of a
    frame at 480 x 800. Peak memory grows by about as much as the tensors of two layers.
    """
    trim_threshold, most_mappings = -1, -4  # M_TRIM_THRESHOLD and M_MMAP_MAX of malloc.h
    if sys.platform == "linux" and hasattr(libc := ctypes.CDLL(None), "mallopt"):
        libc.mallopt(most_mappings, 0)
        libc.mallopt(trim_threshold, 2**31 - 1)


def trim_memory() -> None:
    """Give pages of freed memory back to the system that :func:`use_threads` keeps, for long runs now and then.

    What stays of each frame lies between large tensors that come and go, and takes their places, so that they need new
    ones: without this, a drive of 2,000 frames grows to twice its memory. It costs some hundredths of a second.
    """
    if sys.platform == "linux" and hasattr(libc := ctypes.CDLL(None), "malloc_trim"):
        libc.malloc_trim(0)


def available_cores() -> int:
    """Number of cores that this process may use."""
    return len(os.sched_getaffinity(0)) if sys.platform == "linux" else os.cpu_count() or 1


def workers_that_fit(device: str) -> int:
    """Number of workers of a batch: one on a GPU; else one a core, one core left free, as many as the memory holds."""
    if device != "cpu" and Path("/proc/driver/nvidia/gpus").is_dir():
        return 1
    memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    return max(1, min(available_cores() - 1, memory // WORKER_MEMORY))


def begin_loading(_worker: int = 0) -> None:
    """Prepare a process that makes data: one thread, an end with its parent, and Ctrl-C left to that."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    end_with_parent()
    use_threads(1)


def end_with_parent() -> None:
    """End this process as soon as its parent is gone, however that ended."""

    def watch() -> None:
        parent = multiprocessing.parent_process()
        if parent is not None:
            parent.join()
            os._exit(1)

    threading.Thread(target=watch, daemon=True).start()
