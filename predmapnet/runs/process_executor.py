"""Executor whose workers are processes of this machine."""

from __future__ import annotations

import multiprocessing
import pickle
import signal
import traceback
from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress
from multiprocessing.connection import Connection, wait
from multiprocessing.context import SpawnContext
from typing import Any

from mapfusion.executors import Begin, Finished, Work
from predmapnet.machine import end_with_parent
from predmapnet.runs.supervision import Answer, Say, State, Supervisor, WorkerDiedError


class ProcessExecutor:
    """Executor whose workers are processes of this machine.

    Args:
        jobs: most processes at a time.
        time_limit: of a task, seconds.
        say: told of processes that were lost.
    """

    def __init__(self, jobs: int, time_limit: float | None = None, say: Say = lambda text: None) -> None:
        self._jobs, self._time_limit, self._say = jobs, time_limit, say

    def run(self, begin: Begin, tasks: Iterable[Any]) -> Iterator[Finished]:
        """Yield the ends of the tasks as they come; see :class:`mapfusion.executors.Executor`."""
        return Supervisor(_Processes(begin), self._jobs, self._time_limit, self._say).run(tasks)


def answer_of(work: Work, task: Any) -> Answer:
    """Do a task in a worker; errors become answers that can be sent."""
    try:
        return Answer(State.DONE, work(task))
    except Exception as error:
        return Answer(State.DONE, error=sendable(error))


def begun(begin: Begin) -> tuple[Work | None, Answer]:
    """Begin a worker; returns its work, if it can do any, and the answer."""
    try:
        return begin(), Answer(State.READY)
    except Exception as error:
        return None, Answer(State.UNFIT, error=sendable(error))


def sendable(error: Exception) -> Exception:
    """Return an error that survives the way to another process, with its traceback as a note."""
    error.add_note("".join(traceback.format_exception(error)))
    try:
        pickle.loads(pickle.dumps(error))
    except Exception:
        return RuntimeError(f"{type(error).__name__}: {error}")
    return error


class _Processes:
    def __init__(self, begin: Begin) -> None:
        self._begin = begin
        self._context = multiprocessing.get_context("spawn")

    def hire(self) -> _Process:
        return _Process(self._context, self._begin)

    def answers(self, workers: Sequence[_Process], seconds: float | None) -> list[tuple[_Process, Answer]]:
        signs: dict[Any, _Process] = {worker.pipe: worker for worker in workers}
        signs.update({worker.process.sentinel: worker for worker in workers})
        found = {signs[sign] for sign in wait(list(signs), seconds)}
        return [(worker, worker.answer()) for worker in found]


class _Process:
    def __init__(self, context: SpawnContext, begin: Begin) -> None:
        self.pipe, theirs = context.Pipe()
        self.process = context.Process(target=_serve, args=(theirs, begin))
        self.process.start()
        theirs.close()

    def send(self, task: Any) -> None:
        with suppress(OSError):  # It is dead, which its answer will tell.
            self.pipe.send(task)

    def answer(self) -> Answer:
        """Read the answer of the worker; one that came before its death counts."""
        with suppress(EOFError, OSError):
            if self.pipe.poll():
                answer: Answer = self.pipe.recv()
                return answer
        self.kill()
        code = self.process.exitcode
        how = f"signal {-code}" if code is not None and code < 0 else f"exit code {code}"
        return Answer(State.DEAD, error=WorkerDiedError(f"its process died ({how}); too little memory?"))

    def kill(self) -> None:
        self.process.kill()
        self.process.join()
        self.pipe.close()


def _serve(pipe: Connection, begin: Begin) -> None:
    """Do tasks until the parent is gone; Ctrl-C is the parent's business."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    end_with_parent()
    work, answer = begun(begin)
    pipe.send(answer)
    while work is not None:
        try:
            task = pipe.recv()
        except EOFError:
            return
        answer = answer_of(work, task)
        try:
            message = pickle.dumps(answer)
        except Exception as error:
            message = pickle.dumps(Answer(State.DONE, error=sendable(error)))
        pipe.send_bytes(message)
