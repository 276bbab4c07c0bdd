"""``predmapnet compare``: methods side by side, with what chance could have made."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from cli.options import Json

if TYPE_CHECKING:
    from rich.table import Table

    from predmapnet.evaluation.comparison import Comparison, Estimate, MethodFigure


def compare(
    evaluations: Annotated[
        list[Path],
        typer.Argument(
            metavar="FILE", help="Files of `predmapnet evaluate --json`, of the same scenes.", show_default=False
        ),
    ],
    as_json: Json = False,
    seed: Annotated[int, typer.Option(min=0, help="Of the draws for the intervals.")] = 0,
) -> None:
    """Set methods side by side, with intervals over scenes.

    Each is compared with the first one; intervals hold 95 %.
    """
    from cli.console import out, print_json, say_warning
    from predmapnet.evaluation.comparison import compare_evaluations

    found = compare_evaluations(evaluations, seed)
    if as_json:
        print_json(found.content())
        return
    out.print(_table(found))
    out.print(
        "pooled: over all scenes together, as published; mean: over the scenes, with the 95 % interval of a bootstrap "
        "(10,000 draws); * the difference is clear of 0",
        markup=False,
        soft_wrap=False,
    )
    for note in found.notes:
        say_warning(note)


def _table(found: Comparison) -> Table:
    from rich.table import Table

    from predmapnet.evaluation.scene_figures import SCENE_FIGURES

    table = Table(
        title=f"{found.scenes} scenes, compared with {found.methods[0]}",
        title_justify="left",
        title_style="bold",
        show_edge=False,
        pad_edge=False,
        collapse_padding=True,
    )
    table.add_column("", overflow="fold")
    for heading in ("pooled", "mean", "interval", "difference", "interval", ""):
        table.add_column(heading, justify="right", no_wrap=True)
    for name, entries in found.figures.items():
        of = "" if found.counted[name] == found.scenes else f" ({found.counted[name]} scenes)"
        table.add_row(f"[bold]{SCENE_FIGURES[name]}[/]{of}")
        for method, entry in zip(found.methods, entries, strict=True):
            table.add_row(f"  {method}", *_cells(entry))
    return table


def _cells(entry: MethodFigure) -> list[str]:
    pooled = "" if entry.pooled is None else f"{entry.pooled:.3f}"
    cells = [pooled, f"{entry.scenes.mean:.3f}", _interval(entry.scenes, "")]
    if entry.difference is not None:
        cells += [f"{entry.difference.mean:+.3f}", _interval(entry.difference, "+"), "*" if entry.clear else ""]
    return cells


def _interval(estimate: Estimate, sign: str) -> str:
    return f"{estimate.low:{sign}.3f} {estimate.high:{sign}.3f}"
