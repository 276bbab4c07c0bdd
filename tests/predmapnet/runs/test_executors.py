"""Executors: every task ends once, the dead and the stuck are replaced, and nothing of it stays behind."""

from __future__ import annotations

import os
import time
from itertools import count

import pytest

from mapfusion.executors import Sequential, results_in_order
from predmapnet.errors import UserError
from predmapnet.runs.process_executor import ProcessExecutor
from predmapnet.runs.supervision import ATTEMPTS, TimeLimitError, WorkerDiedError
from tests.predmapnet.runs.work import Notebook, Stillborn, Unfit


def alive(process: str) -> bool:
    try:
        os.kill(int(process), 0)
    except ProcessLookupError:
        return False
    return True


@pytest.mark.parametrize("executor", [Sequential(), ProcessExecutor(2)])
def test_every_task_ends_once_and_a_worker_begins_once(executor, tmp_path):
    tasks = [*(f"square {number}" for number in range(12)), "refuse"]
    finished = sorted(executor.run(Notebook(tmp_path), tasks), key=lambda end: end.number)
    assert [end.task for end in finished] == tasks
    assert [end.result[1] for end in finished[:-1]] == [number**2 for number in range(12)]
    assert isinstance(finished[-1].error, UserError)
    assert 1 <= Notebook(tmp_path).begun() <= 2
    assert all(len(Notebook(tmp_path).tries(task)) == 1 for task in tasks)


def test_results_come_in_order_and_an_error_is_raised(tmp_path):
    tasks = [f"square {number}" for number in range(9)]
    found = [result for _, result in results_in_order(ProcessExecutor(2), Notebook(tmp_path), tasks)]
    assert found == [number**2 for number in range(9)]
    with pytest.raises(UserError, match="refuses"):
        list(results_in_order(ProcessExecutor(1), Notebook(tmp_path), ["square 1", "refuse"]))


def test_the_dead_and_the_stuck_are_replaced_and_their_tasks_tried_again_elsewhere(tmp_path):
    said: list[str] = []
    tasks = ["die", "sleep", "die once", *(f"square {number}" for number in range(4))]
    executor = ProcessExecutor(2, time_limit=3.0, say=said.append)
    ends = {end.task: end for end in executor.run(Notebook(tmp_path), tasks)}
    assert set(ends) == set(tasks)
    assert isinstance(ends["die"].error, WorkerDiedError)
    assert isinstance(ends["sleep"].error, TimeLimitError)
    assert "3 s" in str(ends["sleep"].error)
    assert all(ends[task].error is None for task in tasks[2:])
    notes = Notebook(tmp_path)
    assert len(set(notes.tries("die"))) == len(set(notes.tries("sleep"))) == ATTEMPTS
    assert len(notes.tries("die once")) == 2
    assert len(said) == 2 * (ATTEMPTS - 1) + 1
    assert not any(alive(process) for task in tasks for process in notes.tries(task))


def test_what_is_tried_again_waits_for_all_that_were_not_tried(tmp_path):
    tasks = ["die once", *(f"square {number}" for number in range(4))]
    assert [end.task for end in ProcessExecutor(1).run(Notebook(tmp_path), tasks)] == [*tasks[1:], tasks[0]]


def test_workers_that_cannot_begin_end_the_run_with_their_error():
    with pytest.raises(UserError, match="no weights"):
        list(ProcessExecutor(2).run(Unfit(), ["square 1", "square 2", "square 3"]))


def test_a_worker_that_dies_while_it_begins_is_replaced(tmp_path):
    assert [end.result for end in ProcessExecutor(1).run(Stillborn(tmp_path), ["a", "b"])] == ["A", "B"]


def test_tasks_are_taken_as_workers_become_free_and_workers_end_with_the_run(tmp_path):
    taken = []
    endless = (taken.append(number) or f"square {number}" for number in count())
    run = ProcessExecutor(1).run(Notebook(tmp_path), endless)
    ends = [next(run) for _ in range(5)]
    assert len(taken) <= len(ends) + 1
    (process,) = {str(end.result[0]) for end in ends}
    run.close()
    deadline = time.monotonic() + 10
    while alive(process) and time.monotonic() < deadline:
        time.sleep(0.01)
    assert not alive(process)
