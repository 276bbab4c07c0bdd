"""Cost of a frame: CPU seconds and multiply-adds per part of the network, with the paper's modules on in turn.

    python -m tests.benchmarks.network_cost paper-nuscenes --threads 2

Weights are random, the state is that of a drive of some frames with 30 tracks. CPU seconds are those of all threads.
The floor is what the multiply-adds alone would take at the highest rate of matrix products that was seen here.
"""

from __future__ import annotations

import argparse
import os
import resource
import time
from collections.abc import Iterator
from dataclasses import dataclass
from statistics import median

from predmapnet.machine import use_threads

if __name__ == "__main__":  # Before torch is imported.
    arguments = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    arguments.add_argument("preset", nargs="?", default="paper-nuscenes")
    arguments.add_argument("--threads", type=int, default=0, help="0: all cores")
    arguments.add_argument("--frames", type=int, default=5, help="that are measured")
    options = arguments.parse_args()
    use_threads(options.threads)

import torch
from torch.utils.flop_counter import FlopCounterMode

from predmapnet.config import PredMapNetConfig
from predmapnet.demo_world.rig import DEMO_RIG
from predmapnet.network.calibration import calibrate
from predmapnet.network.image_input import input_size
from predmapnet.network.kernels.inference import for_inference
from predmapnet.network.kernels.matrix_product import linear
from predmapnet.network.predmapnet import PredMapNet
from predmapnet.network.state import FrameInputs, FrameOutputs, ImageFeatures, Instances, StreamState
from predmapnet.network.track_selection import instances_from_rows, select
from predmapnet.presets import preset
from tests.benchmarks.part_costs import OF_THE_PAPER, PARTS, THE_REST, Ledger, parameters_of_parts

TRACKS = 30
FRAMES_BEFORE = 4
METRES_PER_FRAME = 4.0
OFFICIAL_SECONDS = (23.4, 25.7)
"""CPU seconds per frame of the official MapTracker at 480 x 800 on a machine of two cores."""


def modules_in_turn(config: PredMapNetConfig) -> dict[str, PredMapNetConfig]:
    """Return the configurations from the baseline, without any of the paper's modules, to all of them."""
    semantic, history, future = config.semantic_queries, config.history_map, config.future
    off: dict[str, object] = {
        "semantic_queries": semantic.model_copy(update={"enabled": False}),
        "history_map": history.model_copy(update={"memory": False, "guidance": False}),
        "future": future.model_copy(update={"enabled": False}),
        "depth": config.depth.model_copy(update={"enabled": False}),
    }
    turns: list[tuple[str, dict[str, object]]] = [
        ("baseline", {}),
        ("+ semantic-aware query generator", {"semantic_queries": semantic}),
        ("+ history map memory", {"history_map": history.model_copy(update={"guidance": False})}),
        ("+ history-map guidance", {"history_map": history}),
        ("+ short-term future guidance (all)", {"future": future}),
    ]
    configs = {}
    for name, on in turns:
        off |= on
        configs[name] = config.model_copy(update=off)
    return configs


@dataclass
class Drive:
    """A network that drives straight on and sees noise.

    Attributes:
        network: made for inference.
        state: after the last frame; None before the first.
    """

    network: PredMapNet
    state: StreamState | None = None

    def __post_init__(self) -> None:
        self.calibration = calibrate(DEMO_RIG, self.network.config)
        self.geometry = self.network.view_geometry(self.calibration)

    def inputs(self, frame: int) -> FrameInputs:
        """Return the inputs of a frame."""
        pose = torch.eye(4, dtype=torch.float64)[None].clone()
        pose[0, 0, 3] = METRES_PER_FRAME * frame
        images = torch.randn(1, len(DEMO_RIG), 3, *input_size(self.network.config.image))
        return FrameInputs(images, torch.ones(1, len(DEMO_RIG), dtype=torch.bool), pose, self.calibration)

    def step(self, inputs: FrameInputs, ledger: Ledger, images: ImageFeatures | None = None) -> ImageFeatures:
        """Map one frame; return the image features, which another network of the same backbone may take."""
        network = self.network
        with ledger.watching(network), ledger.running(THE_REST):
            if images is None:
                images = network.encode_images(inputs)
            bev = network.encode_bev(images, inputs, self.state, self.geometry)
            outputs = network.decode_bev(bev, inputs, self.state)
            select(outputs, self.state, network.config)
            self.state = network.advance(self.state, outputs, first_rows(outputs), inputs)
        return images


def first_rows(outputs: FrameOutputs) -> Instances:
    """Let the first rows live on, whatever their scores: the tracks, or detections in the first frame."""
    rows = torch.arange(TRACKS)[None]
    return instances_from_rows(outputs, rows, rows >= 0, rows)


def matrix_rate() -> float:
    """Return the multiply-adds per second of CPU time of matrix products, at best."""
    tokens, weight = torch.randn(9216, 1024), torch.randn(1024, 1024)
    seconds = []
    for _ in range(8):
        start = time.process_time()
        linear(tokens, weight)
        seconds.append(time.process_time() - start)
    return tokens.numel() * len(weight) / min(seconds)


@torch.inference_mode()
def report(name: str, frames: int) -> Iterator[str]:
    """Measure a preset and tell about it, line by line."""
    torch.manual_seed(0)
    memory_before = peak_megabytes()
    config = preset(name)
    network = PredMapNet(config)
    parameters = parameters_of_parts(network)
    drive = Drive(for_inference(network))
    del network
    ledgers = []
    for frame in range(FRAMES_BEFORE + frames):
        ledgers.append(Ledger(time.process_time))
        drive.step(drive.inputs(frame), ledgers[-1])
    seconds = {part: median(ledger.costs.get(part, 0.0) for ledger in ledgers[-frames:]) for part in (*PARTS, THE_REST)}
    memory = peak_megabytes()
    with FlopCounterMode(display=False) as counter:
        products = Ledger(lambda: counter.get_total_flops() / 2)
        drive.step(drive.inputs(FRAMES_BEFORE + frames), products)
    rate = matrix_rate()

    yield f"{name}: {len(DEMO_RIG)} cameras, {' x '.join(map(str, input_size(config.image)))} pixels, {TRACKS} tracks"
    yield f"{torch.get_num_threads()} threads, load {os.getloadavg()[0]:.1f}, torch {torch.__version__}"
    yield f"matrix products: {rate / 1e9:.0f} thousand million multiply-adds per CPU second"
    yield f"peak memory: {memory:.0f} MB, of which {memory_before:.0f} MB before there was a network"
    yield ""
    yield f"{'part':40s}{'CPU ms':>9s}{'floor':>9s}{'G mult-adds':>13s}{'M parameters':>14s}"
    for part in (*PARTS, THE_REST, "all"):
        columns = (seconds, products.costs, parameters)
        cost, multiply_adds, size = (
            sum(column.values()) if part == "all" else column.get(part, 0) for column in columns
        )
        if cost or multiply_adds or size:
            floor = multiply_adds / rate
            yield f"{part:40s}{1e3 * cost:9.1f}{1e3 * floor:9.1f}{multiply_adds / 1e9:13.2f}{size / 1e6:14.2f}"
    added = sum(seconds[part] for part in OF_THE_PAPER)
    yield ""
    yield f"the paper's modules add {added / (sum(seconds.values()) - added):.1%} to the parts of the baseline"
    if name == "paper-nuscenes":
        official = [sum(seconds.values()) / official for official in OFFICIAL_SECONDS]
        yield f"the official MapTracker takes {OFFICIAL_SECONDS} CPU s: {official[1]:.2f} to {official[0]:.2f} of that"
    yield ""
    yield from in_turn(config, frames)


def in_turn(config: PredMapNetConfig, frames: int) -> Iterator[str]:
    """Tell what a frame costs with one module more each time.

    All networks see the same image features, computed once per frame, so that they differ in what is measured only.
    """
    drives = {name: Drive(for_inference(PredMapNet(changed))) for name, changed in modules_in_turn(config).items()}
    totals: dict[str, list[float]] = {name: [] for name in drives}
    for frame in range(FRAMES_BEFORE + frames):
        images, inputs, shared = None, None, 0.0
        for name, drive in drives.items():
            inputs = inputs or drive.inputs(frame)
            start = time.process_time()
            if images is None:
                images = drive.network.encode_images(inputs)
                shared = time.process_time() - start
                start = time.process_time()
            drive.step(inputs, Ledger(time.process_time), images)
            totals[name].append(shared + time.process_time() - start)
    seconds = {name: median(values[-frames:]) for name, values in totals.items()}
    yield f"{'modules':40s}{'CPU ms':>9s}{'ratio':>8s}{'M parameters':>14s}"
    for name, drive in drives.items():
        size = sum(parameter.numel() for parameter in drive.network.parameters())
        yield f"{name:40s}{1e3 * seconds[name]:9.1f}{seconds[name] / seconds['baseline']:8.3f}{size / 1e6:14.2f}"
    if config.depth.enabled and images is not None:
        head = PredMapNet(config).depth_head
        assert head is not None
        start = time.process_time()
        head(images.levels[0].flatten(0, 1))
        cost = time.process_time() - start
        size = sum(parameter.numel() for parameter in head.parameters())
        yield f"{'+ depth (forward pass, training only)':40s}{1e3 * cost:9.1f}{'':8s}{size / 1e6:14.2f}"


def peak_megabytes() -> float:
    """Return the most memory that this process has had."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


if __name__ == "__main__":
    for line in report(options.preset, options.frames):
        print(line, flush=True)
