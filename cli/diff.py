"""``predmapnet diff``: compare two maps of the same place."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from cli.options import Force, Json

if TYPE_CHECKING:
    from rich.table import Table

    from mapfusion.diff import MapDiff


def diff(
    old: Annotated[Path, typer.Argument(metavar="OLD", help="Map of the earlier drive.")],
    new: Annotated[Path, typer.Argument(metavar="NEW", help="Map of the later drive.")],
    out: Annotated[Path | None, typer.Option("--out", "-o", help="Differences to write (GeoJSON).")] = None,
    tolerance: Annotated[
        float,
        typer.Option(
            min=0.05, help="Movements up to this, or within both maps' uncertainty, count as unchanged, metres."
        ),
    ] = 0.5,
    align: Annotated[
        bool, typer.Option(help="Align the later map to the earlier one if the alignment is certain.")
    ] = True,
    exit_code: Annotated[
        bool, typer.Option("--exit-code", help="Exit with 1 if anything was added, removed or moved.")
    ] = False,
    force: Force = False,
    as_json: Json = False,
) -> None:
    """Compare two maps of one place.

    Tells what was added, removed or moved, and what the later drive did not see.
    """
    from cli.console import err, print_json, say_warning
    from cli.console import out as screen
    from mapfusion.diff import DiffConfig, diff_maps
    from mapfusion.diff_files import write_diff
    from mapfusion.formats.by_suffix import read_maps
    from mapfusion.provenance import united_provenance
    from predmapnet import __version__
    from predmapnet.errors import value_errors_told
    from predmapnet.files import check_output

    if out is not None:
        check_output(out, (".geojson", ".json"), (old, new), force)
    with value_errors_told():
        (before, after), plane = read_maps([old, new])
    for path, read in ((old, before), (new, after)):
        for note in read.notes:
            say_warning(f"{path}: {note}")
    config = DiffConfig(tolerance=tolerance, reach=max(2.0, 2.0 * tolerance), align=align)
    found = diff_maps(before, after, plane, config)
    if out is not None:
        told = {
            **united_provenance([before.provenance, after.provenance]),
            "generator": "predmapnet diff",
            "version": __version__,
            "old": old.name,
            "new": new.name,
            "tolerance_m": tolerance,
        }
        write_diff(found, out, plane, told)
    if as_json:
        print_json({"old": old, "new": new, **_figures(found), "written": [] if out is None else [out]})
    else:
        err.print(_alignment_sentence(found, align), markup=False)
        screen.print(_table(found))
        if out is not None:
            screen.print(f"written: {out}", markup=False)
    if exit_code and found.changed:
        raise typer.Exit(1)


def _figures(found: MapDiff) -> dict[str, Any]:
    """Return what JSON tells of a diff; lengths in metres by change and kind."""
    import numpy as np

    from mapfusion.diff import Change
    from mapfusion.elements import ElementKind

    certain = found.alignment if found.alignment is not None and found.alignment.certain else None
    return {
        "changed": found.changed,
        "aligned": certain is not None,
        "moved_first_m": float(np.linalg.norm(certain.shift)) if certain else 0.0,
        "turned_first_degrees": float(np.degrees(certain.turn)) if certain else 0.0,
        "metres": {change: {kind.label: found.metres(change, kind) for kind in ElementKind} for change in Change},
        "pieces": {change: {kind.label: found.count(change, kind) for kind in ElementKind} for change in Change},
        "moved_by_m": {kind.label: found.moved_by(kind) for kind in ElementKind},
    }


def _alignment_sentence(found: MapDiff, wanted: bool) -> str:
    import numpy as np

    if not wanted:
        return "the new map is compared as it lies"
    if found.alignment is None:
        return "one of the maps is empty"
    if not found.alignment.certain:
        return f"the new map is compared as it lies, because an alignment is not certain: {found.alignment.refusal}"
    shift = np.linalg.norm(found.alignment.shift)
    turn = round(float(np.degrees(found.alignment.turn)), 2) + 0.0  # no -0.00
    return f"the new map was moved by {shift:.2f} m and turned by {turn:.2f} degrees first"


def _table(found: MapDiff) -> Table:
    from rich.table import Table

    from mapfusion.diff import Change
    from mapfusion.elements import ElementKind

    table = Table(show_edge=False, pad_edge=False)
    table.add_column("metres (pieces)", no_wrap=True)
    for change in Change:
        table.add_column(change.value, justify="right", no_wrap=True)
    table.add_column("by", justify="right", no_wrap=True)
    for kind in ElementKind:
        cells = [f"{found.metres(change, kind):.0f} ({found.count(change, kind)})" for change in Change]
        moved = found.moved_by(kind)
        table.add_row(kind.nouns, *cells, "" if moved != moved else f"{moved:.2f} m")
    return table
