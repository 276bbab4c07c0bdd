"""``predmapnet scenes``: list what a data set holds, or check logs of one's own."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer

from cli.options import DataRoot, Dataset, Json, OfficialFrames, Rate, Scheme, SplitScheme


def scenes(
    split: Annotated[str | None, typer.Option(help="Only this split: train, val or test.")] = None,
    check: Annotated[
        Path | None,
        typer.Option(help="Check a log of your own, or a folder of them, instead; exit code 1 if something is wrong."),
    ] = None,
    pictures: Annotated[
        Path, typer.Option(help="Folder for the pictures of --check: each camera with the road drawn in.")
    ] = Path("log-check"),
    as_json: Json = False,
    dataset: Dataset = None,
    data_root: DataRoot = None,
    rate: Rate = None,
    split_scheme: SplitScheme = Scheme.OLD,
    official_frames: OfficialFrames = False,
) -> None:
    """List the scenes of a data set, or check logs of your own."""
    from cli.console import err, out, print_json
    from predmapnet.sources import open_source

    if check is not None:
        _check(check, pictures, rate, as_json)
        return
    source, sentence = open_source(dataset, data_root, split_scheme.value, official_frames, rate)
    found = source.scenes(split)
    if as_json:
        print_json([asdict(scene) for scene in found])
        return
    from rich.table import Table

    err.print(sentence, markup=False)
    table = Table("scene", "split", "frames", "location", "ready", "", show_edge=False, pad_edge=False)
    for scene in found:
        ready = "yes" if scene.ready else "drawn when used" if source.synthetic else "no"
        table.add_row(scene.name, scene.split, str(scene.frames), scene.location, ready, scene.description)
    out.print(table)


def _check(folder: Path, pictures: Path, rate: float | None, as_json: bool) -> None:
    """Check each log, say what is wrong with it, and write pictures of its cameras."""
    from cli.console import out, print_json
    from predmapnet.datasets.own_logs.ground_pictures import write_pictures
    from predmapnet.datasets.own_logs.log_check import check_log
    from predmapnet.datasets.own_logs.scene import RATE
    from predmapnet.datasets.own_logs.source import LogSource
    from predmapnet.files import file_name

    results = []
    for name, path in LogSource(folder).folders.items():
        log, found = check_log(path, RATE if rate is None else rate)
        drawn: list[Path] = []
        if log is not None:
            drawn = write_pictures(log, pictures / file_name(name), found.problems)
        results.append({"log": name, **asdict(found), "pictures": [str(path) for path in drawn]})
        if as_json:
            continue
        out.print(f"{name}: {'wrong' if found.problems else 'nothing wrong found'}", markup=False)
        for text in found.problems:
            out.print(f"  WRONG: {text}", markup=False)
        for text in (*found.notes, *(f"written: {path}" for path in drawn)):
            out.print(f"  {text}", markup=False)
    if as_json:
        print_json(results)
    if any(result["problems"] for result in results):
        raise typer.Exit(1)
