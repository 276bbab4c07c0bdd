"""The Ray form of the executor does what the others do, and names the extra where Ray is missing."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

from predmapnet.errors import UserError
from predmapnet.runs.ray_executor import RayExecutor
from predmapnet.runs.supervision import ATTEMPTS, TimeLimitError, WorkerDiedError
from tests.predmapnet.runs.work import Niceness, Notebook, Unfit


@pytest.fixture(scope="module")
def said() -> list[str]:
    return []


@pytest.fixture(scope="module")
def executor(said):
    pytest.importorskip("ray")
    made = RayExecutor(jobs=2, time_limit=5.0, say=said.append)
    yield made
    made.close()


def test_tasks_end_once_and_the_dead_and_the_stuck_are_replaced(executor, said, tmp_path):
    tasks = ["die", "sleep", "die once", "refuse", *(f"square {number}" for number in range(5))]
    ends = {end.task: end for end in executor.run(Notebook(tmp_path), tasks)}
    assert set(ends) == set(tasks)
    assert isinstance(ends["die"].error, WorkerDiedError)
    assert isinstance(ends["sleep"].error, TimeLimitError)
    assert isinstance(ends["refuse"].error, UserError)
    assert ends["die once"].error is None
    assert [ends[f"square {number}"].result[1] for number in range(5)] == [0, 1, 4, 9, 16]
    notes = Notebook(tmp_path)
    assert len(set(notes.tries("die"))) == len(set(notes.tries("sleep"))) == ATTEMPTS
    assert len(notes.tries("refuse")) == len(notes.tries("square 1")) == 1
    assert len(said) == 2 * (ATTEMPTS - 1) + 1


def test_actors_that_cannot_begin_end_the_run_with_their_error(executor):
    with pytest.raises(UserError, match="no weights"):
        list(executor.run(Unfit(), ["square 1", "square 2"]))


def test_actors_do_not_give_way_to_what_else_runs_here(executor):
    (end,) = executor.run(Niceness(), ["task"])
    assert end.result == os.nice(0)


DYING = """
import sys
from pathlib import Path
from cli.workers import WorkerKind, open_executor
from tests.predmapnet.runs.work import Notebook
with open_executor(WorkerKind.RAY, None, 1) as (executor, _):
    ends = list(executor.run(Notebook(Path(sys.argv[1])), ["die", "square 3"]))
print([end.result for end in ends if end.error is None])
"""


def test_what_ray_says_of_a_death_is_not_taken_for_a_result(tmp_path):
    pytest.importorskip("ray")
    ended = subprocess.run([sys.executable, "-c", DYING, str(tmp_path)], capture_output=True, text=True, check=True)
    assert ended.stdout.count("\n") == 1 and ended.stdout.startswith("[") and "9" in ended.stdout
    assert "its worker died" in ended.stderr


def test_without_the_extra_or_the_cluster_the_message_says_what_to_do(monkeypatch):
    pytest.importorskip("ray")
    with pytest.raises(UserError, match="ray start --head"):
        RayExecutor("127.0.0.1:1")
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(UserError, match=r"predmapnet\[ray\]"):
        RayExecutor()
