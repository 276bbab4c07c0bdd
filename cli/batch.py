"""``predmapnet batch``: map many scenes."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from cli.options import (
    AllowMissingCameras,
    Compile,
    DataRoot,
    Dataset,
    Device,
    Origin,
    PrecisionOption,
    Rate,
    Scheme,
    SplitScheme,
    Weights,
)
from predmapnet.machine import NetworkOptions, Precision, available_cores


def batch(
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder to write to; created if need be.")],
    scenes: Annotated[
        list[str] | None, typer.Argument(help="Names of scenes, or the folder of a data set; by default all scenes.")
    ] = None,
    split: Annotated[str | None, typer.Option(help="Only this split: train, val or test.")] = None,
    jobs: Annotated[int, typer.Option(min=1, help="Processes; they share the cores.")] = 1,
    recordings: Annotated[
        bool, typer.Option("--recordings", help="Write a Rerun recording of each scene (.rrd).")
    ] = False,
    save_frames: Annotated[
        bool, typer.Option("--save-frames", help="Write the per-frame results of each scene (.parquet).")
    ] = False,
    dataset: Dataset = None,
    data_root: DataRoot = None,
    rate: Rate = None,
    split_scheme: SplitScheme = Scheme.OLD,
    origin: Origin = None,
    weights: Weights = None,
    device: Device = "auto",
    precision: PrecisionOption = Precision.FLOAT32,
    compiled: Compile = False,
    allow_missing_cameras: AllowMissingCameras = False,
) -> None:
    """Map many scenes in several processes; run it again to resume after an interruption.

    Writes NAME.geojson and NAME.summary.json of each scene, log.jsonl and summary.json. The exit code is 1 if any
    scene failed.
    """
    from cli.console import err, progress_display, say_outcomes
    from predmapnet.datasets.georeference import given_origin
    from predmapnet.runs.batch import BatchJournal, BatchSettings, choose_scenes, map_scenes, prepare_folder
    from predmapnet.sources import folder_named, open_source
    from predmapnet.weights.files import weights_hash

    names = list(scenes or [])
    if len(names) == 1 and Path(names[0]).is_dir():
        dataset, data_root = folder_named(names[0], dataset) or (dataset, Path(names[0]))
        names = []
    source, sentence = open_source(dataset, data_root, split_scheme.value, rate=rate)
    err.print(sentence, markup=False)
    chosen = choose_scenes(source, names, split)
    prepare_folder(out)
    settings = BatchSettings(
        source.name,
        source.root,
        NetworkOptions(weights, device, precision, compiled),
        allow_missing_cameras,
        recordings,
        save_frames,
        threads=max(1, available_cores() // jobs),
        origin=None if origin is None else given_origin(origin),
        rate=rate,
    )
    journal = BatchJournal(out)
    with progress_display() as display:
        display.scenes(0, len(chosen))
        for outcome in map_scenes(chosen, out, settings, jobs, weights_hash(weights)):
            journal.add(outcome)
            display.scenes(len(journal.outcomes), len(chosen))
    journal.close()
    say_outcomes(journal.outcomes, out)
    if any(outcome.status == "failed" for outcome in journal.outcomes):
        raise typer.Exit(1)
