"""Options that several commands share, so that they are called the same everywhere."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from predmapnet.precision import Precision


class Scheme(StrEnum):
    """Ways to divide a data set into training and validation."""

    OLD = "old"
    NEW = "new"


Dataset = Annotated[
    str | None,
    typer.Option(
        help="nuscenes, argoverse2, demo or demo-v1; or set PREDMAPNET_DATASET. The demo world if none is configured.",
    ),
]
DataRoot = Annotated[
    Path | None, typer.Option(help="Folder of the data set; or set PREDMAPNET_DATA_ROOT.", show_default=False)
]
SplitScheme = Annotated[
    Scheme,
    typer.Option(help="Which splits: old (the data set's own) or new (geographically disjoint, of StreamMapNet)."),
]
OfficialFrames = Annotated[
    bool,
    typer.Option(
        "--official-frames",
        help="Argoverse 2: the very frames of the published benchmarks, counted across all logs of the split.",
    ),
]
Weights = Annotated[
    Path | None, typer.Option(help="Checkpoint (safetensors). By default the one that comes with PredMapNet.")
]
Device = Annotated[str, typer.Option(help="auto, cpu, cuda or mps.")]
PrecisionOption = Annotated[
    Precision,
    typer.Option(
        "--precision",
        help="Of the image backbone and the BEV encoder. bfloat16 is for a GPU or a CPU that calculates with it; on "
        "others float32 is faster. Everything else stays in float32.",
    ),
]
Compile = Annotated[
    bool,
    typer.Option(
        "--compile",
        help="Compile the image backbone and the BEV encoder, for long runs on a GPU: the first frame waits for it, "
        "up to some minutes.",
    ),
]
Threads = Annotated[int, typer.Option(min=0, help="CPU threads; 0 for all cores.")]
AllowMissingCameras = Annotated[
    bool, typer.Option("--allow-missing-cameras", help="Go on where a camera has no image, instead of stopping.")
]
