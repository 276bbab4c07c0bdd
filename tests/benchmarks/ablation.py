"""What each part of the paper gains: ``python -m tests.benchmarks.ablation --out FOLDER [--steps N | --minutes N]``.

Trains the network anew with one part after the other added, as in Table 4 of the paper, and with other numbers of
histories (n, appendix), each with the same data and budget and from several seeds; prints mean and standard deviation
over the seeds of chamfer mAP and C-mAP on the validation scenes. ``--init WEIGHTS`` is the short form for ``lite``: all
rows begin from a network that sees, without the parts that the first row lacks, and learn the temporal stage only.
``--data`` and ``--data-root`` are those of ``predmapnet train``. What is trained or measured already in ``--out`` is
not done again, so the command may be ended and repeated. ``lite`` learns no depth; its table ends before that.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import orjson
import torch

from predmapnet.config import PredMapNetConfig
from predmapnet.demo_world.catalogue import default_cache
from predmapnet.errors import UserError
from predmapnet.files import check_output, write_file
from predmapnet.frame_cache.prepare import DataOptions, parse_data_sets, prepare_data
from predmapnet.network.predmapnet import PredMapNet
from predmapnet.presets import preset
from predmapnet.runs.train import WEIGHTS, RunOptions, train_network
from predmapnet.training.loop import LoopSettings
from predmapnet.training.plan import PlanOptions
from predmapnet.training.processes import usual_devices
from predmapnet.training.run_checkpoint import latest
from predmapnet.training.validation import validate
from predmapnet.weights.checkpoint import load_checkpoint, save_checkpoint
from predmapnet.weights.fit import start_from

HISTORIES = (2, 3, 4, 5, 6)
FIGURES = ("mAP", "C-mAP", "ped_crossing", "divider", "boundary")
RESULT = "result.json"


@dataclass(frozen=True)
class Variant:
    """One row of a table: its name, the name of its runs, and the network. Rows of the same runs are trained once."""

    name: str
    runs: str
    config: PredMapNetConfig


def variants(whole: PredMapNetConfig) -> Iterator[Variant]:
    """Yield the rows of Table 4, each with one part more, then those of the numbers of histories, with all parts."""
    off: dict[str, dict[str, object]] = {
        "semantic_queries": {"enabled": False},
        "history_map": {"memory": False, "guidance": False},
        "future": {"enabled": False},
        "depth": {"enabled": False},
    }
    names = ("semantic-aware queries", "history-map guidance", "short-term future guidance", "auxiliary depth")
    yield Variant("baseline", "0", _changed(whole, off))
    for number, (section, name) in enumerate(zip(list(off), names, strict=True), start=1):
        del off[section]
        if section != "depth" or whole.depth.enabled:
            yield Variant(f"+ {name}", "whole" if _changed(whole, off) == whole else f"{number}", _changed(whole, off))
    for count in HISTORIES:
        config = _changed(whole, {"future": {"histories": count}})
        yield Variant(f"n = {count}", "whole" if config == whole else f"n{count}", config)


def _changed(config: PredMapNetConfig, sections: dict[str, dict[str, object]]) -> PredMapNetConfig:
    changed = {name: getattr(config, name).model_copy(update=values) for name, values in sections.items()}
    return config.model_copy(update=changed)


def say(line: str) -> None:
    """Tell what is being done; the tables alone go to the standard output."""
    print(line, file=sys.stderr, flush=True)


def measured(options: RunOptions) -> dict[str, float]:
    """Train and measure one network, or what is left of that.

    Raises:
        KeyboardInterrupt: the run was interrupted; it goes on the next time.
    """
    result, weights = options.folder / RESULT, options.folder / WEIGHTS
    if result.exists():
        stored: dict[str, float] = orjson.loads(result.read_bytes())
        return stored
    if not weights.exists():
        say(f"training {options.folder}")
        resume = latest(options.folder) is not None
        if train_network(RunOptions(**{**vars(options), "resume": resume}), say) is None:
            raise KeyboardInterrupt
    _, validation = prepare_data(options.data, options.config, options.plan.devices, lambda _line: None)
    if not validation:
        raise UserError("There is no validation scene in these data, so nothing can be measured.")
    network = load_checkpoint(weights).network.eval().to(options.device)
    figures = {name: value for name, value in validate(network, validation, streaming=True).items() if name in FIGURES}
    with write_file(result) as draft:
        draft.write_bytes(orjson.dumps(figures))
    return figures


def common_start(config: PredMapNetConfig, weights: Path, folder: Path) -> Path:
    """Write what rows begin from: of some weights those that the first row's network has; the rest begins at random.

    Raises:
        UserError: the weights are not there, or do not fit.
    """
    network, path = PredMapNet(config), folder / "start.safetensors"
    own = network.state_dict()
    tensors = load_checkpoint(weights).network.state_dict()
    start_from(network, {name: value for name, value in tensors.items() if name in own}, weights)
    save_checkpoint(path, network, {"initial": weights.name})
    return path


def check_same(folder: Path, terms: str) -> None:
    """Note what all runs of a folder have in common. Raises UserError if it was something else before."""
    folder.mkdir(parents=True, exist_ok=True)
    note = folder / "terms.txt"
    if note.exists() and note.read_text() != terms:
        raise UserError(f"{folder} holds runs of other terms ({note.read_text()}). Choose another --out.")
    note.write_text(terms)


def row(name: str, figures: Sequence[dict[str, float]]) -> str:
    """Return mean and standard deviation of all figures."""
    cells = []
    for figure in FIGURES:
        values = [each[figure] for each in figures]
        spread = float(np.std(values, ddof=1)) if len(values) > 1 else float("nan")
        cells.append(f"{np.mean(values):8.3f} ± {spread:.3f}")
    return f"{name:30}" + "".join(cells)


def main(arguments: list[str] | None = None) -> int:
    """Print both tables; write every figure if asked for."""
    parser = argparse.ArgumentParser(prog="python -m tests.benchmarks.ablation", description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, required=True, help="folder of the runs")
    parser.add_argument("--preset", default="lite", help="of the whole network")
    parser.add_argument("--data", nargs="+", default=["demo"], help="as of predmapnet train")
    parser.add_argument("--data-root", nargs="+", type=Path, default=[], help="as of predmapnet train")
    parser.add_argument("--split-scheme", choices=["old", "new"], default="old")
    parser.add_argument("--towns", type=int, default=160, help="training scenes of the demo world")
    parser.add_argument("--validation", type=int, default=10, help="most validation scenes of each data set")
    parser.add_argument("--steps", type=int, help="of each stage, instead of its epochs")
    parser.add_argument("--minutes", type=float, help="lite: of each run, instead of its epochs")
    parser.add_argument("--batch", type=int, help="as of predmapnet train")
    parser.add_argument("--init", type=Path, help="lite: weights that all rows begin from, for the temporal stage only")
    parser.add_argument("--seeds", type=int, default=2, help="runs of each row")
    parser.add_argument("--device", choices=["cpu", "cuda"], default="cpu")
    parser.add_argument("--devices", type=int, help="as of predmapnet train")
    parser.add_argument("--workers", type=int, default=0, help="as of predmapnet train")
    parser.add_argument("--only", nargs="+", default=[], metavar="NAME", help="only rows whose name holds one of these")
    parser.add_argument("--json", type=Path, help="write all figures to this file, too")
    options = parser.parse_args(arguments)
    devices = options.devices or usual_devices(options.device)
    found: dict[str, list[dict[str, float]]] = {}
    torch.set_num_threads(1)
    try:
        if options.json:
            check_output(options.json)
        sets = parse_data_sets(options.data, options.data_root)
        cache = default_cache() / "training"
        data = DataOptions(sets, cache, options.towns, options.validation, options.split_scheme)
        plan = PlanOptions(devices, options.batch, 1, None, options.steps, options.minutes)
        start = "" if options.init is None else f"; temporal from {options.init.name}"
        check_same(options.out, f"{options.preset}; {plan}; {data!r}{start}")
        rows = [
            variant
            for variant in variants(preset(options.preset))
            if not options.only or any(word in variant.name for word in options.only)
        ]
        if not rows:
            raise UserError("No row has such a name. Choose words of the table, such as baseline, history or future.")
        initial = None if options.init is None else common_start(rows[0].config, options.init, options.out)
        for variant in rows:
            found[variant.name] = [
                measured(
                    RunOptions(
                        variant.config,
                        data,
                        options.out / f"{variant.runs}-seed{seed}",
                        stage="all" if initial is None else "temporal",
                        plan=plan,
                        loop=LoopSettings(seed, sync_norms=options.device == "cuda"),
                        device=options.device,
                        workers=options.workers,
                        initial=initial,
                    )
                )
                for seed in range(options.seeds)
            ]
        print(f"{'':30}" + "".join(f"{figure:>16}" for figure in FIGURES))
        for name, figures in found.items():
            print(row(name, figures), flush=True)
        if options.json:
            with write_file(options.json) as draft:
                draft.write_bytes(orjson.dumps(found, option=orjson.OPT_INDENT_2))
    except UserError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("Stopped; the same command goes on.", file=sys.stderr)
        return 130
    return 0


if __name__ == "__main__":
    sys.exit(main())
