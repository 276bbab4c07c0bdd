"""Executors: the same work done here, in processes or on a cluster; what comes out does not depend on which."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import Any, Protocol

Work = Callable[[Any], Any]
"""The work on one task."""

Begin = Callable[[], Work]
"""Called once in each worker: opens what the work needs (a model, a cache) and returns the work. It is pickled."""


@dataclass(frozen=True)
class Finished:
    """End of one task.

    Attributes:
        number: place of the task in the order in which they were given, from 0.
        task: itself.
        result: of the work; None if it failed.
        error: of the work, or of the workers that it took along; None if it succeeded.
    """

    number: int
    task: Any
    result: Any = None
    error: Exception | None = None


class Executor(Protocol):
    """Runs tasks in workers that each begin once."""

    def run(self, begin: Begin, tasks: Iterable[Any]) -> Iterator[Finished]:
        """Yield the ends of the tasks as they come; tasks are taken as workers become free.

        Raises:
            Exception: no worker could begin; the error of ``begin``.
        """
        ...


class Sequential:
    """Executor that does everything here, one task after the other."""

    def run(self, begin: Begin, tasks: Iterable[Any]) -> Iterator[Finished]:
        """Yield the ends of the tasks in their order."""
        work = begin()
        for number, task in enumerate(tasks):
            try:
                result = work(task)
            except Exception as error:
                yield Finished(number, task, error=error)
            else:
                yield Finished(number, task, result)


def results_in_order(executor: Executor, begin: Begin, tasks: Iterable[Any]) -> Iterator[Any]:
    """Yield the results in the order of the tasks; the first error that comes is raised and ends the work."""
    early: dict[int, Any] = {}
    expected = 0
    for finished in executor.run(begin, tasks):
        if finished.error is not None:
            raise finished.error
        early[finished.number] = finished.result
        while expected in early:
            yield early.pop(expected)
            expected += 1
