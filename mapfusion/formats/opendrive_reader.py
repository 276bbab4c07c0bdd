"""Reading of OpenDRIVE files that :mod:`mapfusion.formats.opendrive` wrote, also after they were edited."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np

from mapfusion.arrays import Float
from mapfusion.elements import ElementKind, GlobalMap
from mapfusion.formats.features import Feature, map_of
from mapfusion.formats.foreign_values import json_of
from mapfusion.formats.lanelet2 import PREFIX
from mapfusion.formats.opendrive import MARKS
from mapfusion.formats.reading_notes import ReadingNotes
from mapfusion.formats.reference_systems import ToDegrees
from mapfusion.georeference import InvertibleGeoreference

PAINTS = {mark: paint for paint, mark in MARKS.items()}


def read_opendrive(path: Path, georeference: InvertibleGeoreference | None = None) -> GlobalMap:
    """Read a map; roads without properties of ours are read by the road mark of their centre lane.

    Arguments and result are those of :func:`mapfusion.formats.geojson.read_geojson`.

    Raises:
        ValueError: not OpenDRIVE, or no reference system; says where it breaks.
        OSError: the file cannot be read.
    """
    try:
        root = ElementTree.parse(path).getroot()
    except (ElementTree.ParseError, LookupError, ValueError) as error:
        raise ValueError(f"{path}: not XML, and so no map: {error}") from error
    if root.tag != "OpenDRIVE":
        raise ValueError(f"{path}: not an OpenDRIVE map: the root is <{root.tag}>")
    notes = ReadingNotes()
    try:
        origin = json_of(_user_data(root.find("header")).get("predmapnet"))
        found = [feature for road in root.iter("road") for feature in _features(road, notes)]
    except (KeyError, ValueError) as error:
        raise ValueError(f"{path}: not a map of ours: {error}") from error
    to_degrees = ToDegrees((root.findtext("header/geoReference") or "").strip(), str(path)) if found else _WGS84
    return map_of((Feature(feature, to_degrees) for feature in found), origin, path, georeference, notes)


_WGS84 = ToDegrees("EPSG:4326", "")


def _features(road: ElementTree.Element, notes: ReadingNotes) -> Iterator[dict[str, Any]]:
    """Yield the line of a road and its crossings as features."""
    points = _plan(road, notes)
    mark = road.find("lanes/laneSection/center/lane/roadMark")
    kind = "none" if mark is None else mark.attrib.get("type", "none")
    told = _properties(road)
    if told or kind != "none":
        told.setdefault("kind", ElementKind.BOUNDARY.label if kind in ("edge", "curb") else ElementKind.DIVIDER.label)
        if told["kind"] == ElementKind.DIVIDER.label:
            told["paint"] = PAINTS.get(kind, kind)
        coordinates = np.column_stack([points, _heights(road, points)]).tolist()
        yield {"geometry": {"type": "LineString", "coordinates": coordinates}, "properties": told}
    for thing in road.iter("object"):
        if thing.attrib.get("type") == "crosswalk":
            yield _crossing(thing, points)


def _crossing(thing: ElementTree.Element, points: Float) -> dict[str, Any]:
    """Return a crossing: its corners are relative to its place on the road."""
    at, across, turn = (float(thing.attrib.get(name, 0.0)) for name in ("s", "t", "hdg"))
    lift = float(thing.attrib.get("zOffset", 0.0))
    steps = np.diff(points, axis=0)
    station = np.append(0.0, np.cumsum(np.linalg.norm(steps, axis=1)))
    piece = int(np.clip(np.searchsorted(station, at, side="right") - 1, 0, len(steps) - 1))
    along = steps[piece] / max(float(np.linalg.norm(steps[piece])), 1e-9)
    place = points[piece] + (at - station[piece]) * along + across * np.array([-along[1], along[0]])
    heading = float(np.arctan2(along[1], along[0])) + turn
    corners = np.array(
        [[float(corner.attrib[name]) for name in ("u", "v", "z")] for corner in thing.iter("cornerLocal")]
    )
    if not len(corners):
        raise ValueError(f"the crosswalk {thing.attrib.get('id')} has no outline of local corners")
    turned = corners[:, :2] @ np.array([[np.cos(heading), np.sin(heading)], [-np.sin(heading), np.cos(heading)]])
    ring = np.column_stack([place + turned, np.where(corners[:, 2] == 0.0, 0.0, corners[:, 2] + lift)]).tolist()
    properties = _properties(thing) | {"kind": ElementKind.PED_CROSSING.label}
    return {"geometry": {"type": "Polygon", "coordinates": [[*ring, ring[0]]]}, "properties": properties}


def _plan(road: ElementTree.Element, notes: ReadingNotes) -> Float:
    """Return the vertices of a reference line ``(n, 2)``; curves are taken as their chords."""
    pieces = road.findall("planView/geometry")
    if not pieces:
        raise ValueError(f"road {road.attrib.get('id')} has no planView")
    if any(piece.find("line") is None for piece in pieces):
        notes.add("curves of reference lines are taken as straight from their beginnings to their ends")
    table = np.array([[float(piece.attrib[name]) for name in ("x", "y", "hdg", "length")] for piece in pieces])
    end = table[-1, :2] + table[-1, 3] * np.array([np.cos(table[-1, 2]), np.sin(table[-1, 2])])
    return np.vstack([table[:, :2], end])


def _heights(road: ElementTree.Element, points: Float) -> Float:
    """Return the heights at the vertices, metres; 0 for a road without elevation."""
    rows = road.findall("elevationProfile/elevation")
    if not rows:
        return np.zeros(len(points))
    table = np.array([[float(row.attrib.get(name, 0.0)) for name in "sabcd"] for row in rows])
    station = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1)))
    row = np.clip(np.searchsorted(table[:, 0], station + 1e-6, side="right") - 1, 0, len(table) - 1)
    ahead = np.maximum(station - table[row, 0], 0.0)
    return np.asarray((table[row, 1:] * ahead[:, None] ** np.arange(4)).sum(axis=1))


def _user_data(thing: ElementTree.Element | None) -> dict[str, str]:
    found = [] if thing is None else thing.findall("userData")
    return {entry.attrib.get("code", ""): entry.attrib.get("value", "") for entry in found}


def _properties(thing: ElementTree.Element) -> dict[str, Any]:
    told = _user_data(thing)
    return {code.removeprefix(PREFIX): value for code, value in told.items() if code.startswith(PREFIX)}
