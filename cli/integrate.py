"""``predmapnet integrate``: fuse the per-frame results of any detector into one map."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from cli.options import Crs, Force, Json

if TYPE_CHECKING:
    from mapfusion.elements import RegionOfInterest
    from mapfusion.georeference import Georeference


def integrate(
    frames: Annotated[
        Path,
        typer.Argument(
            metavar="FRAMES",
            help="Per-frame results: .parquet (as of --save-frames), or .json of MapTracker, MapTR, HDMapNet and kin.",
        ),
    ],
    out: Annotated[Path, typer.Option("--out", "-o", help="Map to write; its ending is the format (README).")],
    poses: Annotated[
        Path | None, typer.Option(help="Poses by token (.json or .csv), for .json results.", show_default=False)
    ] = None,
    location: Annotated[
        str | None,
        typer.Option(
            help="Frame of the poses, unless the results name it: a nuScenes map or an Argoverse 2 city (PIT)."
        ),
    ] = None,
    origin: Annotated[
        str | None,
        typer.Option(help="Or the origin of that frame (x east, y north): latitude,longitude, as in 49.01,8.41."),
    ] = None,
    roi: Annotated[str, typer.Option(help="Region of interest of the detector, metres along x and y.")] = "60x30",
    min_score: Annotated[
        float, typer.Option(min=0.0, max=1.0, help="Lowest score that is used, for results without track ids.")
    ] = 0.4,
    y_forward: Annotated[
        bool, typer.Option("--y-forward", help="The results' x points right and y forward (MapTR on nuScenes).")
    ] = False,
    normalised: Annotated[
        bool, typer.Option("--normalised", help="The results' points are shares (0 to 1) of the region's sides.")
    ] = False,
    crs: Crs = None,
    correct: Annotated[
        bool,
        typer.Option(
            "--correct-poses", help="The poses of single frames are off by a metre or so: align frames with each other."
        ),
    ] = False,
    force: Force = False,
    as_json: Json = False,
) -> None:
    """Fuse the per-frame results of any detector into one map."""
    from cli.console import counted, elements_table, print_json, say_notes
    from cli.console import out as screen
    from mapfusion.elements import ElementKind
    from mapfusion.formats.by_suffix import write_map
    from mapfusion.georeference import LOCAL_FRAME
    from mapfusion.ground import observed_rings
    from mapfusion.provenance import united_provenance
    from predmapnet import __version__
    from predmapnet.errors import value_errors_told
    from predmapnet.runs.integrate import integrate_file
    from predmapnet.runs.outputs import Outputs

    Outputs(map=out, force=force, crs=crs).check([path for path in (frames, poses) if path is not None])
    region = _region(roi)
    if location is not None or origin is not None:
        _georeference(location, origin)  # a wrong option is reported before the work begins
    done = integrate_file(frames, poses, region, min_score, y_forward, normalised, correct)
    synthetic = bool(done.provenance.get("synthetic")) and location is None
    named = str(done.provenance.get("location", ""))
    georeference = _georeference(location or (None if origin else named), origin, synthetic)
    provenance: dict[str, Any] = united_provenance([done.provenance]) | {
        "generator": "predmapnet integrate",
        "version": __version__,
        "frames_file": frames.name,
        "logs": list(done.logs),
        "observed": observed_rings(done.observed, georeference),
    }
    provenance.pop(LOCAL_FRAME, None)  # its place is known now
    with value_errors_told():
        write_map(done.map, out, georeference, provenance, crs)
    elements = {kind.label: len(done.map.of_kind(kind)) for kind in ElementKind}
    metres = {kind.label: done.map.length(kind) for kind in ElementKind}
    if as_json:
        told = {"frames": done.frames, "logs": done.logs, "elements": elements, "metres": metres}
        print_json({**told, "rejections": done.rejections, "notes": done.notes, "written": [out]})
    else:
        screen.print(elements_table("", elements, metres))
        screen.print(f"{counted(done.frames, 'frame')} of {counted(len(done.logs), 'drive')}", markup=False)
        screen.print(f"written: {out}", markup=False)
    say_notes(done.notes, done.rejections)


def _region(text: str) -> RegionOfInterest:
    from mapfusion.elements import RegionOfInterest
    from predmapnet.errors import UserError

    try:
        length, width = (float(side) for side in text.lower().split("x"))
    except ValueError as error:
        raise UserError(f"--roi {text}: two lengths in metres are expected, as in 60x30") from error
    if not (0 < length <= 500 and 0 < width <= 500):
        raise UserError(f"--roi {text}: lengths between 0 and 500 m are expected")
    return RegionOfInterest(length, width)


def _georeference(location: str | None, origin: str | None, synthetic: bool = False) -> Georeference:
    from predmapnet.datasets.georeference import (
        ARGOVERSE2_CITIES,
        NUSCENES_ORIGINS,
        georeference_of,
        given_origin,
    )
    from predmapnet.errors import UserError

    if origin is not None:
        return given_origin(origin)
    found = georeference_of(location or "", synthetic)
    if found is None:
        known = ", ".join([*NUSCENES_ORIGINS, *ARGOVERSE2_CITIES])
        where = (
            f"the location '{location}' is not known"
            if location
            else "the results do not say where on Earth the poses lie"
        )
        raise UserError(f"{where}: give --location (one of {known}) or --origin latitude,longitude")
    return found
