"""QGIS styles (.qml) with the colours of the viewer, one file for lines and one for crossings."""

from __future__ import annotations

from pathlib import Path

from mapfusion.colours import KIND_COLOURS
from mapfusion.elements import ElementKind
from mapfusion.files import write_whole

WIDTHS = {ElementKind.PED_CROSSING: 0.3, ElementKind.DIVIDER: 0.4, ElementKind.BOUNDARY: 0.6}
"""Millimetres on the screen."""


def write_styles(map_path: Path) -> tuple[Path, Path]:
    """Write ``<name>.lines.qml`` and ``<name>.crossings.qml`` beside a map, for *Layer, Properties, Load Style*.

    QGIS opens a map as one layer of lines and one of polygons; lines fade with falling confidence.

    Returns:
        The two files.

    Raises:
        OSError: a file cannot be written.
    """
    paths = map_path.with_suffix(".lines.qml"), map_path.with_suffix(".crossings.qml")
    for path, style in zip(paths, layer_styles("lines", "crossings", "observed").values(), strict=False):
        with write_whole(path) as temporary:
            temporary.write_text(style, encoding="utf-8")
    return paths


def layer_styles(lines: str, crossings: str, observed: str) -> dict[str, str]:
    """Return the styles (QML) of three layers by their names; the observed ground is a pale grey."""
    ground = f'<symbol name="0" type="fill" alpha="1">{_fill("128,128,128,40", "128,128,128,90", 0.2)}</symbol>'
    return {
        lines: _by_kind("line", [ElementKind.DIVIDER, ElementKind.BOUNDARY]),
        crossings: _by_kind("fill", [ElementKind.PED_CROSSING]),
        observed: _style(f'<renderer-v2 type="singleSymbol"><symbols>{ground}</symbols></renderer-v2>'),
    }


def _by_kind(symbol: str, kinds: list[ElementKind]) -> str:
    categories = "".join(
        f'<category symbol="{place}" value="{kind.label}" label="{kind.label.replace("_", " ")}" render="true"/>'
        for place, kind in enumerate(kinds)
    )
    symbols = "".join(_symbol(place, symbol, kind) for place, kind in enumerate(kinds))
    return _style(
        '<renderer-v2 type="categorizedSymbol" attr="kind" symbollevels="0" forceraster="0" enableorderby="0">'
        f"<categories>{categories}</categories><symbols>{symbols}</symbols></renderer-v2>"
    )


def _style(renderer: str) -> str:
    return (
        "<!DOCTYPE qgis PUBLIC 'http://mrcc.com/qgis.dtd' 'SYSTEM'>\n"
        f'<qgis version="3.22" styleCategories="Symbology">\n{renderer}\n</qgis>\n'
    )


def _symbol(place: int, symbol: str, kind: ElementKind) -> str:
    red, green, blue = KIND_COLOURS[kind]
    solid, pale = f"{red},{green},{blue},255", f"{red},{green},{blue},70"
    if symbol == "line":
        layer = _layer("SimpleLine", {"line_color": solid, "line_width": f"{WIDTHS[kind]}", "line_width_unit": "MM"})
    else:
        layer = _fill(pale, solid, WIDTHS[kind])
    fade = (
        '<data_defined_properties><Option type="Map"><Option name="name" type="QString" value=""/>'
        '<Option name="properties" type="Map"><Option name="alpha" type="Map">'
        '<Option name="active" type="bool" value="true"/>'
        '<Option name="expression" type="QString" value="30 + 70 * &quot;confidence&quot;"/>'
        '<Option name="type" type="int" value="3"/></Option></Option>'
        '<Option name="type" type="QString" value="collection"/></Option></data_defined_properties>'
    )
    return f'<symbol name="{place}" type="{symbol}" alpha="1" clip_to_extent="1">{fade}{layer}</symbol>'


def _fill(inner: str, outline: str, width: float) -> str:
    options = {"color": inner, "style": "solid", "outline_color": outline, "outline_width": f"{width}"}
    return _layer("SimpleFill", options)


def _layer(name: str, options: dict[str, str]) -> str:
    entries = "".join(f'<Option name="{key}" type="QString" value="{value}"/>' for key, value in options.items())
    return f'<layer class="{name}" enabled="1" locked="0" pass="0"><Option type="Map">{entries}</Option></layer>'
