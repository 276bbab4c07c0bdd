"""Reading of Lanelet2 files (OSM XML), also after JOSM has edited them."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import shapely

from mapfusion import json_text
from mapfusion.elements import ElementKind, GlobalMap
from mapfusion.formats.features import Feature, map_of
from mapfusion.formats.lanelet2 import LOCAL_PLANE, PREFIX, TYPES
from mapfusion.formats.reading_notes import ReadingNotes
from mapfusion.formats.reference_systems import ToDegrees
from mapfusion.georeference import LOCAL_FRAME, InvertibleGeoreference

KINDS = {name: kind.label for kind, name in TYPES.items()} | {"line_thick": ElementKind.DIVIDER.label}
CROSSING = ElementKind.PED_CROSSING.label


def read_lanelet(path: Path, georeference: InvertibleGeoreference | None = None) -> GlobalMap:
    """Read a map that :func:`mapfusion.formats.lanelet2.write_lanelet` wrote; what an editor deleted stays so.

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
    meta = root.find("meta")
    try:
        origin = None if meta is None else json_text.parse(meta.attrib["provenance"].encode())
        local = isinstance(origin, dict) and LOCAL_FRAME in origin
        features = list(_Document(root, local, notes).features())
    except (KeyError, ValueError) as error:
        raise ValueError(f"{path}: not a map of ours: {error}") from error
    to_degrees = ToDegrees("EPSG:4326", str(path))
    return map_of((Feature(feature, to_degrees) for feature in features), origin, path, georeference, notes)


def _by_id(root: ElementTree.Element, name: str) -> dict[str | None, ElementTree.Element]:
    """Return the nodes, ways or relations of a file by id; raises ValueError where two have the same."""
    found: dict[str | None, ElementTree.Element] = {}
    for each in root.iter(name):
        number = each.attrib.get("id")
        if number in found:
            raise ValueError(f"the {name} {number} is there twice")
        found[number] = each
    return found


class _Document:
    """Nodes, ways and relations of a file by id."""

    def __init__(self, root: ElementTree.Element, local: bool, notes: ReadingNotes) -> None:
        self._local, self._notes = local, notes
        self._nodes, self._ways, relations = (_by_id(root, name) for name in ("node", "way", "relation"))
        self._relations = [each for each in relations.values() if _tags(each).get("subtype") == "crosswalk"]
        if any(map(_deleted, [*self._ways.values(), *self._relations])):
            notes.add("ways and lanelets that are marked as deleted are left out")

    def features(self) -> Iterator[dict[str, Any]]:
        """Yield ways and crosswalk lanelets as GeoJSON features, each in the order of the file."""
        sides = {member.attrib.get("ref") for relation in self._relations for member in relation.iter("member")}
        for number, way in self._ways.items():
            if _deleted(way) or number in sides:
                continue
            properties = _properties(way)
            ring = properties.get("kind") == CROSSING
            references = [node.attrib.get("ref") for node in way.iter("nd")]
            if ring and references[:1] != references[-1:] and f"{PREFIX}kind" not in _tags(way):
                self._notes.add("sides of a crossing without its lanelet are left out")
                continue
            yield _feature(properties, self._positions(way), ring)
        for relation in self._relations:
            if _deleted(relation):
                continue
            ring_positions = self._ring(relation)
            if ring_positions is not None:
                yield _feature({**_properties(relation), "kind": CROSSING}, ring_positions, True)

    def _ring(self, relation: ElementTree.Element) -> list[tuple[float, ...]] | None:
        """Return the ring between the two sides of a crosswalk lanelet; None if one is missing."""
        ways = {
            member.attrib.get("role"): self._ways.get(member.attrib.get("ref")) for member in relation.iter("member")
        }
        left, right = ways.get("left"), ways.get("right")
        if left is None or right is None or _deleted(left) or _deleted(right):
            self._notes.add("a crosswalk lanelet without its two sides: left out")
            return None
        first, second = self._positions(right), self._positions(left)
        rings = [_joined(first, second[::-1]), _joined(first, second)]  # sides drawn by hand may run against each other
        return next((ring for ring in rings if _is_simple(ring)), rings[0])

    def _positions(self, way: ElementTree.Element) -> list[tuple[float, ...]]:
        name = f"way {way.attrib.get('id')}"
        points: list[tuple[float, ...]] = []
        for reference in way.iter("nd"):
            node = self._nodes.get(reference.attrib.get("ref"))
            if node is None:
                raise ValueError(
                    f"{name} goes through the node {reference.attrib.get('ref')}, which is not in the file"
                )
            if _deleted(node):
                self._notes.add("nodes that are marked as deleted are left out")
                continue
            try:
                points.append(self._position(node))
            except (KeyError, ValueError) as error:
                raise ValueError(
                    f"node {node.attrib.get('id')} of {name} has no latitude and longitude; local_x and local_y alone "
                    "can be read only of a map whose provenance names its local frame"
                ) from error
        return points

    def _position(self, node: ElementTree.Element) -> tuple[float, ...]:
        tags = _tags(node)
        height = float(tags.get("ele", 0.0))
        if not self._local:
            return float(node.attrib["lon"]), float(node.attrib["lat"]), height
        metres = np.array([[float(tags["local_x"]), float(tags["local_y"])]])
        return (*LOCAL_PLANE.to_wgs84(metres)[0].tolist(), height)


def _joined(right: list[tuple[float, ...]], left: list[tuple[float, ...]]) -> list[tuple[float, ...]]:
    """Return the ring of two sides; a corner that both of them have counts once."""
    ring = [*right, *left, *right[:1]]
    return [position for row, position in enumerate(ring) if row == 0 or position != ring[row - 1]]


def _is_simple(ring: list[tuple[float, ...]]) -> bool:
    corners = np.array([position[:2] for position in ring])
    return len(ring) >= 4 and bool(np.isfinite(corners).all()) and bool(shapely.Polygon(corners).is_valid)


def _deleted(thing: ElementTree.Element) -> bool:
    """Whether JOSM or a server has marked a node, way or relation as deleted."""
    return thing.attrib.get("action") == "delete" or thing.attrib.get("visible") == "false"


def _tags(thing: ElementTree.Element) -> dict[str, str]:
    return {tag.attrib.get("k", ""): tag.attrib.get("v", "") for tag in thing.iter("tag")}


def _properties(thing: ElementTree.Element) -> dict[str, Any]:
    """Return the properties of a way or a relation: its own tags, and what Lanelet2's tags say where those do not."""
    tags = _tags(thing)
    properties: dict[str, Any] = {key.removeprefix(PREFIX): tags[key] for key in tags if key.startswith(PREFIX)}
    if "type" in tags:
        properties.setdefault("kind", KINDS.get(tags["type"], tags["type"]))
    if properties.get("kind") == ElementKind.DIVIDER.label:
        told, subtype = properties.get("paint"), tags.get("subtype", "")
        # Written for an unknown paint is solid: anything else, or solid without that tag, comes from an editor.
        properties["paint"] = None if told == "unknown" and subtype == "solid" else subtype
    return properties


def _feature(properties: Mapping[str, Any], points: list[tuple[float, ...]], ring: bool) -> dict[str, Any]:
    geometry = {"type": "Polygon", "coordinates": [points]} if ring else {"type": "LineString", "coordinates": points}
    return {"geometry": geometry, "properties": properties}
