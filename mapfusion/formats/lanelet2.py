"""Lanelet2 files (OSM XML): the physical layer only, as a map of lines is no map of lanes.

Dividers become ways of type ``line_thin``, boundaries ``road_border`` and crossings closed ways
``pedestrian_marking`` (Lanelet2's documentation, LinestringTagging). Whether a divider is solid or dashed is not known,
so there is no subtype. Nodes have latitude, longitude and, as ``local_x`` and ``local_y``, metres of the map's own
frame. What else is known of an element stands in tags that begin with ``predmapnet:``.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any
from xml.etree import ElementTree
from xml.sax.saxutils import quoteattr

import shapely

from mapfusion.elements import ElementKind, GlobalMap, MapElement
from mapfusion.files import write_whole
from mapfusion.formats.features import Feature, map_of
from mapfusion.formats.geojson import feature_of, origin_of
from mapfusion.formats.reading_notes import ReadingNotes
from mapfusion.formats.reference_systems import ToDegrees
from mapfusion.georeference import Georeference, InvertibleGeoreference

TYPES = {
    ElementKind.PED_CROSSING: "pedestrian_marking",
    ElementKind.DIVIDER: "line_thin",
    ElementKind.BOUNDARY: "road_border",
}
KINDS = {name: kind.label for kind, name in TYPES.items()}
PREFIX = "predmapnet:"


def write_lanelet(
    global_map: GlobalMap, path: Path, georeference: Georeference, provenance: Mapping[str, Any] | None = None
) -> None:
    """Write a map as OSM XML (``.osm``); complete or not at all.

    Raises:
        ValueError: coordinates that are not on the globe.
        OSError: the file cannot be written.
    """
    origin = origin_of({**global_map.provenance, **(provenance or {})}, georeference)
    with write_whole(path) as temporary, temporary.open("w", encoding="utf-8") as file:
        file.write(
            '<?xml version="1.0" encoding="UTF-8"?>\n<osm version="0.6" upload="false" generator="predmapnet">\n'
        )
        file.write(f"  <meta provenance={quoteattr(json.dumps(origin, allow_nan=False))}/>\n")
        ways: list[str] = []
        number = 0
        for element in global_map:
            first = number + 1
            feature = feature_of(element, georeference)
            for line in _nodes(element, feature, first):
                file.write(line)
                number += 1
            ways.append(_way(element.kind, feature, first, number))
        for way_number, way in enumerate(ways, start=number + 1):
            file.write(f'  <way id="{way_number}" visible="true" version="1">\n{way}  </way>\n')
        file.write("</osm>\n")


def read_lanelet(path: Path, georeference: InvertibleGeoreference | None = None) -> GlobalMap:
    """Read a map that :func:`write_lanelet` wrote, also after JOSM has edited it; what is deleted there stays so.

    Arguments and result are those of :func:`mapfusion.formats.geojson.read_geojson`.

    Raises:
        ValueError: not a file of ours; says where it breaks.
        OSError: the file cannot be read.
    """
    try:
        root = ElementTree.parse(path).getroot()
    except (ElementTree.ParseError, LookupError, ValueError) as error:
        raise ValueError(f"{path}: not XML: {error}") from error
    if root.tag != "osm":
        raise ValueError(f"{path}: not OSM XML: the root is <{root.tag}>")
    notes = ReadingNotes()
    nodes = {node.attrib.get("id"): node for node in root.iter("node")}
    ways = [way for way in root.iter("way") if not _deleted(way)]
    if len(ways) < len(root.findall("way")):
        notes.add("ways that are marked as deleted are left out")
    meta = root.find("meta")
    try:
        features = [_feature(way, nodes, place, notes) for place, way in enumerate(ways)]
        origin = None if meta is None else json.loads(meta.attrib["provenance"])
    except (KeyError, ValueError) as error:
        raise ValueError(f"{path}: not a map of ours: {error}") from error
    to_degrees = ToDegrees("EPSG:4326", str(path))
    return map_of((Feature(feature, to_degrees) for feature in features), origin, path, georeference, notes)


def _deleted(thing: ElementTree.Element) -> bool:
    """Whether JOSM or a server has marked a node or way as deleted."""
    return thing.attrib.get("action") == "delete" or thing.attrib.get("visible") == "false"


def _nodes(element: MapElement, feature: Mapping[str, Any], first: int) -> Iterator[str]:
    ring = element.kind.is_ring
    positions = feature["geometry"]["coordinates"][0][:-1] if ring else feature["geometry"]["coordinates"]
    local = element.points[:-1] if ring else element.points
    if ring and not shapely.LinearRing(element.points).is_ccw:
        local = element.points[::-1][:-1]
    for number, (position, (x, y)) in enumerate(zip(positions, local.tolist(), strict=True), start=first):
        longitude, latitude, *height = position
        yield (
            f'  <node id="{number}" visible="true" version="1" lat="{latitude!r}" lon="{longitude!r}">\n'
            f'    <tag k="ele" v="{height[0] if height else 0.0}"/>\n'
            f'    <tag k="local_x" v="{x:.4f}"/>\n    <tag k="local_y" v="{y:.4f}"/>\n  </node>\n'
        )


def _way(kind: ElementKind, feature: Mapping[str, Any], first: int, last: int) -> str:
    references = [*range(first, last + 1), *([first] if kind.is_ring else [])]
    tags = {"type": TYPES[kind], **{PREFIX + key: _text(value) for key, value in feature["properties"].items()}}
    nodes = "".join(f'    <nd ref="{reference}"/>\n' for reference in references)
    return nodes + "".join(f"    <tag k={quoteattr(key)} v={quoteattr(value)}/>\n" for key, value in tags.items())


def _ele(node: ElementTree.Element) -> float:
    """Return the height of a node, metres, 0 for one that says none; raises ValueError for what is no number."""
    return next((float(tag.attrib["v"]) for tag in node.iter("tag") if tag.attrib.get("k") == "ele"), 0.0)


def _text(value: Any) -> str:
    return value if isinstance(value, str) else json.dumps(value)


def _feature(
    way: ElementTree.Element, nodes: Mapping[str | None, ElementTree.Element], place: int, notes: ReadingNotes
) -> dict[str, Any]:
    """Return a way as a GeoJSON feature; raises ValueError for one whose nodes are missing or nowhere."""
    name = f"way {way.attrib.get('id')}"
    points = []
    for reference in way.iter("nd"):
        node = nodes.get(reference.attrib.get("ref"))
        if node is None:
            raise ValueError(f"{name} goes through the node {reference.attrib.get('ref')}, which is not in the file")
        if _deleted(node):
            notes.add("nodes that are marked as deleted are left out", place)
            continue
        try:
            points.append((float(node.attrib["lon"]), float(node.attrib["lat"]), _ele(node)))
        except (KeyError, ValueError) as error:
            raise ValueError(
                f"node {node.attrib.get('id')} of {name} has no latitude and longitude; a map in local_x and local_y "
                "alone cannot be read"
            ) from error
    properties: dict[str, Any] = {}
    for tag in way.iter("tag"):
        key, value = tag.attrib.get("k", ""), tag.attrib.get("v", "")
        if key == "type":
            properties.setdefault("kind", KINDS.get(value, value))
        if key.startswith(PREFIX):
            properties[key.removeprefix(PREFIX)] = value
    ring = properties.get("kind") == ElementKind.PED_CROSSING.label
    geometry = {"type": "Polygon", "coordinates": [points]} if ring else {"type": "LineString", "coordinates": points}
    return {"geometry": geometry, "properties": properties}
