"""Reports of an evaluation: figures in JSON, and a self-contained HTML file."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from html import escape
from pathlib import Path
from typing import Any

import numpy as np
import orjson
import shapely

import predmapnet
from mapfusion.elements import ElementKind, GlobalMap, MapElement
from predmapnet.evaluation.measurement import Measurement
from predmapnet.evaluation.precision_recall import KindResult
from predmapnet.evaluation.report_drawings import COLOURS, draw_bars, draw_curves, draw_frame
from predmapnet.evaluation.scene_figures import SCENE_FIGURES
from predmapnet.files import write_file
from predmapnet.report.drawn_map import DrawnElement
from predmapnet.report.page import Cell, Column, city_sheet, number, page, sortable_table, tiles
from predmapnet.report.places import Place, side_by_side

WORST_FRAMES = 8
SHOWN_SCORE = 0.4
"""Untracked predictions below this score are not drawn and do not make a frame bad."""

TRUTH_MARGIN = 20.0
"""Ground truth is drawn up to this far beyond the bounds of a map, metres."""


def write_figures(path: Path, figures: Mapping[str, Any], context: Mapping[str, Any]) -> None:
    """Write all figures to a JSON file, whole or not at all.

    Args:
        path: the file; its folder exists.
        figures: see :meth:`predmapnet.evaluation.measurement.Measurement.figures`.
        context: data set and scenes; written under ``evaluated``.

    Raises:
        UserError: the file cannot be written.
    """
    content = {"evaluated": {"version": predmapnet.__version__, **context}, **figures}
    with write_file(path) as temporary:
        temporary.write_bytes(orjson.dumps(content, option=orjson.OPT_INDENT_2) + b"\n")


def write_report(
    path: Path,
    measurement: Measurement,
    context: Mapping[str, Any],
    per_scene: Mapping[str, Mapping[str, float | int | None]],
    origin: Mapping[str, str],
    maps: Mapping[str, tuple[GlobalMap, GlobalMap]] | None = None,
) -> None:
    """Write the HTML report: drawn maps, tables, precision-recall curves, AP per threshold, worst frames.

    Args:
        path: the file; its folder exists.
        measurement: over all scenes.
        context: ``dataset``, ``split``, ``synthetic``, ``warnings``.
        per_scene: see :func:`predmapnet.evaluation.scene_figures.scene_figures`.
        origin: how the figures were made, by name: date, weights, command.
        maps: by scene the map of the drive and the true one, metres.

    Raises:
        UserError: the file cannot be written.
    """
    what = f"{context['dataset']}{', split ' + str(context['split']) if context['split'] else ''}"
    several = "s" if len(measurement.scenes) != 1 else ""
    counts = f"{len(measurement.scenes)} scene{several}, {len(measurement.frames)} frames"
    synthetic = " The demo world is synthetic." if context["synthetic"] else ""
    figures = measurement.figures()
    worst_first = sorted(per_scene, key=lambda name: _worth(per_scene[name]))
    parts = [
        f'<p class="note">{counts}, predmapnet {predmapnet.__version__}.{synthetic}</p>',
        *(f'<p class="note">{escape(name)}: <code>{escape(text)}</code></p>' for name, text in origin.items()),
        *(f'<p class="warning">{escape(text)}</p>' for text in (*context["warnings"], *measurement.missing())),
        tiles(_headline(figures)),
        *([_drawn_maps([name for name in worst_first if name in maps], maps)] if maps else []),
        "<h2>Figures</h2>",
        _figures_table(figures),
        "<h2>Scenes, the worst first</h2>",
        _scenes_table(worst_first, per_scene, list(maps or ())),
        "<h2>Precision over recall, chamfer AP</h2>",
        *(_figure(draw_curves(kind.curves), _curve_caption(kind)) for kind in measurement.chamfer.kinds),
        f"<h2>AP per threshold</h2>{_legend()}",
        _figure(
            draw_bars(
                [f"{threshold:g} m" for threshold in measurement.chamfer.thresholds],
                [[curve.average_precision for curve in kind.curves] for kind in measurement.chamfer.kinds],
            ),
            "chamfer AP",
        ),
        _figure(
            draw_bars(
                ["lowest", "", "", "", "", "highest"],
                [
                    [] if kind.average_precisions is None else kind.average_precisions.tolist()
                    for kind in measurement.raster.kinds
                ],
            ),
            "rasterisation AP, overlaps 0.25 to 0.50 (crossings 0.50 to 0.75)",
        ),
        f"<h2>The worst frames</h2><p class='note'>Left ground truth, right prediction (tracked, or a score of "
        f"{SHOWN_SCORE} and more); the car stands in the middle and drives to the right.</p>",
        *_worst(measurement),
    ]
    with write_file(path) as temporary:
        temporary.write_text(page(f"PredMapNet on {what}", parts), encoding="utf-8")


def _worth(figures: Mapping[str, float | int | None]) -> float:
    value = figures["chamfer_mAP"]
    return 2.0 if value is None else value


def _headline(figures: Mapping[str, Any]) -> list[tuple[str, str, bool]]:
    """Return the figures that readers look for first."""
    wanted = (
        ("chamfer mAP", figures["chamfer_ap"]["mAP"]),
        ("consistency mAP", figures["consistency_ap"]["mAP"]),
        ("rasterisation mAP", figures["raster_ap"]["mAP"]),
        ("map precision at 1.0 m", (figures["global_map"] or {}).get("precision@1.0")),
        ("map recall at 1.0 m", (figures["global_map"] or {}).get("recall@1.0")),
    )
    return [(f"{value:.3f}", name, False) for name, value in wanted if value is not None]


def _drawn_maps(scenes: Sequence[str], maps: Mapping[str, tuple[GlobalMap, GlobalMap]]) -> str:
    """Draw the map of each drive over the truth around it, scenes side by side."""
    places, pairs = [], []
    for name in scenes:
        found, truth = maps[name]
        points = np.concatenate([element.points for element in (*found, *truth)] or [np.zeros((1, 2))])
        if len(found):
            points = np.concatenate([element.points for element in found])
        low, high = points.min(axis=0) - TRUTH_MARGIN, points.max(axis=0) + TRUTH_MARGIN
        places.append(Place(name, None, low, high, np.zeros(2)))
        box = shapely.box(*low, *high)
        pairs.append((found.elements, [part for element in truth for part in _cut(element, box)]))
    places = side_by_side(places)
    drawn = [
        DrawnElement(element, place.shift, row, is_truth)
        for row, (place, pair) in enumerate(zip(places, pairs, strict=True))
        for is_truth, elements in ((True, pair[1]), (False, pair[0]))
        for element in elements
    ]
    return city_sheet(places, drawn, scenes, None)


def _cut(element: MapElement, box: shapely.Polygon) -> list[MapElement]:
    parts = shapely.get_parts(shapely.intersection(shapely.LineString(element.points), box))
    lines = [shapely.get_coordinates(part) for part in parts if part.geom_type == "LineString"]
    return [MapElement(element.kind, points, 1.0, 1, 0, 0) for points in lines]


def frame_f1(measurement: Measurement) -> list[float]:
    """F1 of each frame at the middle threshold over the predictions that are shown; NaN for an empty frame."""
    column = len(measurement.chamfer.thresholds) // 2
    values = []
    for frame, flags in zip(measurement.frames, measurement.chamfer.flags, strict=True):
        shown = (frame.predicted.track_ids >= 0) | (frame.predicted.scores >= SHOWN_SCORE)
        together = int(shown.sum()) + len(frame.truth.kinds)
        hits = int((flags[shown, column] == 1).sum())
        values.append(2 * hits / together if together else float("nan"))
    return values


def _worst(measurement: Measurement) -> Iterable[str]:
    values = np.array(frame_f1(measurement))
    of_one_scene = -(-WORST_FRAMES // len(measurement.scenes))
    taken: Counter[str] = Counter()
    rows = []
    for row in np.argsort(np.nan_to_num(values, nan=np.inf), kind="stable"):
        scene = measurement.frames[row].scene
        if taken[scene] < of_one_scene:
            taken[scene] += 1
            rows.append(row)
    rows = rows[:WORST_FRAMES]
    threshold = measurement.chamfer.thresholds[len(measurement.chamfer.thresholds) // 2]
    for row in rows:
        frame = measurement.frames[row]
        predicted = frame.predicted
        shown = predicted.select((predicted.track_ids >= 0) | (predicted.scores >= SHOWN_SCORE))
        caption = f"{frame.scene}, frame {frame.index}: F1 {values[row]:.2f} at {threshold:g} m"
        drawing = draw_frame(frame.truth.kinds, frame.truth.polylines, predicted.roi)
        drawing += draw_frame(shown.kinds, shown.polylines, predicted.roi)
        yield _figure(drawing, caption)


def _figure(drawing: str, caption: str) -> str:
    return f"<figure>{drawing}<figcaption>{escape(caption)}</figcaption></figure>"


def _curve_caption(kind: KindResult) -> str:
    steps = ", ".join(f"{curve.average_precision:.3f} at {curve.threshold:g} m" for curve in kind.curves)
    return f"{kind.kind.nouns}: {steps}"


def _legend() -> str:
    swatches = (f'<span style="color:{COLOURS[kind]}">&#9632;</span> {kind.nouns} ' for kind in ElementKind)
    return f"<p>{''.join(swatches)}</p>"


def _figures_table(figures: Mapping[str, Any]) -> str:
    columns = [Column("figure", text=True), Column("all"), *(Column(kind.nouns) for kind in ElementKind)]
    rows = []
    for title, group, overall, each in _ROWS:
        section = figures[group]
        if section is not None:
            values = [section[overall], *(section[kind.label][each] for kind in ElementKind)]
            rows.append([Cell(title), *(number(value, 3) for value in values)])
    return sortable_table(columns, rows)


def _scenes_table(
    scenes: Sequence[str], per_scene: Mapping[str, Mapping[str, float | int | None]], drawn: Sequence[str]
) -> str:
    """One row per scene; kinds that a scene does not hold are left out of its means."""
    columns = [Column("scene", text=True), Column("frames"), *(Column(text) for text in SCENE_FIGURES.values())]
    rows = [
        [
            Cell(escape(name)),
            number(per_scene[name]["frames"]),
            *(number(per_scene[name][key], 3) for key in SCENE_FIGURES),
        ]
        for name in scenes
    ]
    place = {name: row for row, name in enumerate(name for name in scenes if name in drawn)}
    return sortable_table(columns, rows, "scenes", [place.get(name, -1) for name in scenes])


_ROWS = (
    ("chamfer AP", "chamfer_ap", "mAP", "AP"),
    ("chamfer AP ahead of the car", "ahead_ap", "mAP", "AP"),
    ("chamfer AP behind the car", "rear_ap", "mAP", "AP"),
    ("order-aware AP (Frechet)", "frechet_ap", "mAP", "AP"),
    ("rasterisation AP", "raster_ap", "mAP", "AP"),
    ("consistency AP", "consistency_ap", "mAP", "AP"),
    ("stability mAS", "stability", "mAS", "stability"),
    ("map precision at 1.0 m", "global_map", "precision@1.0", "precision@1.0"),
    ("map recall at 1.0 m", "global_map", "recall@1.0", "recall@1.0"),
    ("map F1 at 1.0 m", "global_map", "f1@1.0", "f1@1.0"),
    ("map element AP", "global_map", "element_mAP", "element_AP"),
    ("global AP, single scenes", "global_map_ap", "mAP", "AP"),
    ("global AP across scenes", "place_map_ap", "mAP", "AP"),
    ("lateral error, median (m)", "global_map", "lateral_median_m", "lateral_median_m"),
    ("lateral error, 95 % (m)", "global_map", "lateral_p95_m", "lateral_p95_m"),
    ("predicted per true element", "global_map", "fragmentation", "fragmentation"),
)
