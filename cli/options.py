"""Options shared by several commands."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from predmapnet.machine import EngineKind, Precision


class Scheme(StrEnum):
    """Ways to divide a data set into training and validation."""

    OLD = "old"
    NEW = "new"


Dataset = Annotated[
    str | None,
    typer.Option(
        help="nuscenes, argoverse2, log (your own), demo or demo-v1; or set PREDMAPNET_DATASET. "
        "Default: the demo world.",
    ),
]
DataRoot = Annotated[
    Path | None, typer.Option(help="Folder of the data set; or set PREDMAPNET_DATA_ROOT.", show_default=False)
]
SplitScheme = Annotated[
    Scheme,
    typer.Option(help="Splits: old (the data set's own) or new (StreamMapNet's, geographically disjoint)."),
]
OfficialFrames = Annotated[
    bool,
    typer.Option(
        "--official-frames",
        help="Argoverse 2: exactly the frames of the published benchmarks, counted across all logs of a split.",
    ),
]
Rate = Annotated[
    float | None,
    typer.Option(min=0.01, help="Frames per second of logs of your own. Default: 2.", show_default=False),
]
Weights = Annotated[
    Path | None,
    typer.Option(help="Checkpoint (.safetensors), or a folder of exported graphs. Default: the shipped checkpoint."),
]
Engine = Annotated[
    EngineKind,
    typer.Option(help="torch, or onnx: ONNX Runtime (extra 'onnx'; exports the checkpoint first, for a minute)."),
]
Device = Annotated[str, typer.Option(help="auto, cpu, cuda or mps.")]
PrecisionOption = Annotated[
    Precision,
    typer.Option(
        "--precision",
        help="Precision of the image backbone and the BEV encoder; the rest stays in float32. bfloat16 is faster "
        "only on hardware that computes with it.",
    ),
]
Compile = Annotated[
    bool,
    typer.Option(
        "--compile",
        help="Compile the image backbone and the BEV encoder, for long runs on a GPU; the first frame takes minutes.",
    ),
]
Threads = Annotated[int, typer.Option(min=0, help="CPU threads; 0 for all cores.")]
SceneThreads = Annotated[
    int,
    typer.Option(
        "--threads",
        min=1,
        help="CPU threads of a scene. The last digits of a map depend on them, but not on anything else.",
    ),
]
Origin = Annotated[
    str | None,
    typer.Option(
        help="Place on Earth of the origin of the poses (x east, y north): latitude,longitude, as in 49.01,8.41. "
        "Default: the data set's, or a local frame.",
        show_default=False,
    ),
]
Crs = Annotated[
    str | None,
    typer.Option(help="Reference system of a .gpkg or .fgb, as in EPSG:32632. Default: WGS84.", show_default=False),
]
Json = Annotated[bool, typer.Option("--json", help="Print JSON, for other programs.")]
Force = Annotated[
    bool, typer.Option("--force", help="Replace a map even if it was changed by hand since it was written.")
]
AllowMissingCameras = Annotated[
    bool,
    typer.Option("--allow-missing-cameras", help="Map frames without the images of some cameras, instead of stopping."),
]
