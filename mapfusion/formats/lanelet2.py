"""Lanelet2 files (OSM XML) as Autoware reads them: lines, and crossings as lanelets of pedestrians.

Dividers become ways of type ``line_thin``, boundaries ``road_border``; a crossing is a lanelet of subtype
``crosswalk`` between two ways of type ``pedestrian_marking`` (Lanelet2's documentation, LinestringTagging and
LaneletAndAreaTagging). There are no lanelets of roads: a map of lines is no map of lanes. A divider whose paint is not
known has the subtype ``solid``, which allows least, and the tag ``predmapnet:paint`` says ``unknown``.

Nodes have latitude and longitude, or ``local_x`` and ``local_y`` in a frame whose place is not known, and always
``ele``, which is 0 where the height is not known. Ids stay the same from run to run. ``map_projector_info.yaml``, which
Autoware looks for in the same folder, is written beside the file. What else is known of an element stands in tags that
begin with ``predmapnet:``.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any
from xml.sax.saxutils import quoteattr

import numpy as np
import shapely

from mapfusion.arrays import Float
from mapfusion.elements import ElementKind, GlobalMap, MapElement
from mapfusion.files import write_whole
from mapfusion.formats.geojson import feature_of, origin_of
from mapfusion.formats.identities import StableNumbers, all_named
from mapfusion.formats.local_plane import LocalPlane
from mapfusion.formats.seal import write_sealed
from mapfusion.georeference import LOCAL_FRAME, Georeference

TYPES = {
    ElementKind.PED_CROSSING: "pedestrian_marking",
    ElementKind.DIVIDER: "line_thin",
    ElementKind.BOUNDARY: "road_border",
}
PREFIX = "predmapnet:"
PROJECTOR_INFO = "map_projector_info.yaml"
CROSSWALK = {
    "type": "lanelet",
    "subtype": "crosswalk",
    "location": "urban",
    "one_way": "no",
    "participant:pedestrian": "yes",
}
LOCAL_PLANE = LocalPlane(0.0, 0.0)
"""Plane of ``local_x`` and ``local_y`` in frames whose place is not known."""


def write_lanelet(
    global_map: GlobalMap, path: Path, georeference: Georeference, provenance: Mapping[str, Any] | None = None
) -> None:
    """Write a map as OSM XML (``.osm``) and the projector's file beside it; each complete or not at all.

    Raises:
        ValueError: coordinates that are not on the globe.
        OSError: a file cannot be written.
    """
    origin = origin_of({**global_map.provenance, **(provenance or {})}, georeference)
    sheet = _Sheet(local=LOCAL_FRAME in origin)
    for element in all_named(global_map):
        sheet.add(element, georeference)
    with write_sealed(path) as temporary, temporary.open("w", encoding="utf-8") as file:
        file.write(
            '<?xml version="1.0" encoding="UTF-8"?>\n<osm version="0.6" upload="false" generator="predmapnet">\n'
        )
        file.write('  <MetaInfo format_version="1.0" map_version="1"/>\n')
        file.write(f"  <meta provenance={quoteattr(json.dumps(origin, allow_nan=False))}/>\n")
        for part in (sheet.nodes, sheet.ways, sheet.relations):
            file.writelines(part)
        file.write("</osm>\n")
    with write_whole(path.with_name(PROJECTOR_INFO)) as temporary:
        temporary.write_text(_projector_info(sheet.local, georeference), encoding="utf-8")


def _projector_info(local: bool, georeference: Georeference) -> str:
    if local:
        return "projector_type: Local\n"
    longitude, latitude = np.round(georeference.to_wgs84(np.zeros((1, 2)))[0], 9).tolist()
    return (
        "projector_type: LocalCartesianUTM\nvertical_datum: WGS84\nmap_origin:\n"
        f"  latitude: {latitude}\n  longitude: {longitude}\n  altitude: 0.0\n"
    )


class _Sheet:
    """Sheet of nodes, ways and relations, as XML."""

    def __init__(self, local: bool) -> None:
        self.local = local
        self.nodes: list[str] = []
        self.ways: list[str] = []
        self.relations: list[str] = []
        self._numbers = StableNumbers()

    def add(self, element: MapElement, georeference: Georeference) -> None:
        if not element.kind.is_ring:
            feature = feature_of(element, georeference)
            nodes = self._add_nodes(element.name, feature["geometry"]["coordinates"])
            tags = {"type": TYPES[element.kind], **_own_tags(feature)}
            if element.kind is ElementKind.DIVIDER:
                tags |= {"subtype": element.paint or "solid", f"{PREFIX}paint": element.paint or "unknown"}
            self._add_way(element.name, nodes, tags)
            return
        element, corner = with_right_side_first(element)
        feature = feature_of(element, georeference)
        nodes = self._add_nodes(element.name, feature["geometry"]["coordinates"][0][:-1])
        right, left = nodes[:corner], nodes[corner:][::-1]
        if len(left) < 2:
            left = [right[0], *left]
        if len(right) < 2:
            right = [left[0], *right]
        side = {"type": TYPES[element.kind]}
        members = [
            (role, self._add_way(f"{element.name}/{role}", way, side))
            for role, way in (("left", left), ("right", right))
        ]
        number = self._numbers.of(element.name)
        lines = [f'    <member type="way" ref="{way}" role="{role}"/>\n' for role, way in members]
        content = "".join(lines) + _tags({**CROSSWALK, **_own_tags(feature)})
        self.relations.append(f'  <relation id="{number}" visible="true" version="1">\n{content}  </relation>\n')

    def _add_nodes(self, name: str, positions: list[list[float]]) -> list[int]:
        numbers = [self._numbers.of(f"{name}/{row}") for row in range(len(positions))]
        places = np.array([position[:2] for position in positions])
        local = LOCAL_PLANE.from_wgs84(places).round(4).tolist() if self.local else [None] * len(places)
        for number, (longitude, latitude, *height), metres in zip(numbers, positions, local, strict=True):
            tags: dict[str, Any] = {"ele": height[0] if height else 0.0}
            place = f' lat="{latitude!r}" lon="{longitude!r}"' if metres is None else ""
            if metres is not None:
                tags |= {"local_x": metres[0], "local_y": metres[1]}
            self.nodes.append(f'  <node id="{number}" visible="true" version="1"{place}>\n{_tags(tags)}  </node>\n')
        return numbers

    def _add_way(self, name: str, nodes: list[int], tags: Mapping[str, Any]) -> int:
        number = self._numbers.of(name)
        references = "".join(f'    <nd ref="{node}"/>\n' for node in nodes)
        self.ways.append(f'  <way id="{number}" visible="true" version="1">\n{references}{_tags(tags)}  </way>\n')
        return number


def with_right_side_first(element: MapElement) -> tuple[MapElement, int]:
    """Return a crossing whose ring turns counter-clockwise and begins with its right side, and the length of that side.

    The sides run along the crossing: between them lie the two edges that are farthest apart along its longer axis. Seen
    along the right side, the crossing lies to the left.
    """
    element = element.counter_clockwise()
    order = np.arange(len(element.points) - 1)
    corners = element.points[:-1]
    along = (corners + np.roll(corners, -1, axis=0)) @ _long_axis(element.points)
    first, last = int(np.argmin(along)), int(np.argmax(along))
    corner = (last - first) % len(order)
    order = np.roll(order, -(first + 1))
    rows = np.append(order, order[0])
    return element.with_vertices(rows), corner


def _long_axis(ring: Float) -> Float:
    """Return the unit direction ``(2,)`` of the longer side of the smallest rectangle around a ring."""
    corners = shapely.get_coordinates(shapely.oriented_envelope(shapely.Polygon(ring)))
    sides = np.diff(corners[:3], axis=0)
    longer = sides[int(np.argmax(np.linalg.norm(sides, axis=1)))]
    return np.asarray(longer / max(float(np.linalg.norm(longer)), 1e-9))


def _own_tags(feature: Mapping[str, Any]) -> dict[str, Any]:
    return {f"{PREFIX}id": feature["id"]} | {PREFIX + key: value for key, value in feature["properties"].items()}


def _tags(tags: Mapping[str, Any]) -> str:
    texts = {key: value if isinstance(value, str) else json.dumps(value) for key, value in tags.items()}
    return "".join(f"    <tag k={quoteattr(key)} v={quoteattr(value)}/>\n" for key, value in texts.items())
