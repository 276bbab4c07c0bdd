"""Template of the pages: a heading, tiles, a drawn map and tables in one file that needs nothing from elsewhere."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from html import escape
from importlib.resources import files
from typing import Any

import orjson

from mapfusion.arrays import Float
from mapfusion.colours import BACKGROUND, CHANGE_COLOURS, KIND_COLOURS, TRUTH_COLOUR, web_colour
from mapfusion.elements import ElementKind
from predmapnet.report.doubts import Doubt
from predmapnet.report.drawn_map import STEP, DrawnElement, packed
from predmapnet.report.places import Place

DOUBT_COLOUR = CHANGE_COLOURS["removed"]

ROWS_AT_ONCE = 60
"""Rows of a table that the browser lays out before anything else is done; the others follow when it is idle."""


@dataclass(frozen=True)
class Column:
    """Column of a table.

    Attributes:
        heading: its name.
        text: whether it holds words, which stand to the left, and not numbers.
        long: whether its words may be broken into lines.
    """

    heading: str
    text: bool = False
    long: bool = False


@dataclass(frozen=True)
class Cell:
    """Cell of a table: HTML, and the number that it is sorted by; None sorts last."""

    html: str
    value: float | None = None


@dataclass(frozen=True)
class SheetDoubt:
    """Doubtful stretch on the sheet: itself, the row of its drive, its kind, and its line on the sheet, metres."""

    doubt: Doubt
    row: int
    kind: ElementKind
    line: Float


def page(title: str, parts: Iterable[str]) -> str:
    """Return a page as HTML."""
    body = "".join(parts)
    script = f"<script>{_asset('tables.js')}</script>" if "<table" in body else ""
    style = f":root {{ --ground: {web_colour(BACKGROUND)}; }}\n{_asset('page.css')}"
    return (
        '<!doctype html><html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>{escape(title)}</title><style>{style}</style></head><body><main><h1>{escape(title)}</h1>"
        f"{body}</main>{script}</body></html>\n"
    )


def tiles(values: Iterable[tuple[str, str, bool]]) -> str:
    """Return tiles of figures: text, name, and whether it is bad news."""
    found = (
        f'<div class="tile{" bad" if bad else ""}"><b>{escape(text)}</b><span>{escape(name)}</span></div>'
        for text, name, bad in values
    )
    return f'<div class="tiles">{"".join(found)}</div>'


def number(value: float | None, digits: int = 0) -> Cell:
    """Return a cell with a number; a dash for None."""
    return Cell("–", None) if value is None else Cell(f"{value:,.{digits}f}", float(value))


def sortable_table(
    columns: Sequence[Column], rows: Iterable[Sequence[Cell]], name: str = "", places: Sequence[int] | None = None
) -> str:
    """Return a table that sorts by a click on a heading.

    Args:
        columns: of the table.
        rows: of the table.
        name: of the table, if a field is to find rows in it.
        places: for each row the row of the drawn map that a click shows; negative ones show none.
    """
    classes = ["text long" if column.long else "text" if column.text else "" for column in columns]
    heads = "".join(
        f'<th class="{kind}">{escape(column.heading)}</th>' for kind, column in zip(classes, columns, strict=True)
    )
    lines = []
    for place, row in enumerate(rows):
        shown = -1 if places is None else places[place]
        cells = "".join(
            f'<td class="{kind}"{"" if column.text else _sort_value(cell)}>{cell.html}</td>'
            for kind, column, cell in zip(classes, columns, row, strict=True)
        )
        lines.append(f"<tr{f' data-row={shown}' if shown >= 0 else ''}>{cells}</tr>")
    find = (
        f'<input class="find" type="search" placeholder="Find" aria-label="Find" data-table="{name}">' if name else ""
    )
    first, rest = "".join(lines[:ROWS_AT_ONCE]), "".join(lines[ROWS_AT_ONCE:])
    return (
        f'{find}<div class="wide"><table class="sortable" id="{name or "table"}"><thead><tr>{heads}</tr></thead>'
        f"<tbody>{first}</tbody></table>{f'<template>{rest}</template>' if rest else ''}</div>"
    )


def _sort_value(cell: Cell) -> str:
    return f' data-value="{"" if cell.value is None else f"{cell.value:g}"}"'


def city_sheet(
    places: Sequence[Place], drawn: Sequence[DrawnElement], rows: Sequence[str], doubts: Sequence[SheetDoubt] | None
) -> str:
    """Return the drawn map: a canvas that zooms and pans, and beside it the doubtful stretches, the worst first.

    Args:
        places: on the sheet.
        drawn: the elements.
        rows: names of the drives or maps that elements belong to.
        doubts: None leaves their list out.
    """
    data: Mapping[str, Any] = {
        **packed(drawn),
        "step": STEP,
        "background": web_colour(BACKGROUND),
        "truth": web_colour(TRUTH_COLOUR),
        "doubt": web_colour(DOUBT_COLOUR),
        "kinds": [{"name": kind.noun, "colour": web_colour(KIND_COLOURS[kind])} for kind in ElementKind],
        "places": [_place(place) for place in places],
        "rows": list(rows),
        "doubts": [_drawn_doubt(item) for item in doubts or ()],
    }
    # JSON in a script element ends at the first "</", which orjson does not escape.
    text = orjson.dumps(data).decode().replace("<", "\\u003c")
    listed = "" if doubts is None else _doubt_list(doubts, rows)
    return (
        f'<div class="city{"" if listed else " alone"}"><div class="sheet">'
        '<canvas tabindex="0" aria-label="Map: drag to move, turn the wheel to zoom"></canvas>'
        f'<div class="bar">{_controls(places, any(item.truth for item in drawn), doubts is not None)}</div>'
        '<div class="scale"><span> </span><i></i></div><div class="where"></div><div class="tip" hidden></div></div>'
        f'{listed}</div><script type="application/json" id="city-data">{text}</script>'
        # Here, so that the map is drawn before the browser has read long tables.
        f"<script>{_asset('city.js')}</script>"
    )


def _drawn_doubt(item: SheetDoubt) -> dict[str, Any]:
    x, y = item.line[len(item.line) // 2].round(2).tolist()
    return {"x": x, "y": y, "length": item.doubt.length, "line": item.line.round(1).tolist()}


def _place(place: Place) -> dict[str, Any]:
    return {
        "name": place.name,
        "low": (place.low + place.shift).round(2).tolist(),
        "high": (place.high + place.shift).round(2).tolist(),
        "shift": place.shift.round(3).tolist(),
        "origin": None if place.plane is None else place.plane.origin.tolist(),
        "scale": None if place.plane is None else place.plane.scale.tolist(),
    }


def _controls(places: Sequence[Place], truth: bool, doubts: bool) -> str:
    kinds = "".join(
        f'<button data-kind="{int(kind)}" aria-pressed="true"><i class="swatch" style="background:'
        f'{web_colour(KIND_COLOURS[kind])}"></i>{kind.nouns}</button>'
        for kind in ElementKind
    )
    extra = "".join(
        f'<button data-act="{act}" aria-pressed="true"><i class="swatch" style="background:{web_colour(colour)}"></i>'
        f"{name}</button>"
        for act, colour, name, wanted in (
            ("truth", TRUTH_COLOUR, "ground truth", truth),
            ("doubts", DOUBT_COLOUR, "doubts", doubts),
        )
        if wanted
    )
    options = "".join(f'<option value="{i}">{escape(place.name)}</option>' for i, place in enumerate(places))
    choice = (
        '<div class="group choice"><select aria-label="Place"><option value="-1">all places</option>'
        f"{options}</select></div>"
    )
    return (
        '<div class="group"><button data-act="in" aria-label="Zoom in">+</button><button data-act="out" '
        'aria-label="Zoom out">−</button><button data-act="all">all</button></div>'
        '<div class="group"><button data-mode="kind" aria-pressed="true">kind</button>'
        '<button data-mode="confidence" aria-pressed="false">confidence</button></div>'
        f'<div class="group">{kinds}{extra}</div>'
        f"{choice if len(places) > 1 else ''}"
        '<div class="group legend" hidden>0.5<i class="ramp"></i>1.0</div>'
    )


def _doubt_line(item: SheetDoubt, rows: Sequence[str]) -> str:
    where = f"{item.doubt.length:.0f} m{' of its outline' if item.kind.is_ring else ''}"
    return (
        f'<li style="--kind:{web_colour(KIND_COLOURS[item.kind])}">{item.kind.noun.capitalize()}, {where}: '
        f"{escape('; '.join(item.doubt.reasons))}<span>{escape(rows[item.row])}</span></li>"
    )


def _doubt_list(doubts: Sequence[SheetDoubt], rows: Sequence[str]) -> str:
    lines = "".join(_doubt_line(item, rows) for item in doubts)
    body = (
        f"<ol>{lines}</ol>" if lines else '<div class="empty">None: every stretch has evidence, and drives agree.</div>'
    )
    return f'<div class="doubts"><h3>Doubtful stretches <span>the worst first</span></h3>{body}</div>'


def _asset(name: str) -> str:
    return files("predmapnet.report").joinpath(name).read_text(encoding="utf-8")


def link(where: str, text: str) -> str:
    """Return a link to a file; ``where`` is relative to the page, or a URL."""
    return f'<a href="{escape(where, quote=True)}">{escape(text)}</a>'
