"""Executor whose workers are actors of a Ray cluster (the extra ``ray``)."""

from __future__ import annotations

import logging
import os
import socket
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from types import ModuleType
from typing import Any

from mapfusion.executors import Begin, Finished
from predmapnet.errors import UserError
from predmapnet.runs.process_executor import answer_of, begun
from predmapnet.runs.supervision import Answer, Say, State, Supervisor, WorkerDiedError


class RayExecutor:
    """Executor whose workers are actors of a Ray cluster; it is left, or ended if it was started here, at the end.

    Args:
        address: of a cluster (``auto`` finds the one of this machine); None starts one here.
        jobs: most actors at a time; None takes one for each GPU, or else one for each CPU but one of every node.
        threads: CPUs of an actor.
        gpus: whether actors need GPUs where the cluster has some.
        time_limit: of a task, seconds.
        say: told of actors that were lost.

    Raises:
        UserError: Ray is not installed, or there is no cluster at the address.
    """

    def __init__(
        self,
        address: str | None = None,
        jobs: int | None = None,
        threads: int = 1,
        gpus: bool = False,
        time_limit: float | None = None,
        say: Say = lambda text: None,
    ) -> None:
        self._ray = _connected(address)
        resources = self._ray.cluster_resources()
        nodes = sum(node["Alive"] for node in self._ray.nodes())
        devices = int(resources.get("GPU", 0)) if gpus else 0
        self.jobs = jobs or devices or max(1, (int(resources.get("CPU", 1)) - nodes) // threads)
        several = "s" if self.jobs > 1 else ""
        self.place = f"{self.jobs} actor{several} on {nodes} node{'s' if nodes > 1 else ''}"
        share = min(1.0, devices / self.jobs)
        self._options = {"num_cpus": threads, "num_gpus": share, "max_restarts": 0, "scheduling_strategy": "SPREAD"}
        self._time_limit, self._say = time_limit, say

    def run(self, begin: Begin, tasks: Iterable[Any]) -> Iterator[Finished]:
        """Yield the ends of the tasks as they come; see :class:`mapfusion.executors.Executor`."""
        crew = _Actors(self._ray, self._options, begin)
        return Supervisor(crew, self.jobs, self._time_limit, self._say).run(tasks)

    def close(self) -> None:
        """Leave the cluster."""
        self._ray.shutdown()


def _connected(address: str | None) -> ModuleType:
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    os.environ.setdefault("RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO", "0")
    # Ray lets workers give way to everything else (niceness 15), so that on a machine in use they would hardly get on.
    os.environ.setdefault("RAY_worker_niceness", "0")
    try:
        import ray
    except ImportError as error:
        raise UserError("--engine ray needs Ray: pip install 'predmapnet[ray]'") from error
    try:
        _check_reachable(address)
        ray.init(address or "local", log_to_driver=False, logging_level=logging.ERROR, include_dashboard=False)
    except Exception as error:  # Ray raises all kinds; a machine without a cluster or without time for one is no bug
        if address is None:
            raise UserError(f"no Ray cluster could be started here: {error}") from error
        raise UserError(
            f"there is no Ray cluster at {address}: {error}. 'ray start --head' begins one, "
            "'ray start --address=HOST:6379' joins it"
        ) from error
    return ray


def _check_reachable(address: str | None) -> None:
    """Raise OSError or ValueError for a host and port where nobody listens; Ray itself would wait for minutes."""
    if address is not None and "://" not in address and ":" in address:
        host, _, port = address.rpartition(":")
        socket.create_connection((host, int(port)), timeout=10.0).close()


class _RayWorker:
    """Body of an actor."""

    def __init__(self, begin: Begin) -> None:
        self._work, self._begun = begun(begin)

    def begun(self) -> Answer:
        return self._begun

    def do(self, task: Any) -> Answer:
        assert self._work is not None
        return answer_of(self._work, task)


class _Actors:
    def __init__(self, ray: ModuleType, options: dict[str, Any], begin: Begin) -> None:
        self._ray = ray
        self._actor = ray.remote(**options)(_RayWorker)
        self._begin = ray.put(begin)

    def hire(self) -> _Actor:
        actor = self._actor.remote(self._begin)
        return _Actor(self._ray, actor, actor.begun.remote())

    def answers(self, workers: Sequence[_Actor], seconds: float | None) -> list[tuple[_Actor, Answer]]:
        of_reference = {worker.reference: worker for worker in workers}
        ready, _ = self._ray.wait(list(of_reference), num_returns=1, timeout=seconds)
        return [(of_reference[reference], self._answer(reference)) for reference in ready]

    def _answer(self, reference: Any) -> Answer:
        """Read the answer of an actor; whatever Ray itself raises means that the actor or its node is gone."""
        try:
            answer: Answer = self._ray.get(reference)
            return answer
        except self._ray.exceptions.RayError as error:
            reason = str(error).strip().splitlines()[0]
            return Answer(State.DEAD, error=WorkerDiedError(f"its worker died: {reason}"))


@dataclass(eq=False)
class _Actor:
    ray: ModuleType
    actor: Any
    reference: Any

    def send(self, task: Any) -> None:
        self.reference = self.actor.do.remote(task)

    def kill(self) -> None:
        self.ray.kill(self.actor)
