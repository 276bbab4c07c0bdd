"""Maps as Argoverse 2 map archives (JSON), which the official av2 package opens.

The package opens files whose names begin with ``log_map_archive_``. Metres are those of the map's own frame, so that
they fit the poses of the log. Archives have lanes, drivable areas and crossings, and no lines. A line is therefore a
lane segment without width: its left and right boundary are the line itself, the mark type is ``UNKNOWN`` for dividers
(no type is without a colour) and ``NONE`` for boundaries. Such a segment is no lane; it has no neighbours, and nothing
leads into it. Crossings have two edges of two points. A height that is not known is 0. The member ``predmapnet`` of
each record has what is known.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from mapfusion.arrays import Float
from mapfusion.elements import ElementKind, GlobalMap, MapElement
from mapfusion.formats.features import Feature, map_of
from mapfusion.formats.frame_ties import MEMBER, TiedFrame, ties_of
from mapfusion.formats.geojson import feature_of, origin_of
from mapfusion.formats.identities import StableNumbers, all_named
from mapfusion.formats.json_documents import Position, read_document, tied_feature
from mapfusion.formats.lanelet2 import with_right_side_first
from mapfusion.formats.reading_notes import ReadingNotes
from mapfusion.formats.reference_systems import ToDegrees
from mapfusion.formats.seal import write_sealed
from mapfusion.georeference import Georeference, InvertibleGeoreference

OUTLINE = "outline"
"""Key of a crossing's whole ring, of which the two edges are four corners."""


def write_argoverse2(
    global_map: GlobalMap, path: Path, georeference: Georeference, provenance: Mapping[str, Any] | None = None
) -> None:
    """Write a map as Argoverse 2 map archive (``.argoverse2.json``); complete or not at all.

    Raises:
        ValueError: coordinates that are not on the globe.
        OSError: the file cannot be written.
    """
    origin = origin_of({**global_map.provenance, **(provenance or {})}, georeference)
    lanes: dict[str, Any] = {}
    crossings: dict[str, Any] = {}
    numbers = StableNumbers()
    origin["ties"] = ties_of(global_map, georeference)
    for element in all_named(global_map):
        number = numbers.of(element.name)
        (crossings if element.kind.is_ring else lanes)[str(number)] = {"id": number, **_record(element, georeference)}
    archive = {"pedestrian_crossings": crossings, "lane_segments": lanes, "drivable_areas": {}, MEMBER: origin}
    with write_sealed(path) as temporary:
        temporary.write_text(json.dumps(archive, separators=(",", ":"), allow_nan=False) + "\n", encoding="utf-8")


def _record(element: MapElement, georeference: Georeference) -> dict[str, Any]:
    corner = 0
    if element.kind.is_ring:
        element, corner = with_right_side_first(element)
    feature = feature_of(element, georeference)
    points = _points(element.points, element.heights)
    told = {"id": feature["id"], **feature["properties"]}
    if element.kind.is_ring:
        right, left = points[:corner], points[corner:-1][::-1]
        edges = {"edge1": [right[0], right[-1]], "edge2": [left[0], left[-1]]}
        return {**edges, MEMBER: told | {OUTLINE: points}}
    mark = "NONE" if element.kind is ElementKind.BOUNDARY else "UNKNOWN"
    return {
        "is_intersection": False,
        "lane_type": "VEHICLE",
        "left_lane_boundary": points,
        "left_lane_mark_type": mark,
        "right_lane_boundary": points,
        "right_lane_mark_type": mark,
        "predecessors": [],
        "successors": [],
        "left_neighbor_id": None,
        "right_neighbor_id": None,
        MEMBER: told,
    }


def _points(points: Float, heights: Float | None) -> list[dict[str, float]]:
    table = np.column_stack([points, np.zeros(len(points)) if heights is None else heights])
    return [dict(zip("xyz", row, strict=True)) for row in table.tolist()]


def read_argoverse2(path: Path, georeference: InvertibleGeoreference | None = None) -> GlobalMap:
    """Read a map that :func:`write_argoverse2` wrote, also after it was edited; lanes that were added are two dividers.

    Arguments and result are those of :func:`mapfusion.formats.geojson.read_geojson`.

    Raises:
        ValueError: another file; says where it breaks.
        OSError: the file cannot be read.
    """
    notes = ReadingNotes()
    to_degrees = ToDegrees("EPSG:4326", str(path))
    with read_document(path, "Argoverse 2 map archive") as (document, origin):
        features = list(_features(document, TiedFrame(origin.get("ties")), notes))
    provenance = {name: value for name, value in origin.items() if name != "ties"}
    return map_of((Feature(feature, to_degrees) for feature in features), provenance, path, georeference, notes)


def _features(document: Mapping[str, Any], frame: TiedFrame, notes: ReadingNotes) -> Iterator[dict[str, Any]]:
    for lane in document["lane_segments"].values():
        told = lane.get(MEMBER)
        if told is None:
            notes.add("lane segments without properties of ours: their boundaries are taken as dividers")
        sides = ("left_lane_boundary", "right_lane_boundary")[: 1 if told else 2]
        for side in sides:
            kind = ElementKind[str((told or {}).get("kind", "divider")).upper()]
            yield tied_feature(kind, _positions(lane[side]), told, frame)
    for crossing in document["pedestrian_crossings"].values():
        told = dict(crossing.get(MEMBER) or {})
        outline = told.pop(OUTLINE, None)
        edges = [*crossing["edge1"], *crossing["edge2"][::-1]]
        whole = outline is not None and all(corner in outline for corner in edges)
        ring = _positions(outline if whole else [*edges, edges[0]])
        yield tied_feature(ElementKind.PED_CROSSING, ring, told, frame)


def _positions(points: list[Mapping[str, float]]) -> list[Position]:
    return [(point["x"], point["y"], point["z"]) for point in points]
