"""What handing out scenes costs: CPU time a scene beside the work itself, idle time of workers, memory of the command.

    python -m tests.benchmarks.engine_cost [--engine process|ray] [--scenes 10000] [--mapped 12] [--rounds 2]

For the memory, scenes are simulated: a worker returns the outcome of a scene at once. For the speed small scenes are
mapped, with one worker and with two in turn. Wall times say little on a machine that does other things, too, so the
gain of the second worker is put together from CPU seconds a scene and from the share of the time in which workers had
work; it is what two cores give that do nothing else.
"""

from __future__ import annotations

import argparse
import os
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import astuple, dataclass
from pathlib import Path

import numpy as np

from mapfusion.executors import Executor
from predmapnet.machine import NetworkOptions
from predmapnet.runs.batch import BatchSettings, SceneWork
from predmapnet.runs.batch_records import Outcome
from predmapnet.runs.output_folder import OutputFolder
from predmapnet.runs.process_executor import ProcessExecutor
from predmapnet.runs.scene_choice import ListedScene
from predmapnet.weights.files import weights_hash
from tests.cli.random_weights import write_random_weights
from tests.cli.tiny_nuscenes import write_tiny_nuscenes

REPORT = {
    "elements": {"ped_crossing": 12, "divider": 31, "boundary": 24},
    "metres": {"ped_crossing": 210.0, "divider": 900.0, "boundary": 1300.0},
    "frames": 40,
    "seconds": 8.0,
    "frames_per_second": 5.0,
    "written": ["scene.geojson"],
}


RAY_ITSELF = (b"raylet", b"gcs_server")
"""Processes of Ray that hand out tasks."""


@dataclass(frozen=True)
class Simulated:
    """Work that returns at once what mapping would."""

    def __call__(self) -> Callable[[ListedScene], Outcome]:
        """Nothing to open."""
        return lambda scene: Outcome(scene.name, "done", 0.0, REPORT)


@dataclass(frozen=True)
class Timed:
    """Work of a batch that returns CPU and wall seconds of each scene."""

    mapping: SceneWork

    def __call__(self) -> Callable[[ListedScene], tuple[float, float]]:
        """Open the network."""
        work = self.mapping()

        def timed(scene: ListedScene) -> tuple[float, float]:
            cpu, wall = time.process_time(), time.perf_counter()
            outcome = work(scene)
            assert outcome.status == "done", outcome.reason
            return time.process_time() - cpu, time.perf_counter() - wall

        return timed


@dataclass(frozen=True)
class Speed:
    """Figures of one run: CPU seconds a scene of the workers and of the engine, and the share with work to do."""

    scene: float
    engine: float
    busy: float
    wall: float


def speed(engine: str, jobs: int, work: Timed, scenes: Sequence[ListedScene]) -> Speed:
    """Map scenes, and measure from when all workers have begun until the first of them has nothing more to do."""
    with executor_of(engine, jobs) as executor:
        run = iter(executor.run(work, scenes))
        for _ in range(2 * jobs):  # by then all have begun, and have mapped one
            next(run)
        wall, cpu = time.perf_counter(), engine_seconds()
        found = [next(run).result for _ in range(len(scenes) - 3 * jobs)]
        wall, cpu = time.perf_counter() - wall, engine_seconds() - cpu
        list(run)
    scene, worked = np.sum(found, axis=0)
    return Speed(scene / len(found), cpu / len(found), worked / (jobs * wall), wall / len(found))


def resident() -> float:
    """Memory of this process, MB."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * 4096 / 2**20


def engine_seconds() -> float:
    """CPU seconds of this process and of Ray's own below it, workers left out."""
    parents, seconds = {}, {}
    for folder in Path("/proc").glob("[0-9]*"):
        with suppress(OSError):
            fields = (folder / "stat").read_text().rpartition(")")[2].split()
            parents[int(folder.name)] = int(fields[1])
            if (folder / "cmdline").read_bytes().split(b"\0")[0].rpartition(b"/")[2] in RAY_ITSELF:
                seconds[int(folder.name)] = (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")

    def ours(process: int) -> bool:
        return process == os.getpid() or (process in parents and ours(parents[process]))

    return time.process_time() + sum(spent for process, spent in seconds.items() if ours(process))


@contextmanager
def executor_of(engine: str, jobs: int) -> Iterator[Executor]:
    """Yield an executor of one kind."""
    if engine == "process":
        yield ProcessExecutor(jobs)
        return
    from predmapnet.runs.ray_executor import RayExecutor

    executor = RayExecutor(jobs=jobs)
    try:
        yield executor
    finally:
        executor.close()


def main() -> None:
    """Print memory and cost of the command, and what a second worker gains."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--engine", default="process")
    parser.add_argument("--scenes", type=int, default=10_000)
    parser.add_argument("--mapped", type=int, default=12, help="scenes of each run when the speed is compared")
    parser.add_argument("--rounds", type=int, default=2)
    options = parser.parse_args()
    if options.scenes < 10 or options.mapped < 7:
        parser.error("It takes 10 scenes, and 7 that are mapped: the first and the last are not measured.")
    scenes = (ListedScene(f"scene-{number:05d}", Path("/data")) for number in range(options.scenes))
    memory, wall, cpu = [], 0.0, 0.0
    with executor_of(options.engine, 2) as executor:
        for done, finished in enumerate(executor.run(Simulated(), scenes), start=1):
            assert finished.error is None
            if done == options.scenes // 10:
                wall, cpu = time.perf_counter(), engine_seconds()
                memory.append(resident())
        wall, cpu = time.perf_counter() - wall, engine_seconds() - cpu
    count = options.scenes - options.scenes // 10
    memory.append(resident())
    print(
        f"{options.engine}: {1e3 * cpu / count:.2f} CPU ms of the engine a scene ({1e3 * wall / count:.2f} ms wall, "
        f"two workers); memory of the command {memory[0]:.1f} MB after a tenth of {options.scenes} scenes, "
        f"{memory[1]:.1f} MB after all",
        flush=True,
    )
    with tempfile.TemporaryDirectory(prefix="engine-") as temporary:
        _compare(options.engine, Path(temporary), options.mapped, options.rounds)


def _compare(engine: str, root: Path, count: int, rounds: int) -> None:
    """Map scenes with one and with two workers in turn, and print the gain."""
    names = tuple(f"scene-{number:04d}" for number in range(count))
    data, weights = write_tiny_nuscenes(root / "data", names, frames=20), write_random_weights(root / "w.safetensors")
    (root / "maps").mkdir()
    network = NetworkOptions(weights)
    settings = BatchSettings("nuscenes", data, network, weights_sha256=weights_hash(weights))
    work = Timed(SceneWork(OutputFolder(str(root / "maps")), settings))
    found: dict[int, list[Speed]] = {1: [], 2: []}
    for _ in range(rounds):
        for jobs in found:
            found[jobs].append(speed(engine, jobs, work, [ListedScene(name, data) for name in names]))
    one, two = (Speed(*np.mean([astuple(run) for run in found[jobs]], axis=0)) for jobs in (1, 2))
    for jobs, run in ((1, one), (2, two)):
        print(
            f"{engine}, {jobs} at work: {run.scene:.2f} CPU s a scene, the engine {1e3 * run.engine:.1f} CPU ms "
            f"({100 * run.engine / run.wall:.1f} % of a core), "
            f"workers without work {100 * (1 - run.busy):.2f} % of the time; "
            f"{run.wall:.2f} s wall a scene at load {os.getloadavg()[0]:.0f}"
        )
    gain = 2 * two.busy / (two.scene + two.engine) * one.scene / one.busy
    print(f"{engine}: a second worker multiplies the speed by {gain:.2f}; by wall time here, {one.wall / two.wall:.2f}")


if __name__ == "__main__":
    main()
