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
    lines = map_path.with_suffix(".lines.qml")
    crossings = map_path.with_suffix(".crossings.qml")
    _write(lines, "line", [ElementKind.DIVIDER, ElementKind.BOUNDARY])
    _write(crossings, "fill", [ElementKind.PED_CROSSING])
    return lines, crossings


def _write(path: Path, symbol: str, kinds: list[ElementKind]) -> None:
    categories = "".join(
        f'<category symbol="{place}" value="{kind.label}" label="{kind.label.replace("_", " ")}" render="true"/>'
        for place, kind in enumerate(kinds)
    )
    symbols = "".join(_symbol(place, symbol, kind) for place, kind in enumerate(kinds))
    text = (
        "<!DOCTYPE qgis PUBLIC 'http://mrcc.com/qgis.dtd' 'SYSTEM'>\n"
        '<qgis version="3.22" styleCategories="Symbology">\n'
        '<renderer-v2 type="categorizedSymbol" attr="kind" symbollevels="0" forceraster="0" enableorderby="0">'
        f"<categories>{categories}</categories><symbols>{symbols}</symbols></renderer-v2>\n</qgis>\n"
    )
    with write_whole(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def _symbol(place: int, symbol: str, kind: ElementKind) -> str:
    red, green, blue = KIND_COLOURS[kind]
    solid, pale = f"{red},{green},{blue},255", f"{red},{green},{blue},70"
    if symbol == "line":
        layer = _layer("SimpleLine", {"line_color": solid, "line_width": f"{WIDTHS[kind]}", "line_width_unit": "MM"})
    else:
        layer = _layer(
            "SimpleFill",
            {"color": pale, "style": "solid", "outline_color": solid, "outline_width": f"{WIDTHS[kind]}"},
        )
    fade = (
        '<data_defined_properties><Option type="Map"><Option name="name" type="QString" value=""/>'
        '<Option name="properties" type="Map"><Option name="alpha" type="Map">'
        '<Option name="active" type="bool" value="true"/>'
        '<Option name="expression" type="QString" value="30 + 70 * &quot;confidence&quot;"/>'
        '<Option name="type" type="int" value="3"/></Option></Option>'
        '<Option name="type" type="QString" value="collection"/></Option></data_defined_properties>'
    )
    return f'<symbol name="{place}" type="{symbol}" alpha="1" clip_to_extent="1">{fade}{layer}</symbol>'


def _layer(name: str, options: dict[str, str]) -> str:
    entries = "".join(f'<Option name="{key}" type="QString" value="{value}"/>' for key, value in options.items())
    return f'<layer class="{name}" enabled="1" locked="0" pass="0"><Option type="Map">{entries}</Option></layer>'
