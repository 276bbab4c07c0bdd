"""``predmapnet view``: look at a scene while it is mapped, at a recording, or at a map."""

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
    PrecisionOption,
    Rate,
    Threads,
    Weights,
)
from predmapnet.machine import NetworkOptions, Precision, use_threads


def view(
    what: Annotated[
        str,
        typer.Argument(
            help="A scene or the folder of a log (mapped now), a recording (.rrd) or a map (.geojson, .gpkg, .fgb "
            "or .osm)."
        ),
    ],
    web: Annotated[bool, typer.Option("--web", help="Serve a viewer for the web browser instead.")] = False,
    port: Annotated[int, typer.Option(help="Port of the web viewer.")] = 9090,
    out: Annotated[
        Path | None, typer.Option("--out", "-o", help="Write a recording (.rrd) instead of opening a viewer.")
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
) -> None:
    """Open a scene (live, while it is mapped), a recording or a map in Rerun.

    Without a display, a recording is written instead, and the command prints how to open it.
    """
    from cli.console import err, progress_display, say_report, warn_of_weights
    from cli.viewer import Viewer
    from mapfusion.formats.by_suffix import SUFFIXES
    from predmapnet.runs.outputs import Outputs
    from predmapnet.sources import folder_named

    ending = Path(what).suffix.lower()
    if ending == ".rrd":
        Viewer.show_file(Path(what), web, port)
        return
    name: str | None = what
    if (folder := folder_named(what, dataset)) is not None:
        name, (dataset, data_root) = None, folder
    is_map = name is not None and ending in SUFFIXES
    with Viewer.open(Path(what).resolve().stem, web, port, out, live=not is_map) as viewer:
        if is_map:
            from predmapnet.recording import log_map_file

            log_map_file(viewer.recording, Path(what))
            return
        use_threads(threads)
        from predmapnet.runs.infer import MappingPipeline

        network = NetworkOptions(weights, device, precision, compiled)
        pipeline = MappingPipeline.open(dataset, data_root, network, allow_missing_cameras, rate=rate)
        err.print(pipeline.sentence, markup=False)
        warn_of_weights(pipeline)
        with progress_display() as display:
            mapped = pipeline.run(
                name, Outputs(), preparing=display.preparing, progress=display.frames, viewer=viewer.recording
            )
        say_report(mapped.report)
