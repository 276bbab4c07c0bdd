"""A step of the paper's last stage at full size: ``python -m tests.benchmarks.joint_step [--save-memory]``.

One clip of ``paper-nuscenes``, stage ``joint``: five frames of six cameras, images of 480 x 800, all losses, random
weights whose scores make tracks. Prints processor seconds by part, the least of the steps, and the largest memory of
the process; the losses are those of the last step.
"""

from __future__ import annotations

import argparse
import resource
import sys
import time
from collections import defaultdict
from collections.abc import Callable
from functools import partial
from typing import TypeVar

import torch

from predmapnet.demo_world.catalogue import default_cache
from predmapnet.frame_cache.prepare import DataOptions, DataSet, prepare_data
from predmapnet.machine import use_threads
from predmapnet.network.predmapnet import PredMapNet
from predmapnet.presets import preset
from predmapnet.training.data.draws import Clips
from predmapnet.training.instants import StageTraining
from predmapnet.training.optimiser import make_optimiser
from predmapnet.training.settings import NUSCENES_STAGES

Result = TypeVar("Result")


def main(arguments: list[str] | None = None) -> int:
    """Print the table."""
    parser = argparse.ArgumentParser(prog="python -m tests.benchmarks.joint_step")
    parser.add_argument("--steps", type=int, default=2)
    parser.add_argument("--save-memory", action="store_true", help="as of predmapnet train")
    options = parser.parse_args(arguments)
    use_threads(1)
    config, stage = preset("paper-nuscenes"), NUSCENES_STAGES[2]
    town = DataOptions((DataSet("demo"),), default_cache() / "training", towns=1, validation=0)
    clips = Clips(prepare_data(town, config, 1)[0], stage.augmentation, (0, 0), stage.frames, stage.span)
    torch.manual_seed(0)
    network = PredMapNet(config).train()
    torch.nn.init.zeros_(network.map_decoder.get_parameter("classify.bias"))
    training, optimiser = StageTraining(network, stage), make_optimiser(network, stage.optimiser)
    training.save_memory = options.save_memory
    costs: dict[str, list[float]] = defaultdict(list)
    terms: dict[str, torch.Tensor] = {}

    def timed(name: str, part: Callable[[], Result]) -> Result:
        start = time.process_time()
        result = part()
        costs[name].append(time.process_time() - start)
        return result

    for step in range(options.steps):
        segment = clips.collate([clips[step]])
        # The vector memory is in use from this step on.
        terms = timed("forward and losses", partial(training, segment, stage.memory_from_step + step))
        optimiser.zero_grad(set_to_none=True)
        timed("backward", torch.stack(list(terms.values())).sum().backward)
        timed("optimiser", optimiser.step)
    for name, values in costs.items():
        print(f"{name:22}{min(values):9.1f} CPU s")
    print(f"{'a step':22}{sum(map(min, costs.values())):9.1f} CPU s")
    print(f"{'largest memory':22}{resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20:9.1f} GiB")
    print(", ".join(f"{name} {float(term.detach()):.3g}" for name, term in terms.items()))
    return 0


if __name__ == "__main__":
    sys.exit(main())
