"""``predmapnet infer``: map one scene."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from cli.options import (
    AllowMissingCameras,
    Compile,
    Crs,
    DataRoot,
    Dataset,
    Device,
    Engine,
    Force,
    Json,
    Origin,
    PrecisionOption,
    Rate,
    SceneThreads,
    Weights,
)
from predmapnet.machine import THREADS_PER_SCENE, EngineKind, NetworkOptions, Precision, use_threads


def infer(
    scene: Annotated[
        str,
        typer.Argument(
            metavar="SCENE",
            help="Its name (`predmapnet scenes` lists them), or the folder of a log.",
        ),
    ],
    out: Annotated[Path, typer.Option("--out", "-o", help="Map to write; its ending is the format (README).")],
    recording: Annotated[Path | None, typer.Option(help="Rerun recording to write (.rrd).")] = None,
    save_frames: Annotated[Path | None, typer.Option(help="Per-frame results to write (.parquet).")] = None,
    dataset: Dataset = None,
    data_root: DataRoot = None,
    rate: Rate = None,
    origin: Origin = None,
    weights: Weights = None,
    device: Device = "auto",
    precision: PrecisionOption = Precision.FLOAT32,
    compiled: Compile = False,
    engine: Engine = EngineKind.TORCH,
    threads: SceneThreads = THREADS_PER_SCENE,
    allow_missing_cameras: AllowMissingCameras = False,
    crs: Crs = None,
    force: Force = False,
    as_json: Json = False,
) -> None:
    """Map one scene: driving log in, global vector map out."""
    from cli.console import err, progress_display, say_report, warn_of_weights
    from predmapnet.datasets.georeference import given_origin
    from predmapnet.runs.outputs import Outputs
    from predmapnet.sources import folder_named

    name: str | None = scene
    if (folder := folder_named(scene, dataset)) is not None:
        name, (dataset, data_root) = None, folder
    outputs = Outputs(out, recording, save_frames, force, crs)
    outputs.check()
    frame_origin = None if origin is None else given_origin(origin)
    use_threads(threads)
    from predmapnet.runs.infer import MappingPipeline

    network = NetworkOptions(weights, device, precision, compiled, engine)
    pipeline = MappingPipeline.open(dataset, data_root, network, allow_missing_cameras, frame_origin, rate)
    err.print(pipeline.sentence, markup=False)
    warn_of_weights(pipeline)
    with progress_display() as display:
        mapped = pipeline.run(name, outputs, preparing=display.preparing, progress=display.frames)
    say_report(mapped.report, as_json)
