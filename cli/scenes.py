"""``predmapnet scenes``: list what a data set holds."""

from __future__ import annotations

from dataclasses import asdict
from typing import Annotated

import typer

from cli.options import DataRoot, Dataset, Json, OfficialFrames, Rate, Scheme, SplitScheme


def scenes(
    split: Annotated[str | None, typer.Option(help="Only this split: train, val or test.")] = None,
    as_json: Json = False,
    dataset: Dataset = None,
    data_root: DataRoot = None,
    rate: Rate = None,
    split_scheme: SplitScheme = Scheme.OLD,
    official_frames: OfficialFrames = False,
) -> None:
    """List the scenes of a data set."""
    from cli.console import err, out, print_json
    from predmapnet.sources import open_source

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
