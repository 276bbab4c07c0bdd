"""What handing out scenes costs: CPU time a scene beside the work itself, idle time of workers, memory of the command.

    python -m tests.benchmarks.engine_cost [--engine process|ray] [--scenes 10000]

The scenes are simulated: a worker returns at once the outcome of a scene, or computes for a given time.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from mapfusion.executors import Executor
from predmapnet.runs.batch_records import Outcome
from predmapnet.runs.process_executor import ProcessExecutor
from predmapnet.runs.scene_choice import ListedScene

REPORT = {
    "elements": {"ped_crossing": 12, "divider": 31, "boundary": 24},
    "metres": {"ped_crossing": 210.0, "divider": 900.0, "boundary": 1300.0},
    "frames": 40,
    "seconds": 8.0,
    "frames_per_second": 5.0,
    "written": ["scene.geojson"],
}


@dataclass(frozen=True)
class Simulated:
    """Work that takes some CPU seconds a scene and returns what mapping would."""

    seconds: float = 0.0

    def __call__(self) -> Callable[[ListedScene], Outcome]:
        """Nothing to open."""
        return self.work

    def work(self, scene: ListedScene) -> Outcome:
        """Compute for the given CPU time."""
        began, wall = time.process_time(), time.perf_counter()
        while time.process_time() - began < self.seconds:
            pass
        return Outcome(scene.name, "done", time.perf_counter() - wall, REPORT)


def resident() -> float:
    """Memory of this process, MB."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * 4096 / 2**20


def executor_of(engine: str, jobs: int) -> Executor:
    """Return an executor of one kind."""
    if engine == "process":
        return ProcessExecutor(jobs)
    from predmapnet.runs.ray_executor import RayExecutor

    return RayExecutor(jobs=jobs)


def main() -> None:
    """Print the three figures; the rates of one and two workers compare only on cores that do nothing else."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--engine", default="process")
    parser.add_argument("--scenes", type=int, default=10_000)
    parser.add_argument("--seconds", type=float, default=0.2, help="CPU seconds of a scene when the speed is compared")
    options = parser.parse_args()
    executor = executor_of(options.engine, 2)
    scenes = (ListedScene(f"scene-{number:05d}", Path("/data")) for number in range(options.scenes))
    memory, wall, cpu = [], 0.0, 0.0
    for done, finished in enumerate(executor.run(Simulated(), scenes), start=1):
        assert finished.error is None
        if done == options.scenes // 10:
            wall, cpu = time.perf_counter(), time.process_time()
            memory.append(resident())
    count = options.scenes - options.scenes // 10
    memory.append(resident())
    print(
        f"{options.engine}: {1e3 * (time.process_time() - cpu) / count:.2f} CPU ms of the command a scene "
        f"({1e3 * (time.perf_counter() - wall) / count:.2f} ms wall, two workers); memory {memory[0]:.1f} MB after a "
        f"tenth of {options.scenes} scenes, {memory[1]:.1f} MB after all"
    )
    for jobs in (1, 2):
        run = executor_of(options.engine, jobs).run(Simulated(options.seconds), map(ListedScene, map(str, range(40))))
        for _ in range(jobs):  # by then all have begun
            next(run)
        began, worked, count = time.perf_counter(), 0.0, 0
        for finished in run:
            worked, count = worked + finished.result.seconds, count + 1
            ended = time.perf_counter()
            if count == 40 - 2 * jobs:  # the last ones run alone
                break
        run.close()
        print(
            f"{options.engine}, {jobs} at work: {count / (ended - began):.2f} scenes/s; workers had work "
            f"{100 * worked / (jobs * (ended - began)):.1f} % of the time"
        )


if __name__ == "__main__":
    main()
