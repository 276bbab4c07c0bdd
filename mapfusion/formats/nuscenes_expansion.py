"""Maps as JSON of the nuScenes map expansion, version 1.3, which the official devkit opens.

The devkit opens files by the names of its four maps only: copy the file to ``maps/expansion/<location>.json``. Metres
are those of the map's own frame, so that they fit the poses of the log. Crossings are in the layer ``ped_crossing``,
dividers in ``lane_divider``. The schema has no lines at the sides of roads: boundaries are in a layer of their own,
``road_boundary``, which the devkit passes over. All other layers are empty, and so is what a record would say of lanes
and road segments. The type of a divider's segments is ``NIL``, because the schema knows no paint without a colour;
``predmapnet`` has more.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any
from uuid import UUID

import numpy as np

from mapfusion.elements import ElementKind, GlobalMap, MapElement
from mapfusion.formats.features import Feature, map_of
from mapfusion.formats.frame_ties import MEMBER, TiedFrame, ties_of
from mapfusion.formats.geojson import feature_of, origin_of
from mapfusion.formats.identities import all_named
from mapfusion.formats.json_documents import Position, read_document, tied_feature
from mapfusion.formats.reading_notes import ReadingNotes
from mapfusion.formats.reference_systems import ToDegrees
from mapfusion.formats.seal import write_sealed
from mapfusion.georeference import Georeference, InvertibleGeoreference

LAYERS = {
    ElementKind.PED_CROSSING: "ped_crossing",
    ElementKind.DIVIDER: "lane_divider",
    ElementKind.BOUNDARY: "road_boundary",
}
EMPTY_LAYERS = (
    "drivable_area",
    "road_segment",
    "road_block",
    "lane",
    "walkway",
    "stop_line",
    "carpark_area",
    "road_divider",
    "traffic_light",
    "lane_connector",
)


def write_nuscenes(
    global_map: GlobalMap, path: Path, georeference: Georeference, provenance: Mapping[str, Any] | None = None
) -> None:
    """Write a map as nuScenes map expansion (``.nuscenes.json``); complete or not at all.

    Raises:
        ValueError: coordinates that are not on the globe.
        OSError: the file cannot be written.
    """
    origin = origin_of({**global_map.provenance, **(provenance or {})}, georeference)
    ties = ties_of(global_map, georeference)
    sheet: dict[str, Any] = {"version": "1.3", "canvas_edge": np.maximum(np.ceil(ties[-1][:2]), 1.0).tolist()}
    sheet |= {name: [] for name in ("polygon", "line", "node", *LAYERS.values(), *EMPTY_LAYERS)}
    sheet |= {"arcline_path_3": {}, "connectivity": {}, MEMBER: origin | {"ties": ties}}
    for element in all_named(global_map):
        _add(sheet, element.counter_clockwise(), georeference)
    with write_sealed(path) as temporary:
        temporary.write_text(json.dumps(sheet, separators=(",", ":"), allow_nan=False) + "\n", encoding="utf-8")


def _add(sheet: dict[str, Any], element: MapElement, georeference: Georeference) -> None:
    points = element.points[:-1] if element.kind.is_ring else element.points
    nodes = [_token(element.name, "node", row) for row in range(len(points))]
    for row, (token, (x, y)) in enumerate(zip(nodes, points.tolist(), strict=True)):
        height = {} if element.heights is None else {"z": float(element.heights[row])}
        sheet["node"].append({"token": token, "x": x, "y": y, **height})
    record: dict[str, Any] = {"token": _token(element.name)}
    feature = feature_of(element, georeference)
    if element.kind.is_ring:
        record |= {"polygon_token": _token(element.name, "polygon"), "road_segment_token": ""}
        sheet["polygon"].append({"token": record["polygon_token"], "exterior_node_tokens": nodes, "holes": []})
    else:
        record["line_token"] = _token(element.name, "line")
        sheet["line"].append({"token": record["line_token"], "node_tokens": nodes})
    if element.kind is ElementKind.DIVIDER:
        record["lane_divider_segments"] = [{"node_token": node, "segment_type": "NIL"} for node in nodes]
    record[MEMBER] = {"id": feature["id"], **feature["properties"]}
    sheet[LAYERS[element.kind]].append(record)


def _token(*what: object) -> str:
    return str(UUID(hex=hashlib.sha256(repr(what).encode()).hexdigest()[:32]))


def read_nuscenes(path: Path, georeference: InvertibleGeoreference | None = None) -> GlobalMap:
    """Read a map that :func:`write_nuscenes` wrote, also after it was edited.

    Arguments and result are those of :func:`mapfusion.formats.geojson.read_geojson`.

    Raises:
        ValueError: another file; says where it breaks.
        OSError: the file cannot be read.
    """
    notes = ReadingNotes()
    to_degrees = ToDegrees("EPSG:4326", str(path))
    with read_document(path, "nuScenes map expansion") as (document, origin):
        features = list(_features(document, TiedFrame(origin.get("ties"))))
    provenance = {name: value for name, value in origin.items() if name != "ties"}
    return map_of((Feature(feature, to_degrees) for feature in features), provenance, path, georeference, notes)


def _features(document: Mapping[str, Any], frame: TiedFrame) -> Iterator[dict[str, Any]]:
    nodes: dict[str, Position] = {
        node["token"]: (node["x"], node["y"], node.get("z", 0.0)) for node in document["node"]
    }
    lines = {line["token"]: line["node_tokens"] for line in document["line"]}
    rings = {polygon["token"]: polygon["exterior_node_tokens"] for polygon in document["polygon"]}
    for kind, layer in (*LAYERS.items(), (ElementKind.DIVIDER, "road_divider")):
        for record in document.get(layer, ()):
            tokens = rings[record["polygon_token"]] if kind.is_ring else lines[record["line_token"]]
            positions = [nodes[token] for token in [*tokens, *(tokens[:1] if kind.is_ring else ())]]
            yield tied_feature(kind, positions, record.get(MEMBER), frame)
