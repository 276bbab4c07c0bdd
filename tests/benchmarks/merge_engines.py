"""Merging in processes and on Ray, the same maps in turn: CPU seconds of the work and of the engine, and the same city.

    python -m tests.benchmarks.merge_engines [--drives 1000] [--rounds 1]

Wall times say little on a machine that does other things, too: what counts are CPU seconds, and the share of the time
in which workers had something to do.
"""

from __future__ import annotations

import argparse
import re
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import shapely

from mapfusion.executors import Begin, Executor, Finished
from mapfusion.formats.by_suffix import write_map
from mapfusion.merge.merge import merge_files
from tests.benchmarks.engine_cost import engine_seconds, executor_of
from tests.benchmarks.test_merge_city import PLANE, city, drive

JOBS = 2


@dataclass(frozen=True)
class Timed:
    """Work that returns its result with seconds: CPU of the worker, CPU of the thread that works, and wall."""

    begin: Begin

    def __call__(self) -> Callable[[Any], tuple[Any, tuple[float, float, float]]]:
        """Begin the work itself."""
        work = self.begin()

        def timed(task: Any) -> tuple[Any, tuple[float, float, float]]:
            began = _clocks()
            result = work(task)
            cpu, thread, wall = (now - then for now, then in zip(_clocks(), began, strict=True))
            return result, (cpu, thread, wall)

        return timed


def _clocks() -> tuple[float, float, float]:
    return time.process_time(), time.thread_time(), time.perf_counter()


class Stopwatch:
    """Executor that does what another one does, and adds up what the tasks take."""

    def __init__(self, executor: Executor) -> None:
        self._executor = executor
        self.cpu = self.thread = self.wall = 0.0

    def run(self, begin: Begin, tasks: Iterable[Any]) -> Iterator[Finished]:
        """Yield the ends of the tasks as they come."""
        for finished in self._executor.run(Timed(begin), tasks):
            if finished.error is None:
                result, (cpu, thread, wall) = finished.result
                self.cpu, self.thread, self.wall = self.cpu + cpu, self.thread + thread, self.wall + wall
                finished = replace(finished, result=result)
            yield finished


def write_drives(root: Path, count: int) -> list[Path]:
    """Write the maps of drives through a city that grows with their number."""
    rng = np.random.default_rng(0)
    blocks = max(2, round(np.sqrt(count / 2.5)))
    truth = city(blocks)
    tree = shapely.STRtree([shapely.LineString(element.points) for element in truth])
    paths = []
    for number in range(count):
        found = drive(truth, tree, blocks, rng)
        if len(found):
            paths.append(root / f"drive-{number:04d}.geojson")
            write_map(found, paths[-1], PLANE)
    return paths


def main() -> None:
    """Print the figures of both; fails if the cities differ."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--drives", type=int, default=1000)
    parser.add_argument("--rounds", type=int, default=1)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="merge-") as temporary:
        root = Path(temporary)
        paths = write_drives(root, options.drives)
        totals: dict[str, list[float]] = {"process": [], "ray": []}
        for _ in range(options.rounds):
            for engine, total in totals.items():
                with executor_of(engine, JOBS) as executor:
                    watch, began, wall = Stopwatch(executor), engine_seconds(), time.perf_counter()
                    merge_files(paths, root / f"city-{engine}.geojson", executor=watch)
                    own, wall = engine_seconds() - began, time.perf_counter() - wall
                total.append(watch.cpu + own)
                print(
                    f"{engine}: {len(paths)} maps, tasks {watch.cpu:.1f} CPU s "
                    f"({watch.cpu - watch.thread:.1f} in other threads), the command and its engine {own:.1f} "
                    f"CPU s; {wall:.0f} s wall, workers at work {100 * watch.wall / (JOBS * wall):.0f} % of it",
                    flush=True,
                )
        cities = {re.sub(rb'"created":"[^"]*"|[0-9a-f]{64}', b"", path.read_bytes()) for path in root.glob("city-*")}
        print(f"ray needs {sum(totals['ray']) / sum(totals['process']):.3f} of the CPU seconds of processes")
        assert len(cities) == 1, "the cities differ"


if __name__ == "__main__":
    main()
