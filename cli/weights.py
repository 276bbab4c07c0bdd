"""``predmapnet weights``: import public weights, export graphs, inspect weights files."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from cli.options import Json
from cli.plain_help import PlainCommand

if TYPE_CHECKING:
    from predmapnet.weights.imagenet_import import BackboneReport
    from predmapnet.weights.inspection import WeightsInfo
    from predmapnet.weights.maptracker_import import ImportReport

weights = typer.Typer(name="weights", help="Import, export and inspect weights.", no_args_is_help=True)


@weights.command("import", cls=PlainCommand)
def import_weights(
    checkpoint: Annotated[
        Path,
        typer.Argument(help="Published checkpoint of MapTracker, or an ImageNet ResNet-50 (.pth).", metavar="FILE"),
    ],
    out: Annotated[Path, typer.Option("--out", "-o", help="Weights to write (.safetensors).")],
    preset: Annotated[
        str | None,
        typer.Option(
            help="MapTracker as it is (maptracker-nuscenes, maptracker-av2; by default as the file says), or under the "
            "modules of the paper (paper-nuscenes, paper-av2), or a JSON file. An ImageNet backbone goes into "
            "paper-nuscenes by default.",
            show_default=False,
        ),
    ] = None,
    seed: Annotated[int, typer.Option(help="Seed of what the file does not hold, which begins at random.")] = 0,
    as_json: Json = False,
) -> None:
    """Turn published weights into weights for PredMapNet.

    They are a MapTracker checkpoint, or an ImageNet ResNet-50. Map with them (`predmapnet infer --weights FILE`), or go
    on training. With the modules of the paper they have to be trained before they map well, since the modules begin at
    random. A ResNet-50 (names of torchvision, mmcv, Detectron or Detectron2) becomes the image backbone of a network to
    train: `predmapnet train --init FILE`.

    Nothing in the checkpoint is executed; entries that do not fit are an error.
    """
    from predmapnet.files import check_output
    from predmapnet.presets import load_config

    check_output(out, (".safetensors",), (checkpoint,))
    config = None if preset is None else load_config(preset)
    from cli.console import print_json
    from predmapnet.weights.checkpoint import save_checkpoint
    from predmapnet.weights.files import weights_hash
    from predmapnet.weights.imagenet_import import import_imagenet_backbone, is_imagenet_backbone
    from predmapnet.weights.inspection import parts_of
    from predmapnet.weights.maptracker_import import import_maptracker, read_official_checkpoint

    official = read_official_checkpoint(checkpoint)
    report: ImportReport | BackboneReport
    if is_imagenet_backbone(official):
        network, report = import_imagenet_backbone(official, config or load_config("paper-nuscenes"), seed)
    else:
        network, report = import_maptracker(official, config, seed)
    facts: dict[str, object] = {"imported_from": checkpoint.name, "sha256_of_source": weights_hash(checkpoint)}
    if report.fresh:
        facts |= {"untrained": parts_of(report.fresh), "seed": seed}
    save_checkpoint(out, network, facts)
    if as_json:
        print_json({"configuration": network.config.name, **asdict(report), "written": [out]})
        return
    _say_import(report, network.config.name, out)


@weights.command("export", cls=PlainCommand)
def export_weights(
    onnx: Annotated[Path, typer.Option(help="Folder of ONNX graphs to make.", metavar="FOLDER")],
    file: Annotated[
        Path | None,
        typer.Argument(
            help="Checkpoint (.safetensors); the shipped one if none is named.", metavar="FILE", show_default=False
        ),
    ] = None,
    rows: Annotated[
        int | None,
        typer.Option(
            min=1, help="Tracks that a stream can hold at once. Default: 64, or as many as the network has queries."
        ),
    ] = None,
    as_json: Json = False,
) -> None:
    """Export the network as two ONNX graphs.

    One from images to BEV, one from BEV and state to map and next state. Map with them (`predmapnet infer --weights
    FOLDER`), or run them anywhere; docs/onnx.md names inputs and outputs.
    """
    from cli.console import err, out, print_json
    from predmapnet.export.onnx_files import export_graphs
    from predmapnet.weights.checkpoint import load_checkpoint

    checkpoint = load_checkpoint(file)
    with err.status("Exporting; this takes a minute or two."):
        graphs = export_graphs(checkpoint, onnx, rows)
    if as_json:
        print_json({"configuration": graphs.config.name, "tracks": graphs.rows, "written": sorted(onnx.iterdir())})
        return
    size = sum(path.stat().st_size for path in onnx.iterdir()) / 1e6
    out.print(f"{graphs.config.name} with {graphs.rows} tracks written: {onnx} ({size:.0f} MB)", markup=False)


@weights.command("inspect", cls=PlainCommand)
def inspect_weights(
    file: Annotated[
        Path | None,
        typer.Argument(
            help="Weights (.safetensors); those that come with PredMapNet if none are named.",
            metavar="FILE",
            show_default=False,
        ),
    ] = None,
    names: Annotated[bool, typer.Option("--names", help="List every tensor.")] = False,
    as_json: Json = False,
) -> None:
    """Show what a weights file holds.

    Network, modules, parts and origin.
    """
    from cli.console import print_json
    from predmapnet.weights.inspection import inspect_file

    info = inspect_file(file)
    if as_json:
        print_json({**asdict(info), "modules": info.modules, "parameters": info.parts()})
        return
    _say_weights(info, names)


def _say_import(report: ImportReport | BackboneReport, name: str, path: Path) -> None:
    from cli.console import out
    from predmapnet.weights.inspection import parts_of

    out.print(f"{len(report.mapped)} entries mapped, none unexplained", markup=False)
    for line in report.remarks():
        out.print(line, markup=False)
    if report.fresh:
        parts = ", ".join(parts_of(report.fresh))
        out.print(f"{len(report.fresh)} tensors begin at random and have to be trained: {parts}", markup=False)
    out.print(f"{name} written: {path}", markup=False)


def _say_weights(info: WeightsInfo, names: bool) -> None:
    from rich.table import Table

    from cli.console import counted, out

    about = info.about
    if about:
        out.print(f"{about['configuration']['name']}, written by predmapnet {about['version']}", markup=False)
    else:
        out.print("not written by PredMapNet", markup=False)
    facts = {"modules of the paper": info.modules or "none"} if info.modules is not None else {}
    _say_facts(facts | dict(about.get("facts", {})) | {"sha256": info.sha256})
    table = Table("tensor" if names else "part", show_edge=False, pad_edge=False)
    if names:
        table.add_column("shape")
        table.add_column("type")
        for tensor in info.tensors:
            table.add_row(tensor.name, " x ".join(map(str, tensor.shape)) or "1", tensor.kind)
    else:
        table.add_column("parameters", justify="right")
        for part, count in info.parts().items():
            table.add_row(part, f"{count:,}")
    out.print(table)
    total = sum(tensor.count for tensor in info.tensors)
    out.print(f"{counted(len(info.tensors), 'tensor')}, {total:,} parameters, {info.size / 1e6:.1f} MB", markup=False)


def _say_facts(facts: Mapping[str, Any], indent: str = "") -> None:
    from cli.console import out

    for name, value in facts.items():
        nested = isinstance(value, Mapping)
        said = "" if nested else f" {_said(value)}"
        out.print(f"{indent}{name.replace('_', ' ')}:{said}", markup=False, soft_wrap=True)
        if nested:
            _say_facts(value, indent + "  ")


def _said(value: Any) -> str:
    if isinstance(value, (list, tuple)):
        return ", ".join(map(str, value))
    return f"{value:,.1f}" if isinstance(value, float) else str(value)
