"""A drive through the network at its own size, in torch and in ONNX Runtime: what differs, and what both cost.

    python -m tests.benchmarks.onnx_agreement [--preset paper-nuscenes] [--frames 40] [--rows 300] [--graphs FOLDER]

Weights and images are random; thresholds are set so that some rows become tracks, and some tracks end. One thread.
``--graphs`` keeps the exported graphs, or takes those that lie there; export takes minutes.
"""

from __future__ import annotations

import argparse
import resource
import sys
import tempfile
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import TypeVar

import numpy as np
import torch

from predmapnet.config import PredMapNetConfig
from predmapnet.engines import Engine, TorchEngine
from predmapnet.export.engine import OnnxEngine
from predmapnet.export.onnx_files import export_graphs, read_graph_folder
from predmapnet.machine import Precision, use_threads
from predmapnet.network.state import Instances, StreamState
from predmapnet.presets import preset
from tests.predmapnet.export.test_onnx_graphs import TOLERANCE, drive, networks_checkpoint, rows_of
from tests.predmapnet.small_networks import changed

THRESHOLDS = {"first_tau_d": 0.57, "tau_d": 0.625, "tau_t": 0.67}
"""Random weights score everything between 0.5 and 0.7, and the more tracks there are, the higher: where tracks live on
as easily as they are born, there are soon more than 300."""
Result = TypeVar("Result")


def timed(seconds: list[float], work: Callable[[], Result]) -> Result:
    """Return what some work returns, and note the processor's seconds."""
    start = time.process_time()
    result = work()
    seconds.append(time.process_time() - start)
    return result


def apart(mine: Instances, theirs: Instances, size: np.ndarray) -> tuple[bool, float, float]:
    """Return whether rows are the same, and by how much their points (metres) and scores differ at most."""
    one, other = rows_of(mine), rows_of(theirs)
    if not all(np.array_equal(one[name], other[name]) for name in ("track_ids", "labels")):
        return False, np.inf, np.inf
    points, scores = (np.abs(one[name] - other[name]) for name in ("points", "scores"))
    return True, float((points * size).max(initial=0.0)), float(scores.max(initial=0.0))


def main(arguments: list[str] | None = None) -> int:
    """Print a line a frame, and the worst; 1 where the engines differ."""
    parser = argparse.ArgumentParser(prog="python -m tests.benchmarks.onnx_agreement")
    parser.add_argument("--preset", default="paper-nuscenes")
    parser.add_argument("--frames", type=int, default=40)
    parser.add_argument("--rows", type=int, default=300)
    parser.add_argument("--graphs", type=Path)
    options = parser.parse_args(arguments)
    use_threads(1)
    sections = changed(preset(options.preset).model_dump(), {"tracking": THRESHOLDS})
    config = PredMapNetConfig.model_validate(sections)
    checkpoint = networks_checkpoint(config)
    seconds: tuple[list[float], list[float], list[float]] = ([], [], [])
    with tempfile.TemporaryDirectory() as temporary:
        folder = options.graphs or Path(temporary) / "graphs"
        if not folder.exists():
            timed(seconds[2], lambda: export_graphs(checkpoint, folder, options.rows))
            print(f"exported in {seconds[2][0]:.0f} CPU s", flush=True)
        graphs = read_graph_folder(folder)
        assert graphs.config == config, f"{folder} holds graphs of another network"
        in_torch = TorchEngine(checkpoint.network, "cpu", Precision.FLOAT32, compiled=False)
        engines: tuple[Engine, Engine] = in_torch, OnnxEngine(graphs, 1)
    states: list[StreamState | None] = [None, None]
    size, worst = np.array([config.roi_length, config.roi_width]), np.zeros(2)
    with torch.inference_mode():
        for index, inputs in enumerate(drive(config, options.frames)):
            found = []
            for number, engine in enumerate(engines):
                selection, states[number], _ = timed(seconds[number], partial(engine.step, inputs, states[number]))
                found.append(selection)
            tracks = apart(found[0].instances, found[1].instances, size)
            others = apart(found[0].detections, found[1].detections, size)
            worst = np.maximum(worst, np.maximum(tracks[1:], others[1:]))
            held = int(found[0].instances.valid.sum())
            print(f"frame {index}: {held} tracks, points {worst[0]:.1e} m, scores {worst[1]:.1e} so far", flush=True)
            if not (tracks[0] and others[0]) or held > options.rows:
                print("The engines do not track the same." if held <= options.rows else "More tracks than --rows.")
                return 1
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    print(f"CPU s a frame: torch {np.mean(seconds[0]):.1f}, ONNX Runtime {np.mean(seconds[1]):.1f}; {memory:.1f} GiB")
    return int(worst.max() > TOLERANCE)


if __name__ == "__main__":
    sys.exit(main())
