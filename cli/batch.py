"""``predmapnet batch``: map many scenes."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from cli.options import (
    AllowMissingCameras,
    Compile,
    Crs,
    DataRoot,
    Dataset,
    Device,
    Force,
    Json,
    Origin,
    PrecisionOption,
    Rate,
    SceneThreads,
    Scheme,
    SplitScheme,
    Weights,
)
from cli.workers import Address, EngineOption, Jobs, WorkerKind, open_executor
from predmapnet.machine import THREADS_PER_SCENE, NetworkOptions, Precision

if TYPE_CHECKING:
    from predmapnet.runs.batch import BatchSettings
    from predmapnet.runs.scene_choice import ListedScene


def batch(
    out: Annotated[
        str,
        typer.Option("--out", "-o", help="Folder to write to, created if need be, or a URL such as s3://maps/city."),
    ],
    scenes: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="SCENE",
            help="Names of scenes or patterns ('scene-00*'), the folder of a data set, or a manifest: a .csv or "
            ".parquet with the columns scene and folder. By default all scenes.",
            show_default=False,
        ),
    ] = None,
    split: Annotated[str | None, typer.Option(help="Only this split: train, val or test.")] = None,
    jobs: Jobs = None,
    engine: EngineOption = WorkerKind.PROCESS,
    address: Address = None,
    scene_timeout: Annotated[
        float | None,
        typer.Option(
            min=1.0,
            help="Seconds that a scene may take; a worker that needs longer is replaced, and the scene tried again, "
            "three times in all.",
            show_default=False,
        ),
    ] = None,
    threads: SceneThreads = THREADS_PER_SCENE,
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
    map_format: Annotated[
        str,
        typer.Option("--format", help="Maps as geojson, gpkg, fgb, xodr, nuscenes.json or argoverse2.json."),
    ] = "geojson",
    crs: Crs = None,
    force: Force = False,
    as_json: Json = False,
) -> None:
    """Map many scenes, resuming where it stopped.

    In several processes, or on a cluster. Writes NAME.geojson (or another --format) and NAME.summary.json of each
    scene, or NAME.failed.json, and for the folder summary.json and report.html, the page to look at first. The exit
    code is 1 if any scene failed.
    """
    from cli.batch_display import BatchDisplay
    from cli.console import progress_display
    from predmapnet.datasets.georeference import given_origin
    from predmapnet.runs.batch import BatchSettings, map_scenes
    from predmapnet.runs.batch_records import log_outcome, write_summary
    from predmapnet.runs.fleet_report import folder_report
    from predmapnet.runs.output_folder import OutputFolder
    from predmapnet.weights.files import weights_hash

    folder = OutputFolder.named(out)
    settings = BatchSettings(
        dataset,
        data_root,
        NetworkOptions(None if weights is None else weights.absolute(), device, precision, compiled),
        allow_missing_cameras,
        recordings,
        save_frames,
        threads,
        None if origin is None else given_origin(origin),
        rate,
        force,
        _map_suffix(map_format, crs),
        crs,
        weights_hash(weights),
    )
    chosen, settings = _chosen(list(scenes or []), split, settings, split_scheme.value)
    folder.prepare()
    mapped = set()
    with (
        progress_display() as display,
        open_executor(engine, address, jobs, device, threads, scene_timeout) as (executor, workers),
    ):
        shown = BatchDisplay(display, len(chosen), workers)
        for outcome in map_scenes(chosen, folder, settings, executor, shown.begun):
            log_outcome(folder, outcome)
            shown.add(outcome)
            if outcome.status == "done":
                mapped.add(outcome.scene)
    write_summary(folder, mapped)
    with folder.write("report.html") as temporary:
        temporary.write_text(folder_report(folder), encoding="utf-8")
    shown.close(folder.link("summary.json"), folder.link("report.html"), as_json)
    if shown.failed:
        raise typer.Exit(1)


def _map_suffix(map_format: str, crs: str | None) -> str:
    """Return the ending of maps by what the user calls their format, checked against the reference system."""
    from mapfusion.formats.by_suffix import SUFFIXES, check_crs
    from predmapnet.errors import UserError, value_errors_told

    suffix = f".{map_format.lower().removeprefix('.')}"
    endings = [ending.removeprefix(".") for ending in SUFFIXES if ending not in (".json", ".osm")]
    if suffix.removeprefix(".") not in endings:
        why = "; Autoware wants each .osm in a folder of its own" if suffix == ".osm" else ""
        raise UserError(f"--format {map_format}: one of {', '.join(endings)} is expected{why}")
    with value_errors_told():
        check_crs(Path(f"map{suffix}"), crs)
    return suffix


def _chosen(
    names: list[str], split: str | None, settings: BatchSettings, scheme: str
) -> tuple[list[ListedScene], BatchSettings]:
    """Return the scenes, and the settings with the source that holds them."""
    from cli.console import err
    from predmapnet.errors import UserError
    from predmapnet.runs.scene_choice import MANIFEST_ENDINGS, choose_scenes, read_manifest
    from predmapnet.sources import folder_named, open_source

    if len(names) == 1 and Path(names[0]).suffix.lower() in MANIFEST_ENDINGS and Path(names[0]).is_file():
        if split is not None or settings.data_root is not None:
            raise UserError("a manifest says itself which scenes and where: leave out --split and --data-root")
        return read_manifest(Path(names[0]).absolute()), settings
    if len(names) == 1 and Path(names[0]).is_dir():
        dataset, root = folder_named(names[0], settings.dataset) or (settings.dataset, Path(names[0]))
        settings, names = replace(settings, dataset=dataset, data_root=root), []
    source, sentence = open_source(settings.dataset, settings.data_root, scheme, rate=settings.rate)
    err.print(sentence, markup=False)
    found = replace(settings, dataset=source.name, data_root=source.root.absolute())
    return choose_scenes(source, names, split), found
