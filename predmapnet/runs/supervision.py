"""Supervision of workers of any kind: tasks handed out, the dead and the stuck replaced, their tasks tried again."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from enum import Enum
from time import monotonic
from typing import Any, Protocol

from mapfusion.executors import Finished
from predmapnet.errors import UserError

ATTEMPTS = 3
"""Number of times that a task is tried, each time in another worker, if it takes its worker along or does not end."""

Say = Callable[[str], None]
"""Called with notes for the user."""


class WorkerDiedError(UserError):
    """The worker of a task died: killed from outside, out of memory, or its node is gone."""


class TimeLimitError(UserError):
    """A task took longer than it may."""


class State(Enum):
    """State of a worker, as its answer tells."""

    READY = "ready"
    UNFIT = "unfit"
    DONE = "done"
    DEAD = "dead"


@dataclass(frozen=True)
class Answer:
    """Sign of life or death of a worker.

    Attributes:
        state: READY after it began, UNFIT if it cannot begin, DONE after a task, DEAD if it is gone.
        result: of a task.
        error: of a task, or why it cannot begin or is gone.
    """

    state: State
    result: Any = None
    error: Exception | None = None


class Worker(Protocol):
    """A process or an actor; it begins by itself and then answers READY."""

    def send(self, task: Any) -> None:
        """Begin a task."""
        ...

    def kill(self) -> None:
        """End it at once, whatever it is doing."""
        ...


class Crew(Protocol):
    """Workers of one kind."""

    def hire(self) -> Worker:
        """Start a worker."""
        ...

    def answers(self, workers: Sequence[Any], seconds: float | None) -> list[tuple[Any, Answer]]:
        """Wait for answers of workers that were started or have a task, at most some seconds."""
        ...


@dataclass
class _Assignment:
    number: int
    task: Any
    attempts: int = 0
    deadline: float = field(default=float("inf"))


class Supervisor:
    """Supervisor of a run: keeps workers busy, replaces those that are lost.

    Args:
        crew: makes workers.
        count: most workers at a time; no more are started than there are tasks.
        time_limit: of a task, seconds; None for none.
        say: told of workers that are lost.
    """

    def __init__(self, crew: Crew, count: int, time_limit: float | None, say: Say) -> None:
        self._crew, self._count, self._time_limit, self._say = crew, count, time_limit, say
        self._idle: list[Worker] = []
        self._starting: list[Worker] = []
        self._busy: dict[Worker, _Assignment] = {}
        self._queue: deque[_Assignment] = deque()
        self._again: deque[_Assignment] = deque()
        self._stillborn = 0
        self._unfit: list[str] = []

    def run(self, tasks: Iterable[Any]) -> Iterator[Finished]:
        """Yield the ends of the tasks as they come. Raises the error of a worker if none can begin."""
        fresh = (_Assignment(number, task) for number, task in enumerate(tasks))
        try:
            while True:
                self._hand_out(fresh)
                if not self._busy and not self._queue:
                    return
                for worker, answer in self._crew.answers([*self._busy, *self._starting], self._patience()):
                    yield from self._take(worker, answer)
                yield from self._stop_stuck()
        finally:
            for worker in (*self._busy, *self._starting, *self._idle):
                worker.kill()

    def _hand_out(self, fresh: Iterator[_Assignment]) -> None:
        """Give tasks to idle workers, new ones first, and hire as many workers as there are tasks for."""
        while len(self._queue) + len(self._busy) < self._count:
            task = next(fresh, None) or (self._again.popleft() if self._again else None)
            if task is None:
                break
            self._queue.append(task)
        while self._queue and self._idle:
            worker, task = self._idle.pop(), self._queue.popleft()
            task.deadline = monotonic() + (self._time_limit or float("inf"))
            self._busy[worker] = task
            worker.send(task.task)
        while len(self._starting) < len(self._queue) and len(self._busy) + len(self._starting) < self._count:
            self._starting.append(self._crew.hire())

    def _patience(self) -> float | None:
        deadline = min((task.deadline for task in self._busy.values()), default=float("inf"))
        return None if deadline == float("inf") else max(deadline - monotonic(), 0.0)

    def _take(self, worker: Worker, answer: Answer) -> Iterator[Finished]:
        if answer.state is State.READY:
            self._stillborn = 0
            self._starting.remove(worker)
            self._idle.append(worker)
            for text in self._unfit:
                self._say(text)
            self._unfit.clear()
        elif answer.state is State.DONE:
            done = self._busy.pop(worker)
            self._idle.append(worker)
            yield Finished(done.number, done.task, answer.result, answer.error)
        elif worker in self._busy:
            yield from self._lost(worker, answer.error or WorkerDiedError("its worker died"))
        else:
            self._dismiss(worker, answer)

    def _dismiss(self, worker: Worker, answer: Answer) -> None:
        """Do without a worker that could not begin; if it died, another one may do better."""
        self._starting.remove(worker)
        worker.kill()
        error = answer.error or WorkerDiedError("a worker died before it could begin")
        self._stillborn += 1
        if answer.state is State.DEAD and self._stillborn < ATTEMPTS:
            return
        self._count -= 1
        if not (self._count and (self._busy or self._idle or self._starting)):
            raise error
        self._unfit.append(f"one worker less: {error}")

    def _lost(self, worker: Worker, error: Exception) -> Iterator[Finished]:
        """Replace a busy worker and try its task again after all others, or give it up."""
        task = self._busy.pop(worker)
        worker.kill()
        task.attempts += 1
        if task.attempts >= ATTEMPTS:
            yield Finished(task.number, task.task, error=type(error)(f"{error}, {ATTEMPTS} times"))
            return
        name = getattr(task.task, "name", f"task {task.number + 1}")
        self._say(f"{name}: {error}; it will be tried again ({task.attempts + 1} of {ATTEMPTS})")
        self._again.append(task)

    def _stop_stuck(self) -> Iterator[Finished]:
        now = monotonic()
        for worker in [worker for worker, task in self._busy.items() if task.deadline <= now]:
            yield from self._lost(worker, TimeLimitError(f"it did not end within {self._time_limit:g} s"))
