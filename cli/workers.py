"""The option ``--engine`` and what belongs to it: which workers do the work of a command."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import closing, contextmanager, redirect_stdout
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from mapfusion.executors import Executor


class WorkerKind(StrEnum):
    """Kinds of workers."""

    PROCESS = "process"
    RAY = "ray"


EngineOption = Annotated[
    WorkerKind, typer.Option("--engine", help="Workers: processes of this machine, or actors of a Ray cluster.")
]
Address = Annotated[
    str | None,
    typer.Option(
        envvar="RAY_ADDRESS",
        help="Of a Ray cluster, HOST:6379 or auto; without it one is started here.",
        show_default=False,
        show_envvar=False,
    ),
]
Jobs = Annotated[
    int | None, typer.Option(min=1, help="Workers; by default one core fewer than there are.", show_default=False)
]


@contextmanager
def open_executor(
    engine: WorkerKind,
    address: str | None,
    jobs: int | None,
    device: str = "cpu",
    threads: int = 1,
    time_limit: float | None = None,
    apart: bool = True,
) -> Iterator[tuple[Executor, str]]:
    """Open the workers that a user asks for; yields them and what they are, for people.

    Args:
        engine, address, jobs: the options.
        device: that the work needs.
        threads: CPUs of a worker.
        time_limit: of a task, seconds.
        apart: whether a single worker is a process, too, so that its death is not that of the command.

    Raises:
        UserError: Ray is not installed, or its cluster is not there.
    """
    from cli.console import say_warning
    from mapfusion.executors import Sequential
    from predmapnet.machine import workers_that_fit
    from predmapnet.runs.process_executor import ProcessExecutor

    if engine is WorkerKind.RAY:
        from predmapnet.runs.ray_executor import RayExecutor

        cluster = RayExecutor(address, jobs, threads, device != "cpu", time_limit, say_warning)
        # What Ray prints of a death goes to the standard output, which belongs to results; the executor tells it.
        with Path(os.devnull).open("w") as nowhere, redirect_stdout(nowhere), closing(cluster):
            yield cluster, cluster.place
        return
    if jobs is None:
        jobs = workers_that_fit(device)
    if jobs == 1 and not apart:
        yield Sequential(), "one after the other"
        return
    yield ProcessExecutor(jobs, time_limit, say_warning), f"{jobs} process{'es' if jobs > 1 else ''}"
