"""OpenDRIVE files (.xodr, version 1.7): lines as reference lines with road marks, crossings as objects.

A map of lines does not know lanes, directions, widths or junctions, so none are made up. Each line is a road of its own
that consists of its reference line: the centre lane, which has no width, with a road mark: ``edge`` for a boundary;
``solid`` or ``broken`` for a divider, ``custom`` where its paint is not known. The road has the type ``unknown``, no
lanes beside the centre and no neighbours. Heights, where they are known, are its elevation. A crossing is an object of
type ``crosswalk`` on a short road of that kind without a mark, which lies across it.

The projection is a transverse Mercator about the origin of the map's frame. What else is known stands in ``userData``
whose codes begin with ``predmapnet:``.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any
from xml.sax.saxutils import escape, quoteattr

import numpy as np

from mapfusion.arrays import Float
from mapfusion.elements import ElementKind, GlobalMap, MapElement
from mapfusion.formats.geojson import feature_of, origin_of
from mapfusion.formats.identities import StableNumbers, all_named
from mapfusion.formats.lanelet2 import PREFIX
from mapfusion.formats.seal import write_sealed
from mapfusion.geometry import arc_length
from mapfusion.georeference import Georeference

MARKS = {"solid": "solid", "dashed": "broken", "": "custom"}
"""Types of road marks by the paint of a divider."""

CARRIER = 1.0
"""Length of the road that carries a crossing, metres."""


def write_opendrive(
    global_map: GlobalMap, path: Path, georeference: Georeference, provenance: Mapping[str, Any] | None = None
) -> None:
    """Write a map as OpenDRIVE (``.xodr``); complete or not at all.

    Raises:
        ValueError: coordinates that are not on the globe.
        OSError: the file cannot be written.
    """
    from pyproj import Transformer

    origin = origin_of({**global_map.provenance, **(provenance or {})}, georeference)
    longitude, latitude = np.round(georeference.to_wgs84(np.zeros((1, 2)))[0], 9).tolist()
    projection = f"+proj=tmerc +lat_0={latitude} +lon_0={longitude} +k=1 +x_0=0 +y_0=0 +datum=WGS84 +units=m +no_defs"
    to_metres = Transformer.from_crs("EPSG:4326", projection, always_xy=True)
    numbers = StableNumbers()
    roads: list[str] = []
    corners: list[Float] = []
    for element in all_named(global_map):
        element = element.counter_clockwise()
        feature = feature_of(element, georeference)
        rows = feature["geometry"]["coordinates"]
        table = np.array(rows[0] if element.kind.is_ring else rows)
        points = np.stack(to_metres.transform(table[:, 0], table[:, 1]), axis=1)
        heights = table[:, 2] if table.shape[1] == 3 else None
        corners.append(points)
        write = _crossing if element.kind.is_ring else _line
        roads.append(write(element, points, heights, numbers.of(element.name), _user_data(feature)))
    low, high = (
        function(np.concatenate(corners or [np.zeros((1, 2))]), axis=0).tolist() for function in (np.min, np.max)
    )
    with write_sealed(path) as temporary, temporary.open("w", encoding="utf-8") as file:
        file.write('<?xml version="1.0" encoding="UTF-8"?>\n<OpenDRIVE>\n')
        file.write(
            f'  <header revMajor="1" revMinor="7" name="" version="1.00" date={quoteattr(origin["created"])} '
            f'north="{high[1]!r}" south="{low[1]!r}" east="{high[0]!r}" west="{low[0]!r}" vendor="predmapnet">\n'
            f"    <geoReference>{escape(projection)}</geoReference>\n"
            f'    <userData code="predmapnet" value={quoteattr(json.dumps(origin, allow_nan=False))}/>\n  </header>\n'
        )
        file.writelines(roads)
        file.write("</OpenDRIVE>\n")


def _line(element: MapElement, points: Float, heights: Float | None, number: int, told: str) -> str:
    mark = "edge" if element.kind is ElementKind.BOUNDARY else MARKS[element.paint]
    return _road(element.name, number, points, _elevations(arc_length(points), heights), _mark(mark), told)


def _mark(kind: str) -> str:
    return f'<roadMark sOffset="0" type="{kind}" weight="standard" color="standard"/>'


def _crossing(element: MapElement, points: Float, heights: Float | None, number: int, told: str) -> str:
    """Return a carrier along x through the middle of a crossing, with the crossing as an object."""
    middle = (points.min(axis=0) + points.max(axis=0)) / 2
    z = np.zeros(len(points)) if heights is None else heights
    corners = "".join(
        f'            <cornerLocal u="{u!r}" v="{v!r}" z="{height!r}" height="0"/>\n'
        for (u, v), height in zip((points - middle)[:-1].tolist(), z[:-1].tolist(), strict=True)
    )
    objects = (
        f'    <objects>\n      <object type="crosswalk" id="{number}" name={quoteattr(element.name)} s="{CARRIER / 2}" '
        f't="0" zOffset="0" hdg="0" pitch="0" roll="0" orientation="none">\n        <outlines>\n'
        f'          <outline id="0" closed="true" outer="true">\n{corners}          </outline>\n        </outlines>\n'
        f"{told}      </object>\n    </objects>\n"
    )
    carrier = middle + np.array([[-CARRIER / 2, 0.0], [CARRIER / 2, 0.0]])
    return _road(f"under {element.name}", number, carrier, "", _mark("none"), objects)


def _road(name: str, number: int, points: Float, elevations: str, mark: str, rest: str) -> str:
    steps = np.diff(points, axis=0)
    lengths, headings = np.linalg.norm(steps, axis=1), np.arctan2(steps[:, 1], steps[:, 0])
    stations = np.cumsum(lengths) - lengths
    pieces = "".join(
        f'      <geometry s="{s!r}" x="{x!r}" y="{y!r}" hdg="{heading!r}" length="{length!r}"><line/></geometry>\n'
        for s, (x, y), heading, length in zip(
            stations.tolist(), points[:-1].tolist(), headings.tolist(), lengths.tolist(), strict=True
        )
    )
    return (
        f'  <road name={quoteattr(name)} length="{float(lengths.sum())!r}" id="{number}" junction="-1">\n'
        f'    <type s="0" type="unknown"/>\n    <planView>\n{pieces}    </planView>\n'
        f"    <elevationProfile>\n{elevations}    </elevationProfile>\n"
        '    <lanes>\n      <laneSection s="0">\n        <center>\n'
        f'          <lane id="0" type="none" level="false">{mark}</lane>\n'
        f"        </center>\n      </laneSection>\n    </lanes>\n{rest}  </road>\n"
    )


def _elevations(station: Float, heights: Float | None) -> str:
    """Return the heights as straight slopes from vertex to vertex; nothing where they are not known."""
    if heights is None:
        return ""
    slopes = np.diff(heights) / np.maximum(np.diff(station), 1e-9)
    return "".join(
        f'      <elevation s="{s!r}" a="{a!r}" b="{b!r}" c="0" d="0"/>\n'
        for s, a, b in zip(station.tolist(), heights.tolist(), [*slopes.tolist(), 0.0], strict=True)
    )


def _user_data(feature: Mapping[str, Any]) -> str:
    told = {"id": feature["id"], **feature["properties"]}
    texts = {name: value if isinstance(value, str) else json.dumps(value) for name, value in told.items()}
    return "".join(f'    <userData code="{PREFIX}{name}" value={quoteattr(text)}/>\n' for name, text in texts.items())
