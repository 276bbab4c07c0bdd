"""``predmapnet view``: look at a scene while it is mapped, at a recording, at maps, or at what changed."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer

from cli.options import (
    AllowMissingCameras,
    Compile,
    DataRoot,
    Dataset,
    Device,
    Json,
    PrecisionOption,
    Rate,
    Threads,
    Weights,
)
from predmapnet.machine import NetworkOptions, Precision, use_threads


def view(
    what: Annotated[
        list[str],
        typer.Argument(
            metavar="WHAT",
            help="A scene or the folder of a log (mapped now), a recording (.rrd), a map of any format or a folder of "
            "maps; two maps, older first, or a file of diff: what changed; per-frame results (.parquet), then a scene.",
        ),
    ],
    web: Annotated[bool, typer.Option("--web", help="Serve a viewer for the web browser instead.")] = False,
    port: Annotated[
        int, typer.Option(min=1, max=65534, help="Port of the web viewer; its data take the next one.")
    ] = 9090,
    bind: Annotated[
        str, typer.Option(help="Address to serve on; 0.0.0.0 lets everyone on the network look.")
    ] = "127.0.0.1",
    out: Annotated[
        Path | None, typer.Option("--out", "-o", help="Write a recording (.rrd) instead of opening a viewer.")
    ] = None,
    track: Annotated[
        int | None, typer.Option(help="Show the memory of this track. Default: a confident one.", show_default=False)
    ] = None,
    dataset: Dataset = None,
    data_root: DataRoot = None,
    rate: Rate = None,
    weights: Weights = None,
    device: Device = "auto",
    precision: PrecisionOption = Precision.FLOAT32,
    compiled: Compile = False,
    threads: Threads = 0,
    allow_missing_cameras: AllowMissingCameras = False,
    as_json: Json = False,
) -> None:
    """Look at scenes, recordings and maps in Rerun.

    Without a display, a recording is written instead, and the command prints how to open it. --json is for --out.
    """
    from cli.console import err, print_json, progress_display, say_notes, say_report, warn_of_weights
    from cli.viewer import WebOptions, open_viewer, show_file
    from mapfusion.diff_files import holds_differences
    from predmapnet.errors import UserError, value_errors_told
    from predmapnet.files import check_output
    from predmapnet.runs.outputs import Outputs
    from predmapnet.sources import folder_named

    browser = WebOptions(bind, port) if web else None
    if web and out is not None:
        raise UserError("--web shows it and --out writes it: give one of them")
    if as_json and out is None:
        raise UserError("--json tells what was written: it needs --out")
    if out is not None:
        check_output(out, (".rrd",), [Path(one) for one in what])
    name = Path(os.path.realpath(what[0])).stem
    if what[0].lower().endswith(".rrd") and len(what) == 1:
        if out is not None:
            raise UserError(f"{what[0]} is a recording already: leave out --out")
        show_file(Path(what[0]), browser)
        return
    if what[0].lower().endswith(".parquet") and len(what) <= 2:
        from predmapnet.recording import log_frames

        with open_viewer(name, browser, out, quiet=as_json) as recording:
            notes = log_frames(recording, Path(what[0]), what[1] if len(what) == 2 else None, track)
            say_notes(notes, {})
        if as_json:
            print_json({"written": [out], "notes": list(notes)})
        return
    folder = folder_named(what[0], dataset) if len(what) == 1 else None
    if folder is None and (maps := map_files(what)):
        from predmapnet.recording import log_changes, log_differences, log_maps

        with open_viewer(name, browser, out, quiet=as_json) as recording, value_errors_told():
            if len(what) == 1 and holds_differences(maps[0]):
                notes = log_differences(recording, maps[0])
            else:
                notes = (log_changes if len(what) == 2 == len(maps) else log_maps)(recording, maps)
            say_notes(notes, {})
        if as_json:
            print_json({"written": [out], "notes": list(notes)})
        return
    use_threads(threads)
    from predmapnet.runs.infer import MappingPipeline

    dataset, data_root = folder or (dataset, data_root)
    network = NetworkOptions(weights, device, precision, compiled)
    pipeline = MappingPipeline.open(dataset, data_root, network, allow_missing_cameras, rate=rate)
    err.print(pipeline.sentence, markup=False)
    warn_of_weights(pipeline)
    with open_viewer(name, browser, out, live=True, quiet=as_json) as recording:
        with progress_display() as display:
            mapped = pipeline.run(
                None if folder else what[0],
                Outputs(),
                preparing=display.preparing,
                progress=display.frames,
                viewer=recording,
                track=track,
            )
        if not as_json:
            say_report(mapped.report)
    if out is not None and as_json:
        say_report(replace(mapped.report, written=(out,)), as_json)


def map_files(named: list[str]) -> list[Path]:
    """Return the maps that are named, and those in folders that are named; empty if a single scene is.

    Raises:
        UserError: there is no map in a folder, or of several names one is no map.
    """
    from cli.maps_of_folders import maps_below
    from mapfusion.formats.by_suffix import map_suffix
    from predmapnet.errors import UserError

    found: list[Path] = []
    for path in map(Path, named):
        if path.is_dir():
            found.extend(maps_below(path))
        elif map_suffix(path) is not None:
            found.append(path)
        elif len(named) > 1:
            raise UserError(f"{path} is no map; several things can be looked at only if they are maps or their folders")
    return found
