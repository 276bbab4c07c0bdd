"""CPU time of a training step of ``lite``'s single frames: ``python -m tests.benchmarks.training_cost [--steps N]``.

One process with one thread, on the first training towns of the demo world (drawn on the first call). Prints
milliseconds of the processor for a frame, by part, the least of all steps: other programs only add to it. Two versions
of the code are compared by running this in turns in the folder of each.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections import defaultdict
from collections.abc import Callable, Sequence
from functools import partial
from typing import TypeVar

import torch

from predmapnet.demo_world.catalogue import default_cache
from predmapnet.frame_cache.prepare import DataOptions, DataSet, prepare_data
from predmapnet.frame_cache.scene_cache import CachedFrame
from predmapnet.machine import use_threads
from predmapnet.network.predmapnet import PredMapNet
from predmapnet.presets import preset
from predmapnet.training.data.draws import CROSSING_WEIGHT, Clips
from predmapnet.training.instants import StageTraining
from predmapnet.training.optimiser import WeightAverage, make_optimiser
from predmapnet.training.settings import LITE_STAGES

Result = TypeVar("Result")


def main(arguments: list[str] | None = None) -> int:
    """Print the table."""
    parser = argparse.ArgumentParser(prog="python -m tests.benchmarks.training_cost")
    parser.add_argument("--steps", type=int, default=10)
    parser.add_argument("--towns", type=int, default=2)
    options = parser.parse_args(arguments)
    use_threads(1)
    config, stage = preset("lite"), LITE_STAGES[0]
    data = DataOptions((DataSet("demo"),), default_cache() / "training", towns=options.towns, validation=0)
    clips = Clips(prepare_data(data, config, 1)[0], stage.augmentation, (0, 0), crossing_weight=CROSSING_WEIGHT)
    torch.manual_seed(0)
    network = PredMapNet(config).train()
    training, optimiser = StageTraining(network, stage), make_optimiser(network, stage.optimiser)
    average = WeightAverage(network, stage.optimiser.average_decay)
    costs: dict[str, list[float]] = defaultdict(list)

    def timed(name: str, part: Callable[[], Result]) -> Result:
        start = time.process_time()
        result = part()
        costs[name].append(1000 * (time.process_time() - start) / stage.batch)
        return result

    def read(draws: Sequence[int]) -> list[list[CachedFrame]]:
        return [clips[draw] for draw in draws]

    def update() -> None:
        torch.nn.utils.clip_grad_norm_(network.parameters(), stage.optimiser.clip_norm)
        optimiser.step()
        average.update(network)

    for step in range(options.steps):
        draws = range(step * stage.batch, (step + 1) * stage.batch)
        frames = timed("reading and augmentation", partial(read, draws))
        segment = timed("targets and collation", partial(clips.collate, frames))
        terms = timed("forward and losses", partial(training, segment, step))
        optimiser.zero_grad(set_to_none=True)
        timed("backward", torch.stack(list(terms.values())).sum().backward)
        timed("optimiser", update)
    least = {name: min(values) for name, values in costs.items()}
    for name, cost in least.items():
        print(f"{name:26}{cost:9.2f} ms")
    print(f"{'a frame':26}{sum(least.values()):9.2f} ms")
    return 0


if __name__ == "__main__":
    sys.exit(main())
