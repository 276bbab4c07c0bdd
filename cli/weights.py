"""``predmapnet weights``: import public weights, and see what a file holds."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from predmapnet.weights.inspection import WeightsInfo
    from predmapnet.weights.maptracker_import import ImportReport

weights = typer.Typer(
    name="weights", help="Import public weights, and see what a weights file holds.", no_args_is_help=True
)


@weights.command("import")
def import_weights(
    checkpoint: Annotated[Path, typer.Argument(help="Checkpoint that MapTracker published (.pth).", metavar="FILE")],
    out: Annotated[Path, typer.Option("--out", "-o", help="Weights to write (.safetensors).")],
) -> None:
    """Turn a MapTracker checkpoint into weights for PredMapNet.

    Nothing in the file is executed; entries that do not fit are an error.
    """
    from predmapnet.errors import UserError
    from predmapnet.files import check_output

    if out.suffix != ".safetensors":
        raise UserError(f"Weights are written as safetensors: name a file that ends so, not {out.name}.")
    check_output(out)
    from predmapnet.weights.checkpoint import save_checkpoint, weights_hash
    from predmapnet.weights.maptracker_import import import_maptracker, read_official_checkpoint

    network, report = import_maptracker(read_official_checkpoint(checkpoint))
    facts = {"imported_from": checkpoint.name, "sha256_of_source": weights_hash(checkpoint)}
    save_checkpoint(out, network, facts)
    _say_import(report, out)


@weights.command("inspect")
def inspect_weights(
    file: Annotated[Path, typer.Argument(help="Weights (.safetensors).", metavar="FILE")],
    names: Annotated[bool, typer.Option("--names", help="List every tensor.")] = False,
) -> None:
    """Show what a weights file holds: the network, its parts, and where it comes from."""
    from predmapnet.weights.inspection import inspect_file

    _say_weights(inspect_file(file), names)


def _say_import(report: ImportReport, path: Path) -> None:
    from cli.console import out

    out.print(f"{len(report.mapped)} entries mapped, none unexplained", markup=False)
    reasons: dict[str, int] = {}
    for reason in report.ignored.values():
        kind = "repetitions of a branch that all decoder layers share" if reason.startswith("repeats") else reason
        reasons[kind] = reasons.get(kind, 0) + 1
    for reason, count in reasons.items():
        out.print(f"{count} ignored: {reason}", markup=False)
    if report.missing:
        out.print(f"{len(report.missing)} missing that inference does without (counters of batches)", markup=False)
    out.print(f"written: {path}", markup=False)


def _say_weights(info: WeightsInfo, names: bool) -> None:
    from rich.table import Table

    from cli.console import out

    about = info.about
    if about:
        out.print(f"{about['configuration']['name']}, written by predmapnet {about['version']}", markup=False)
    else:
        out.print("not written by PredMapNet", markup=False)
    for name, value in dict(about.get("facts", {})).items():
        out.print(f"{name.replace('_', ' ')}: {value}", markup=False)
    table = Table("tensor" if names else "part", show_edge=False, pad_edge=False)
    if names:
        table.add_column("shape")
        table.add_column("type")
        for tensor in info.tensors:
            table.add_row(tensor.name, " x ".join(map(str, tensor.shape)) or "1", tensor.kind)
    else:
        table.add_column("numbers", justify="right")
        for part, count in info.parts().items():
            table.add_row(part, f"{count:,}")
    out.print(table)
    total = sum(tensor.count for tensor in info.tensors)
    out.print(f"{len(info.tensors)} tensors, {total:,} numbers, {info.size / 1e6:.1f} MB", markup=False)
