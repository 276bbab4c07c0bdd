"""Training processes: one a GPU, or several on a CPU, which on few cores beat threads that spin (lightning-fabric)."""

from __future__ import annotations

import logging
import multiprocessing
import os
import sys
import warnings
from collections.abc import Callable
from datetime import timedelta
from typing import Any, TypeVar

import torch
import torch.distributed as distributed
from lightning_fabric import Fabric
from lightning_fabric.plugins.environments.lightning import find_free_network_port
from lightning_fabric.strategies.ddp import DDPStrategy

from predmapnet.errors import UserError
from predmapnet.machine import end_with_parent

Result = TypeVar("Result")


def make_fabric(device: str, devices: int) -> Fabric:
    """Return what this process trains with; it is one of ``devices``, or of those that torchrun started."""
    nodes = 1
    if by_torchrun():
        devices = int(os.environ["LOCAL_WORLD_SIZE"])
        nodes = int(os.environ["WORLD_SIZE"]) // devices
    # Which modules take part depends on what there is to see: without tracks, none guides them.
    alone = devices * nodes == 1
    strategy: Any = "auto"
    if not alone:
        # Processes wait long where one of them fills the cache of a large data set.
        patience = timedelta(hours=24)
        strategy = DDPStrategy(find_unused_parameters=True, broadcast_buffers=False, timeout=patience)
    logging.getLogger("lightning_fabric").setLevel(logging.WARNING)
    warnings.filterwarnings("ignore", message="`broadcast_buffers` is deprecated")
    fabric = Fabric(accelerator=device, devices=devices, num_nodes=nodes, strategy=strategy)
    fabric.launch()
    return fabric


def by_torchrun() -> bool:
    """Whether torchrun has started the processes, here or on several machines."""
    return "TORCHELASTIC_RUN_ID" in os.environ


def leads() -> bool:
    """Whether this is the first of all processes, which writes files and talks."""
    return int(os.environ.get("RANK", 0)) == 0


def usual_devices(device: str) -> int:
    """Return how many processes train if nobody says: one for each GPU, or two on a CPU."""
    return max(torch.cuda.device_count(), 1) if device == "cuda" else 2


def check_devices(device: str, devices: int) -> None:
    """Raise UserError unless there are as many devices here."""
    if device == "cuda" and (found := torch.cuda.device_count()) < devices:
        raise UserError(f"This torch sees {found} GPUs here, not {devices}. Give --device cpu, or fewer --devices.")


def gathered(own: Result) -> list[Result]:
    """Return what each of all processes has, in their order."""
    if not distributed.is_initialized():
        return [own]
    everyone = [own] * distributed.get_world_size()
    distributed.all_gather_object(everyone, own)
    return everyone


def in_processes(devices: int, device: str, body: Callable[..., Result], *arguments: object) -> Result:
    """Run ``body(fabric, *arguments)`` in a process for each device; this one is the first, and its result counts."""
    if devices == 1 or by_torchrun():
        return body(make_fabric(device, devices), *arguments)
    meeting = {"MASTER_ADDR": "127.0.0.1", "MASTER_PORT": str(find_free_network_port())}
    context = multiprocessing.get_context("spawn")
    others = [
        context.Process(target=_other, args=(meeting, rank, device, devices, body, arguments), daemon=True)
        for rank in range(1, devices)
    ]
    for process in others:
        process.start()
    os.environ.update(meeting, LOCAL_RANK="0")
    try:
        result = body(make_fabric(device, devices), *arguments)
        distributed.destroy_process_group()
    except RuntimeError as error:
        if any(process.exitcode for process in others):
            raise UserError("A training process has ended; it says above why.") from error
        raise
    finally:
        for name in (*meeting, "LOCAL_RANK"):
            del os.environ[name]
    for process in others:
        process.join()
    return result


def _other(
    meeting: dict[str, str], rank: int, device: str, devices: int, body: Callable[..., Any], arguments: Any
) -> None:
    """Body of every process but the first."""
    end_with_parent()
    os.environ.update(meeting, LOCAL_RANK=str(rank))
    try:
        body(make_fabric(device, devices), *arguments)
    except UserError as error:
        sys.exit(f"Training process {rank}: {error}")
    distributed.destroy_process_group()
