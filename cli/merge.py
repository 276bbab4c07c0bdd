"""``predmapnet merge``: merge the maps of many drives."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from cli.options import Crs, Force, Json
from cli.workers import Address, EngineOption, Jobs, WorkerKind, open_executor

if TYPE_CHECKING:
    from mapfusion.merge.choice import Choice
    from mapfusion.merge.report import MergeReport

MOST_NAMED = 20
"""Number of maps left out that are named."""


def merge(
    maps: Annotated[
        list[Path],
        typer.Argument(metavar="MAP", help="Maps of one city, in any order; a folder means all maps in it."),
    ],
    out: Annotated[Path, typer.Option("--out", "-o", help="Map to write.")],
    tile: Annotated[
        float, typer.Option(min=50.0, help="Side of a tile, metres; larger tiles need more memory.")
    ] = 200.0,
    at_most: Annotated[
        int | None,
        typer.Option(min=1, help="Take at most this many maps, those that add most.", show_default=False),
    ] = None,
    jobs: Jobs = None,
    engine: EngineOption = WorkerKind.PROCESS,
    address: Address = None,
    style: Annotated[bool, typer.Option("--style", help="Write styles for QGIS beside the map (.qml).")] = False,
    crs: Crs = None,
    force: Force = False,
    as_json: Json = False,
) -> None:
    """Merge the maps of many drives into one.

    Drives are aligned where that is certain, and their evidence is added up.
    """
    from cli.console import counted, elements_table, print_json, progress_display, say_warning
    from cli.console import out as screen
    from cli.maps_of_folders import maps_below
    from mapfusion.formats.by_suffix import check_crs, check_suffix
    from mapfusion.formats.qgis_style import write_styles
    from mapfusion.merge.config import MergeConfig
    from mapfusion.merge.merge import merge_files
    from predmapnet import __version__
    from predmapnet.errors import UserError, value_errors_told
    from predmapnet.files import check_output

    with value_errors_told():
        check_suffix(out)
        check_crs(out, crs)
    paths = [file for path in maps for file in (maps_below(path) if path.is_dir() else [path])]
    # A city map among the drives' is the result of the last time.
    paths = [path for path in paths if path in maps or path.absolute() != out.absolute()]
    if not paths:
        raise UserError(f"the only map there is {out} itself")
    check_output(out, (), paths, force)
    config, told = MergeConfig(tile=tile, at_most=at_most), {"version": __version__}
    with (
        value_errors_told(),
        progress_display() as display,
        open_executor(engine, address, jobs, apart=False) as (executor, _),
    ):
        whole = [path.absolute() for path in paths]
        report = merge_files(whole, out, config, executor, display.preparing, told, crs)
    written = [out, *(write_styles(out) if style else ())]
    if as_json:
        print_json({**asdict(report), "written": written})
    else:
        screen.print(elements_table("", report.elements, report.metres))
        screen.print("\n".join([*_choice_lines(report), _alignment_sentence(report)]), markup=False)
        screen.print("\n".join(f"written: {path}" for path in written), markup=False)
    if not sum(report.elements.values()):
        say_warning(f"{out} is empty: no element in {counted(len(report.maps), 'map')}")
    for status in report.maps:
        if status.note and len(report.maps) > 1:
            kept = "kept apart, its elements are in the map as they are" if status.apart else "merged as it lies"
            say_warning(f"{status.name}: {kept}: {status.note}")
    for name, note in report.notes:
        say_warning(f"{name}: {note}")
    for name in report.duplicates:
        say_warning(f"{name} is the same as another map and counts once")


def _choice_lines(report: MergeReport) -> list[str]:
    """Say which maps were taken, in which order, and what the others would have added."""
    taken = [one for one in report.choice if one.taken]
    left = report.choice[len(taken) :]
    if not left:
        return []
    more = len(left) - MOST_NAMED
    return [
        f"{len(taken)} of {len(report.choice)} maps taken, what adds most first:",
        *map(_choice_line, taken),
        "left out, for they would add less than any of these:",
        *map(_choice_line, left[:MOST_NAMED]),
        *([f"  and {more} more (--json names all)"] if more > 0 else []),
    ]


def _choice_line(one: Choice) -> str:
    return f"  {one.name}: {one.new_ground:,.0f} m² of new ground, {one.adds:,.0f} m² with its evidence"


def _alignment_sentence(report: MergeReport) -> str:
    from cli.console import counted

    aligned = [status for status in report.maps if status.partners]
    moved = sorted(status.shift for status in aligned)
    sentence = f"{counted(len(report.maps), 'map')} in {counted(report.tiles, 'tile')}; {len(aligned)} aligned"
    if moved:
        sentence += f", moved by {moved[len(moved) // 2]:.2f} m (median), {moved[-1]:.2f} m at most"
    return sentence
