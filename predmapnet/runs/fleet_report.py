"""Report of a folder of maps, or of one map: what was mapped, what failed and why, and where to look first."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, field
from datetime import datetime
from html import escape
from pathlib import Path, PurePosixPath
from urllib.parse import quote

import predmapnet
from mapfusion.elements import ElementKind
from mapfusion.formats.by_suffix import SUFFIXES, map_suffix
from mapfusion.ground import coverage
from predmapnet.errors import UserError
from predmapnet.files import file_name
from predmapnet.report.doubts import doubtful_stretches
from predmapnet.report.drawn_map import DrawnElement
from predmapnet.report.page import Cell, Column, SheetDoubt, city_sheet, link, number, page, sortable_table, tiles
from predmapnet.report.places import Place, PlacedMap, lay_out
from predmapnet.runs.batch_records import Outcome, outcomes_in
from predmapnet.runs.output_folder import OutputFolder

MOST_DOUBTS = 300
"""Doubtful stretches that are listed."""

_COLUMNS = (
    Column("scene", text=True),
    Column("status", text=True),
    Column("frames"),
    Column("frames/s"),
    Column("elements"),
    Column("km"),
    Column("doubts"),
    Column("rejected"),
    Column("mAP"),
    Column("precision"),
    Column("recall"),
    Column("files", text=True),
    Column("why", text=True, long=True),
)


@dataclass(frozen=True)
class _Drawn:
    """Maps on the sheet, and the doubts of each by its row."""

    places: Sequence[Place] = ()
    maps: Sequence[PlacedMap] = ()
    rows: Sequence[str] = ()
    doubts: Sequence[SheetDoubt] = ()
    unread: dict[str, str] = field(default_factory=dict)

    @property
    def elements(self) -> list[DrawnElement]:
        row = {name: place for place, name in enumerate(self.rows)}
        return [
            DrawnElement(element, self.places[placed.place].shift, row[placed.name])
            for placed in self.maps
            for element in placed.global_map
        ]

    @property
    def totals(self) -> dict[str, tuple[int, float]]:
        """Number and metres of the elements of each map; of crossings their longer sides, as everywhere."""
        return {
            placed.name: (len(placed.global_map), sum(element.extent[0] for element in placed.global_map))
            for placed in self.maps
        }


def folder_report(folder: OutputFolder, out_beside: bool = True) -> str:
    """Return the page of a folder of maps, as HTML.

    Args:
        folder: of a batch, or any folder with maps in it.
        out_beside: whether the page will lie in the folder, so that its links are relative.

    Raises:
        UserError: there is neither a map nor a record of a scene in it.
    """
    names = folder.names()
    outcomes = list(outcomes_in(folder))
    of_scene = {file_name(outcome.scene): outcome.scene for outcome in outcomes}
    maps = _one_of_each(names)
    if not maps and not outcomes:
        raise UserError(f"there is neither a map nor a record of a batch in {folder.where}")
    with tempfile.TemporaryDirectory(prefix="predmapnet-") as temporary:
        paths = []
        for stem, name in maps.items():
            path = Path(temporary) / name if folder.path is None else folder.path / name
            paths.append((of_scene.get(stem, stem), path))
        if folder.path is None:
            for name, content in folder.read(maps.values()):
                (Path(temporary) / name).write_bytes(content)
        drawn = _drawn(paths)
    known = {outcome.scene for outcome in outcomes}
    outcomes += [Outcome(name, "map", 0.0) for name, _ in paths if name not in known]
    where = "" if out_beside else folder.link("") if folder.path is None else f"{folder.path}/"
    title = f"Maps in {PurePosixPath(folder.where.rstrip('/')).name or folder.where}"
    return page(title, _parts(folder.where, sorted(outcomes, key=lambda found: found.scene), drawn, names, where))


def _one_of_each(names: set[str]) -> dict[str, str]:
    """Return the map files by their names without the ending; of several formats the first by name, as good as any."""
    found: dict[str, str] = {}
    for name in sorted(names):
        suffix = map_suffix(Path(name))
        if suffix not in (None, ".json") and name[0] != ".":
            found.setdefault(name[: -len(suffix or "")], name)
    return found


def map_report(path: Path) -> str:
    """Return the page of one map, as HTML. Raises UserError if it is none."""
    drawn = _drawn([(path.stem, path)])
    if drawn.unread:
        raise UserError(next(iter(drawn.unread.values())))
    return page(f"Map {path.name}", _parts(str(path), [], drawn, set(), ""))


def _drawn(paths: Sequence[tuple[str, Path]]) -> _Drawn:
    places, maps, unread = lay_out(paths)
    rows = [placed.name for placed in maps]
    doubts = []
    for number_of_place, place in enumerate(places):
        members = [(row, placed) for row, placed in enumerate(maps) if placed.place == number_of_place]
        global_maps = [placed.global_map for _, placed in members]
        grounds = [coverage(found, place.plane) for found in global_maps] if len(members) > 1 else []
        for doubt in doubtful_stretches(global_maps, grounds):
            row, placed = members[doubt.map]
            kind = placed.global_map.elements[doubt.element].kind
            doubts.append(SheetDoubt(doubt, row, kind, doubt.line + place.shift))
    doubts.sort(key=lambda item: -item.doubt.score)
    return _Drawn(places, maps, rows, doubts, dict(unread))


def _parts(where: str, outcomes: Sequence[Outcome], drawn: _Drawn, names: set[str], links: str) -> list[str]:
    elements = drawn.elements
    made = f"{datetime.now().astimezone():%Y-%m-%d %H:%M %Z}, PredMapNet {predmapnet.__version__}"
    origins = [placed.global_map.provenance for placed in drawn.maps]
    facts = [made, *sorted({str(o["dataset"]) for o in origins if "dataset" in o})]
    weights = sorted({str(o["weights_sha256"])[:12] for o in origins if o.get("weights_sha256")})
    facts.extend(f"weights {sha}" for sha in weights[:3])
    notes = sorted({str(o["note"]) for o in origins if o.get("note")})
    failed = [outcome for outcome in outcomes if outcome.status == "failed"]
    parts = [
        f'<p class="note">{escape(" · ".join(facts))}</p><p><code>{escape(where)}</code></p>',
        *(f'<p class="warning">{escape(note)}</p>' for note in notes),
        tiles(_figures(outcomes, failed, elements, len(drawn.doubts))),
    ]
    if len(weights) > 1:
        parts.append(f'<p class="warning">Made with {len(weights)} different weights.</p>')
    if elements:
        parts.append(city_sheet(drawn.places, elements, drawn.rows, drawn.doubts[:MOST_DOUBTS]))
    for name, reason in drawn.unread.items():
        parts.append(f'<p class="warning">{escape(name)} cannot be drawn: {escape(reason)}</p>')
    if failed:
        why = [[Cell(escape(f.scene)), Cell(escape(f.error or "")), Cell(escape(f.reason or ""))] for f in failed]
        columns = (Column("scene", text=True), Column("error", text=True), Column("what it says", text=True, long=True))
        parts.append(f"<h2>Failed</h2>{sortable_table(columns, why)}")
    if outcomes:
        rows, places = _scene_rows(outcomes, drawn, names, links)
        parts.append(f"<h2>Scenes</h2>{sortable_table(_COLUMNS, rows, 'scenes', places)}")
    return parts


def _figures(
    outcomes: Sequence[Outcome], failed: Sequence[Outcome], elements: Sequence[DrawnElement], doubts: int
) -> list[tuple[str, str, bool]]:
    reports = [outcome.report for outcome in outcomes if outcome.report is not None]
    frames, seconds = sum(r["frames"] for r in reports), sum(r["seconds"] for r in reports)
    figures_of = [(r.get("accuracy") or {}).get("mean_ap") for r in reports]
    measured = [figure for figure in figures_of if figure is not None]
    metres = {kind: 0.0 for kind in ElementKind}
    for item in elements:
        metres[item.element.kind] += item.element.length
    figures = [(f"{len(outcomes) - len(failed):,}", "scenes mapped", False)] if outcomes else []
    if failed:
        figures.append((f"{len(failed):,}", "scenes failed", True))
    figures.append((f"{len(elements):,}", "elements", False))
    figures.append((f"{metres[ElementKind.DIVIDER] / 1000:.1f} km", "dividers", False))
    figures.append((f"{metres[ElementKind.BOUNDARY] / 1000:.1f} km", "boundaries", False))
    figures.append((f"{sum(item.element.kind.is_ring for item in elements):,}", "crossings", False))
    if seconds:
        figures.append((f"{frames:,}", f"frames, {frames / seconds:.1f}/s per worker", False))
    if measured:
        scenes = "1 scene" if len(measured) == 1 else f"{len(measured)} scenes"
        figures.append((f"{sum(measured) / len(measured):.3f}", f"mAP, mean of {scenes}", False))
    figures.append((f"{doubts:,}", "doubtful stretches", False))
    return figures


def _scene_rows(
    outcomes: Sequence[Outcome], drawn: _Drawn, names: set[str], links: str
) -> tuple[list[list[Cell]], list[int]]:
    """Return the cells of the table of scenes, and the rows of the drawn map that they show."""
    place = {name: row for row, name in enumerate(drawn.rows)}
    doubts = [0] * len(drawn.rows)
    for item in drawn.doubts:
        doubts[item.row] += 1
    totals = drawn.totals
    rows = []
    for outcome in outcomes:
        report = outcome.report or {}
        accuracy = report.get("accuracy") or {}
        count, metres = totals.get(outcome.scene, (0, 0.0))
        failed = outcome.status == "failed"
        status = f'<span class="status{" failed" if failed else ""}">{"failed" if failed else "done"}</span>'
        why = outcome.reason or "; ".join([*report.get("notes", ()), *_rejected(report)])
        rows.append(
            [
                Cell(escape(outcome.scene)),
                Cell(status),
                number(report.get("frames")),
                number(report.get("frames_per_second"), 1),
                number(None if failed else count),
                number(None if failed else metres / 1000, 2),
                number(doubts[place[outcome.scene]] if outcome.scene in place else None),
                number(sum(report["rejections"].values()) if report else None),
                *(number(accuracy.get(name), 3) for name in ("mean_ap", "precision", "recall")),
                Cell(_links(outcome, names, links)),
                Cell(escape(f"{outcome.error}: {why}" if outcome.error else why)),
            ]
        )
    return rows, [place.get(outcome.scene, -1) for outcome in outcomes]


def _rejected(report: dict[str, dict[str, int]]) -> list[str]:
    return [f"rejected {count} x {reason}" for reason, count in report.get("rejections", {}).items()]


def _links(outcome: Outcome, names: set[str], links: str) -> str:
    stems = dict.fromkeys((file_name(outcome.scene), outcome.scene))  # of maps that batch did not make, their own name
    kinds = {".rrd": "recording", ".parquet": "frames", ".summary.json": "record", ".failed.json": "record"}
    kinds = {ending: "map" for ending in SUFFIXES if ending != ".json"} | kinds
    found = [(stem + ending, text) for stem in stems for ending, text in kinds.items() if stem + ending in names]
    return " ".join(link(links + quote(name), text) for name, text in found)
