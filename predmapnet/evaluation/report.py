"""Reports of an evaluation: figures in JSON, and a self-contained HTML file."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from html import escape
from pathlib import Path
from typing import Any

import numpy as np
import orjson

import predmapnet
from mapfusion.elements import ElementKind
from predmapnet.evaluation.measurement import Measurement
from predmapnet.evaluation.precision_recall import KindResult
from predmapnet.evaluation.report_drawings import COLOURS, draw_bars, draw_curves, draw_frame
from predmapnet.evaluation.scene_figures import SCENE_FIGURES
from predmapnet.files import write_file

WORST_FRAMES = 8
SHOWN_SCORE = 0.4
"""Untracked predictions below this score are not drawn and do not make a frame bad."""

_STYLE = """
body { font: 15px/1.5 system-ui, sans-serif; color: #1f2933; max-width: 1100px; margin: 2rem auto; padding: 0 1rem; }
h1 { font-size: 1.5rem; } h2 { font-size: 1.15rem; margin-top: 2.2rem; }
table { border-collapse: collapse; } td, th { padding: .2rem .8rem; text-align: right; }
td:first-child, th:first-child { text-align: left; } th { border-bottom: 1px solid #9aa5b1; font-weight: 600; }
figure { display: inline-block; margin: .5rem 1rem .5rem 0; } figcaption { font-size: .85rem; color: #52606d; }
.wide { overflow-x: auto; font-size: .85rem; } .note { color: #52606d; } svg { background: #fff; }
"""


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
) -> None:
    """Write the HTML report: tables, precision-recall curves, AP per threshold, worst frames beside the truth.

    Args:
        path: the file; its folder exists.
        measurement: over all scenes.
        context: ``dataset``, ``split``, ``synthetic``, ``warnings``.
        per_scene: see :func:`predmapnet.evaluation.scene_figures.scene_figures`.
        origin: how the figures were made, by name: date, weights, command.

    Raises:
        UserError: the file cannot be written.
    """
    what = f"{context['dataset']}{', split ' + str(context['split']) if context['split'] else ''}"
    counts = f"{len(measurement.scenes)} scenes, {len(measurement.frames)} frames"
    synthetic = " The demo world is synthetic." if context["synthetic"] else ""
    parts = [
        f"<h1>PredMapNet on {escape(what)}</h1>",
        f'<p class="note">{counts}, predmapnet {predmapnet.__version__}.{synthetic}</p>',
        *(f'<p class="note">{escape(name)}: <code>{escape(text)}</code></p>' for name, text in origin.items()),
        *(f"<p>Note: {escape(text)}.</p>" for text in (*context["warnings"], *measurement.missing())),
        _legend(),
        "<h2>Figures</h2>",
        _figures_table(measurement.figures()),
        "<h2>Scenes, the worst first</h2>",
        _scenes_table(per_scene),
        "<h2>Precision over recall, chamfer AP</h2>",
        *(_figure(draw_curves(kind.curves), _curve_caption(kind)) for kind in measurement.chamfer.kinds),
        "<h2>AP per threshold</h2>",
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
    html = (
        f'<!doctype html><html lang="en"><head><meta charset="utf-8"><title>PredMapNet on {escape(what)}</title>'
        f"<style>{_STYLE}</style></head><body>{''.join(parts)}</body></html>\n"
    )
    with write_file(path) as temporary:
        temporary.write_text(html, encoding="utf-8")


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
    rows = np.argsort(np.nan_to_num(values, nan=np.inf), kind="stable")[:WORST_FRAMES]
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
    return f"{kind.kind.label}: {steps}"


def _legend() -> str:
    swatches = (
        f'<span style="color:{COLOURS[kind]}">&#9632;</span> {kind.label.replace("_", " ")} ' for kind in ElementKind
    )
    return f"<p>{''.join(swatches)}</p>"


def _figures_table(figures: Mapping[str, Any]) -> str:
    rows = ["<table><tr><th></th><th>all</th>" + "".join(f"<th>{kind.label}</th>" for kind in ElementKind) + "</tr>"]
    for title, group, overall, each in _ROWS:
        section = figures[group]
        if section is not None:
            values = [section[overall], *(section[kind.label][each] for kind in ElementKind)]
            rows.append(f"<tr><td>{title}</td>{_cells(values)}</tr>")
    return "".join(rows) + "</table>"


def _scenes_table(per_scene: Mapping[str, Mapping[str, float | int | None]]) -> str:
    """One row per scene; kinds that a scene does not hold are left out of its means."""
    headings = "".join(f"<th>{text}</th>" for text in ("scene", "frames", *SCENE_FIGURES.values()))

    def worth(name: str) -> float:
        value = per_scene[name]["chamfer_mAP"]
        return 2.0 if value is None else value

    rows = [
        f"<tr><td>{escape(name)}</td><td>{per_scene[name]['frames']}</td>"
        f"{_cells([per_scene[name][key] for key in SCENE_FIGURES])}</tr>"
        for name in sorted(per_scene, key=worth)
    ]
    return f'<div class="wide"><table><tr>{headings}</tr>{"".join(rows)}</table></div>'


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
    ("global AP (GlobalMapNet)", "global_map_ap", "mAP", "AP"),
    ("lateral error, median (m)", "global_map", "lateral_median_m", "lateral_median_m"),
    ("lateral error, 95 % (m)", "global_map", "lateral_p95_m", "lateral_p95_m"),
    ("predicted per true element", "global_map", "fragmentation", "fragmentation"),
)


def _cells(values: Sequence[float | None]) -> str:
    return "".join(f"<td>{'–' if value is None else f'{value:.3f}'}</td>" for value in values)
