"""Small drawings of a report as SVG: curves, bars, and the polylines of a frame."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from mapfusion.arrays import Float
from mapfusion.colours import KIND_COLOURS, darker, web_colour
from mapfusion.elements import ElementKind, RegionOfInterest
from predmapnet.evaluation.precision_recall import PrecisionRecallCurve

COLOURS = {kind: web_colour(darker(colour, 0.2)) for kind, colour in KIND_COLOURS.items()}
"""A little darker than on the dark background of a map, since a report is white."""
_SHADES = ("#9fb3c8", "#486581", "#102a43")
_SIDE = 240
_MARGIN = 34
_MOST_POINTS = 400


def draw_curves(curves: Sequence[PrecisionRecallCurve]) -> str:
    """Precision over recall, one line per threshold, the darkest for the largest."""
    parts = [_axes("recall", "precision")]
    for row, (curve, shade) in enumerate(zip(curves, _SHADES, strict=True)):
        count = len(curve.recall)
        # A few hundred points draw the same line as a hundred thousand.
        kept = np.unique(np.linspace(0, count - 1, min(count, _MOST_POINTS)).astype(int))
        points = " ".join(_at(curve.recall[index], curve.precision[index]) for index in kept)
        parts.append(f'<polyline points="{points}" fill="none" stroke="{shade}" stroke-width="1.6"/>')
        x, y = _MARGIN + 8, _MARGIN + _SIDE - 10 - 16 * row
        parts.append(f'<text x="{x}" y="{y}" font-size="11" fill="{shade}">{curve.threshold:g} m</text>')
    return _svg(_SIDE + 2 * _MARGIN, _SIDE + 2 * _MARGIN, "".join(parts))


def draw_bars(names: Sequence[str], values: Sequence[Sequence[float]]) -> str:
    """AP per threshold, a group of bars each, one bar per kind; an empty sequence leaves the kind out."""
    group = _SIDE / len(names)
    width = group / 4
    parts = [_axes("", "AP")]
    for column, name in enumerate(names):
        x = _MARGIN + column * group
        for kind in ElementKind:
            if len(values[kind]):
                height = _SIDE * values[kind][column]
                parts.append(
                    f'<rect x="{x + (0.5 + kind) * width:.1f}" y="{_MARGIN + _SIDE - height:.1f}" '
                    f'width="{width:.1f}" height="{height:.1f}" fill="{COLOURS[kind]}"/>'
                )
        parts.append(_text(x + group / 2, _MARGIN + _SIDE + 16, name))
    return _svg(_SIDE + 2 * _MARGIN, _SIDE + 2 * _MARGIN, "".join(parts))


def draw_frame(kinds: NDArray[np.int64], polylines: Sequence[Float], roi: RegionOfInterest) -> str:
    """The elements of one instant, x to the right and y up, with the car in the middle."""
    scale = 480 / roi.length
    width, height = scale * roi.length, scale * roi.width
    parts = [
        f'<rect width="{width:.0f}" height="{height:.0f}" fill="#f5f7fa" stroke="#cbd2d9"/>',
        f'<rect x="{width / 2 - 2.3 * scale:.1f}" y="{height / 2 - scale:.1f}" width="{4.6 * scale:.1f}" '
        f'height="{2 * scale:.1f}" fill="#7b8794"/>',
    ]
    for kind, points in zip(kinds, polylines, strict=True):
        pixels = (points * [1.0, -1.0] + roi.size / 2) * scale
        path = " ".join(f"{x:.1f},{y:.1f}" for x, y in pixels)
        colour = COLOURS[ElementKind(int(kind))]
        parts.append(f'<polyline points="{path}" fill="none" stroke="{colour}" stroke-width="2"/>')
    return _svg(round(width), round(height), "".join(parts))


def _axes(x_label: str, y_label: str) -> str:
    low, high = _MARGIN, _MARGIN + _SIDE
    parts = [f'<rect x="{low}" y="{low}" width="{_SIDE}" height="{_SIDE}" fill="none" stroke="#9aa5b1"/>']
    for tick in (0.0, 0.5, 1.0):
        y = high - tick * _SIDE
        parts.append(_text(low - 14, y + 4, f"{tick:g}"))
        parts.append(f'<line x1="{low}" x2="{high}" y1="{y}" y2="{y}" stroke="#e4e7eb"/>')
        if x_label:
            parts.append(_text(low + tick * _SIDE, high + 14, f"{tick:g}"))
    parts.append(_text((low + high) / 2, high + 28, x_label))
    parts.append(_text(low, low - 8, y_label))
    return "".join(parts)


def _at(x: float, y: float) -> str:
    return f"{_MARGIN + x * _SIDE:.1f},{_MARGIN + (1 - y) * _SIDE:.1f}"


def _text(x: float, y: float, text: str) -> str:
    return f'<text x="{x:.1f}" y="{y:.1f}" font-size="11" text-anchor="middle" fill="#52606d">{text}</text>'


def _svg(width: int, height: int, content: str) -> str:
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{width}" height="{height}" '
        f'viewBox="0 0 {width} {height}" font-family="system-ui, sans-serif">{content}</svg>'
    )
