"""``predmapnet diff``: compare two maps of the same place."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from rich.table import Table

    from mapfusion.diff import MapDiff


def diff(
    old: Annotated[Path, typer.Argument(help="Map of the earlier drive.")],
    new: Annotated[Path, typer.Argument(help="Map of the later drive.")],
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
) -> None:
    """Compare two maps: what was added, removed or moved, and what the later drive did not see."""
    from cli.console import err, say_warning
    from cli.console import out as screen
    from mapfusion.diff import DiffConfig, diff_maps, write_diff
    from mapfusion.formats.by_suffix import read_maps
    from predmapnet.errors import value_errors_told
    from predmapnet.files import check_output

    if out is not None:
        check_output(out, (".geojson", ".json"))
    with value_errors_told():
        (before, after), plane = read_maps([old, new])
    for path, read in ((old, before), (new, after)):
        for note in read.notes:
            say_warning(f"{path}: {note}")
    config = DiffConfig(tolerance=tolerance, reach=max(2.0, 2.0 * tolerance), align=align)
    found = diff_maps(before, after, plane, config)
    err.print(_alignment_sentence(found, align), markup=False)
    screen.print(_table(found))
    if out is not None:
        write_diff(found, out, plane, {"old": old.name, "new": new.name, "tolerance_m": tolerance})
        screen.print(f"written: {out}", markup=False)


def _alignment_sentence(found: MapDiff, wanted: bool) -> str:
    import numpy as np

    if not wanted:
        return "the new map is compared as it lies"
    if found.alignment is None:
        return "one of the maps is empty"
    if not found.alignment.certain:
        return f"the new map is compared as it lies, because an alignment is not certain: {found.alignment.refusal}"
    shift = np.linalg.norm(found.alignment.shift)
    return f"the new map was moved by {shift:.2f} m and turned by {np.degrees(found.alignment.turn):.2f} degrees first"


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
        table.add_row(kind.label, *cells, "" if moved != moved else f"{moved:.2f} m")
    return table
