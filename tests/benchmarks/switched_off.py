"""What each module does in a trained network: ``python -m tests.benchmarks.switched_off [--json FILE]``.

Takes one module after the other out of the finished network and maps the test towns, on good days and where memory
should help: a camera lost, half of the images lost, all cameras dark for eight of forty frames, one frame a second.
A module that the network can do without on all of them has not earned its place. This is not Table 4 of the paper,
whose networks were trained without the module (``python -m tests.benchmarks.ablation``).
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import orjson
import torch

from predmapnet.engines import TorchEngine
from predmapnet.errors import UserError
from predmapnet.files import check_output, write_file
from predmapnet.machine import NetworkOptions
from predmapnet.mapper import Mapper
from predmapnet.network.predmapnet import PredMapNet
from predmapnet.scenes import Image, Scene
from tests.benchmarks.bad_days import Remains, measured, open_scenes, remains
from tests.real_roads.bad_scenes import FaultyImages, LostCameras, LostImages
from tests.real_roads.image_faults import Shot
from tests.real_roads.scene_views import every

DARK = range(16, 24)
"""Frames in which all cameras are dark."""
LEFT_IN_THE_DARK = 0.03
"""Of the values."""


def dark(image: Image, shot: Shot, severity: float) -> Image:
    """All cameras black for a while: a tunnel, or a recorder that hangs."""
    return (image * LEFT_IN_THE_DARK).astype(np.uint8) if shot.index in DARK else image


CONDITIONS: dict[str, Callable[[Scene, Path], Scene]] = {
    "clean": lambda scene, _: scene,
    "no front camera": lambda scene, _: LostCameras(scene, (scene.rig[0].name,)),
    "half of the images": lambda scene, _: LostImages(scene, 0.5),
    "dark for 8 of 40": lambda scene, folder: FaultyImages(scene, dark, 1, folder),
    "1 Hz": lambda scene, _: every(scene, 2),
}


def without_history_guidance(network: PredMapNet) -> None:
    """History-map guidance off: track queries do not look where their history map says."""
    network.history_guidance = None


def without_future_guidance(network: PredMapNet) -> None:
    """Short-term future guidance off: no forecasts reach the track queries."""
    future = network.future_guidance
    assert future is not None
    future.forward = lambda queries, forecasts: queries  # type: ignore[method-assign]


def without_guidance(network: PredMapNet) -> None:
    """Both kinds of guidance off."""
    without_history_guidance(network)
    without_future_guidance(network)


def without_masked_attention(network: PredMapNet) -> None:
    """Masks of the query generator off: its queries look everywhere."""
    network.query_generator.threshold = -1.0


def without_bev_memory(network: PredMapNet) -> None:
    """BEV memory off: no past map enters."""
    memory = network.temporal_bev
    assert memory is not None
    memory.forward = lambda fine, middle, *_: (fine, middle)  # type: ignore[method-assign]


def without_tracks(network: PredMapNet) -> None:
    """Tracks off: every frame knows nothing of the one before it but the BEV memory."""
    network.propagation.register_forward_hook(_forget_rows)


def _forget_rows(_module: torch.nn.Module, _inputs: object, carried: Any) -> Any:
    carried.valid = torch.zeros_like(carried.valid)
    return carried


MODULES: dict[str, Callable[[PredMapNet], None]] = {
    "all on": lambda _: None,
    "history-map guidance": without_history_guidance,
    "future guidance": without_future_guidance,
    "both kinds of guidance": without_guidance,
    "masked attention": without_masked_attention,
    "BEV memory": without_bev_memory,
    "tracks": without_tracks,
}


def run(scenes: Sequence[Scene], weights: Path | None, say: Callable[[str], None]) -> Iterator[dict[str, Any]]:
    """Yield a row per module, said as they come: figures by condition."""
    say(f"{'mAP / C-mAP without':22}" + "".join(f"{name:>20}" for name in CONDITIONS))
    for module, switch_off in MODULES.items():
        mapper = Mapper.from_checkpoint(NetworkOptions(weights=weights))
        assert isinstance(mapper.engine, TorchEngine), "graphs cannot be changed"
        switch_off(mapper.engine.network)
        found: dict[str, Remains] = {}
        with tempfile.TemporaryDirectory() as folder:
            for name, apply in CONDITIONS.items():
                found[name] = remains([measured(apply(scene, Path(folder)), mapper) for scene in scenes])
        say(
            f"{module:22}"
            + "".join(f"{figures.mean_ap:12.3f} / {figures.consistent_ap:.3f}" for figures in found.values())
        )
        yield {"without": module, "weights_sha256": mapper.weights_sha256} | {
            name: asdict(figures) for name, figures in found.items()
        }


def main(arguments: list[str] | None = None) -> int:
    """Print the table; write it if asked for."""
    parser = argparse.ArgumentParser(
        prog="python -m tests.benchmarks.switched_off", description=__doc__.splitlines()[0]
    )
    parser.add_argument("--json", type=Path, help="write all figures to this file, too")
    parser.add_argument(
        "--weights", type=Path, help="a .safetensors checkpoint of lite; the shipped weights without it"
    )
    parser.add_argument(
        "--scenes", nargs="+", default=[], metavar="N", help="the first N test towns, or names of towns"
    )
    options = parser.parse_args(arguments)
    try:
        if options.json:
            check_output(options.json)
        rows = list(run(open_scenes(options.scenes), options.weights, lambda line: print(line, flush=True)))
        if options.json:
            with write_file(options.json) as draft:
                draft.write_bytes(orjson.dumps(rows, option=orjson.OPT_INDENT_2))
    except UserError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
