"""Elements from the features of a map file, whatever program saved it last.

A map that :mod:`mapfusion.formats` wrote comes back as it was. Editors of maps (QGIS, JOSM, GDAL) write times anew,
leave nulls in rows that a person drew, add vertices, and change geometries into multi-part ones: such features are read
as a person means them, and notes say what was supplied, repaired or left out.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from mapfusion.arrays import Float
from mapfusion.elements import PAINTS, ElementKind, GlobalMap, MapElement
from mapfusion.formats.foreign_shapes import DrawnPath, paths_of
from mapfusion.formats.foreign_values import list_of, number_of, time_of, whole_numbers_of
from mapfusion.formats.identities import digest_name
from mapfusion.formats.local_plane import LocalPlane
from mapfusion.formats.reading_notes import ReadingNotes
from mapfusion.formats.reference_systems import ToDegrees
from mapfusion.georeference import InvertibleGeoreference
from mapfusion.road_heights import filled

HEIGHTS = "heights_m"
"""Column with the heights of the vertices, in formats whose geometries have none."""

DIFFERENCE = ("change", "moved_m")
"""Properties of the features of a file of differences (:mod:`mapfusion.diff_files`), which no element has."""

SURE = 1.0
"""Confidence of an element that a person drew."""


@dataclass(frozen=True)
class Feature:
    """Feature of a file, as it is stored.

    Attributes:
        content: with ``geometry`` and ``properties``.
        to_degrees: of its reference system.
    """

    content: Any
    to_degrees: ToDegrees


@dataclass
class _Element:
    """Element of a feature with what the file says of it; None where it says nothing."""

    place: int
    kind: ElementKind
    degrees: Float
    heights: Float | None
    deviation: Float | None
    confidence: float | None
    observations: float | None
    first_seen: int | None
    last_seen: int | None
    track_ids: tuple[int, ...]
    sources: tuple[str, ...]
    source_track_ids: tuple[tuple[int, ...], ...]
    name: str
    paint: str


def map_of(
    features: Iterable[Feature],
    origin: Any,
    path: Path,
    georeference: InvertibleGeoreference | None,
    notes: ReadingNotes,
) -> GlobalMap:
    """Return the map of a file's features, with the notes of the reader.

    Args:
        features: in the order of the file.
        origin: the provenance that the file holds.
        path: of the file, for messages.
        georeference: leads to the metric frame; without one the map is in metres about the middle of its bounds.
        notes: of what was changed so far.

    Raises:
        ValueError: a feature cannot be an element, or none says what it is; the message names file and feature.
    """
    provenance = _provenance(origin, path, notes)
    found: list[_Element] = []
    place = -1
    for place, feature in enumerate(features):
        if _is_difference(feature):
            raise ValueError(f"{path}: it holds the differences of two maps, and is no map; 'predmapnet view' shows it")
        try:
            found.extend(_elements(place, feature, notes))
        except (ValueError, TypeError, KeyError) as error:
            raise ValueError(f"{path}: feature {place} is not an element of a map: {error}") from error
    if place >= 0 and not found and notes.sentences():
        kinds = ", ".join(kind.label for kind in ElementKind)
        raise ValueError(
            f"{path}: no feature is an element of a map, whose property 'kind' is one of {kinds}: "
            f"{'; '.join(notes.sentences())}"
        )
    if georeference is None:
        positions = np.concatenate([element.degrees for element in found]) if found else np.zeros((1, 2))
        georeference = LocalPlane(*((positions.min(axis=0) + positions.max(axis=0)) / 2).tolist())
    elements = tuple(_completed(found, georeference, notes))
    return GlobalMap(elements, provenance, notes.sentences())


def _is_difference(feature: Feature) -> bool:
    properties = feature.content.get("properties") if isinstance(feature.content, Mapping) else None
    return isinstance(properties, Mapping) and all(name in properties for name in DIFFERENCE)


def _elements(place: int, feature: Feature, notes: ReadingNotes) -> list[_Element]:
    """Return the elements of a feature: one, or one for each part of its geometry, or none."""
    if not isinstance(feature.content, Mapping):
        raise ValueError(f"an object is expected, not {str(feature.content)[:40]!r}")
    properties, geometry = feature.content.get("properties"), feature.content.get("geometry")
    if properties is None:
        properties = {}
    if not isinstance(properties, Mapping):
        raise ValueError(f"its properties are not an object but {str(properties)[:40]!r}")
    kind = _kind(properties, geometry, place, notes)
    if kind is None:
        return []
    return [
        _Element(
            place,
            kind,
            feature.to_degrees.positions(path.positions),
            _heights(path, properties, place, notes),
            _deviation(path, properties, place, notes),
            _told(number_of, properties, "confidence"),
            _told(number_of, properties, "observations"),
            _told(time_of, properties, "first_seen"),
            _told(time_of, properties, "last_seen"),
            _told(whole_numbers_of, properties, "track_ids"),
            *_sources(properties, place, notes),
            _name(feature.content, kind, path),
            _paint(properties.get("paint"), place, notes),
        )
        for path in paths_of(geometry, kind.is_ring, place, notes)
    ]


def _kind(properties: Mapping[str, Any], geometry: Any, place: int, notes: ReadingNotes) -> ElementKind | None:
    """Return the kind of a feature; an area that says none is a crossing, since nothing else is an area."""
    value = properties.get("kind")
    if value is None or value == "":
        if isinstance(geometry, Mapping) and str(geometry.get("type")).endswith("Polygon"):
            notes.add("an area without a kind: taken as a crossing", place)
            return ElementKind.PED_CROSSING
        notes.add("without a kind: left out", place)
        return None
    found = ElementKind.__members__.get(str(value).strip().upper())
    if found is None:
        notes.add(f"of the kind '{str(value)[:40]}', which this map does not have: left out", place)
    return found


def _told(read: Any, properties: Mapping[str, Any], name: str) -> Any:
    try:
        return read(properties.get(name))
    except ValueError as error:
        raise ValueError(f"{name}: {error}") from error


def _heights(path: DrawnPath, properties: Mapping[str, Any], place: int, notes: ReadingNotes) -> Float | None:
    """Return the height of each vertex, from the geometry or the column that stands in for it; interpolated in gaps."""
    heights = path.heights
    if heights is None:
        heights = None if path.rows is None else _numbers(properties, HEIGHTS, path, place, notes)
    if heights is None:
        return None
    if np.isnan(heights).any():
        notes.add("vertices without a height: interpolated along the line", place)
    return filled(heights, path.positions)


def _deviation(path: DrawnPath, properties: Mapping[str, Any], place: int, notes: ReadingNotes) -> Float | None:
    """Return the deviation of each vertex, none of them negative."""
    stored = _numbers(properties, "deviation_m", path, place, notes)
    if stored is None or (stored >= 0.0).all():
        return stored
    notes.add("deviation_m is not one number a vertex: left out", place)
    return None


def _numbers(
    properties: Mapping[str, Any], name: str, path: DrawnPath, place: int, notes: ReadingNotes
) -> Float | None:
    """Return the numbers of a column, one a vertex; interpolated where vertices were added or removed."""
    try:
        numbers = [number_of(entry) for entry in list_of(properties.get(name)) or ()]
    except ValueError:
        numbers = [None]
    if not numbers:
        return None
    if not any(number is None for number in numbers):
        stored = np.array(numbers, dtype=np.float64)
        if path.rows is None:
            return np.full(len(path.positions), stored.max())
        if len(stored) == path.stored:
            return np.asarray(stored[path.rows])
        if path.stored > 1 and len(stored) > 1:
            notes.add(f"vertices were added or removed: {name} is interpolated along the line", place)
            along = np.linspace(0.0, len(stored) - 1.0, path.stored)
            return np.asarray(np.interp(along, np.arange(len(stored)), stored)[path.rows])
    notes.add(f"{name} is not one number a vertex: left out", place)
    return None


def _name(content: Mapping[str, Any], kind: ElementKind, path: DrawnPath) -> str:
    """Return the id of a feature, or one made of its first position."""
    given = content.get("id")
    given = content["properties"].get("id") if given is None and content.get("properties") else given
    return str(given) if given not in (None, "") else digest_name(kind.label, path.positions[0].round(6).tolist())


def _paint(value: Any, place: int, notes: ReadingNotes) -> str:
    paint = "" if value is None else str(value).strip().lower()
    if paint in ("", "unknown", *PAINTS):
        return paint.removeprefix("unknown")
    notes.add(f"a paint that is none of {', '.join(PAINTS)}: left out", place)
    return ""


def _sources(
    properties: Mapping[str, Any], place: int, notes: ReadingNotes
) -> tuple[tuple[str, ...], tuple[tuple[int, ...], ...]]:
    sources = tuple(map(str, _told(list_of, properties, "sources") or ()))
    tracks = tuple(map(whole_numbers_of, _told(list_of, properties, "source_track_ids") or ()))
    if len(set(sources)) != len(sources) or (tracks and len(tracks) != len(sources)):
        notes.add("sources and source_track_ids do not fit each other: the ids are left out", place)
        sources, tracks = tuple(sorted(set(sources))), ()
    return sources, tracks


def _completed(found: list[_Element], georeference: InvertibleGeoreference, notes: ReadingNotes) -> list[MapElement]:
    """Return the elements, in metres; what a drawn one lacks is supplied."""
    latest = max((element.last_seen for element in found if element.last_seen is not None), default=0)
    elements = []
    for element in found:
        values = (element.confidence, element.observations, element.first_seen, element.last_seen)
        if any(value is None for value in values):
            notes.add(
                f"without confidence, observations or times, as if drawn by hand: taken as certain ({SURE:g}), seen "
                "once, at the end of the drive",
                element.place,
            )
        confidence = SURE if element.confidence is None else element.confidence
        if not 0.0 <= confidence <= 1.0:
            notes.add("a confidence outside of 0 to 1: limited", element.place)
        times = [time for time in (element.first_seen, element.last_seen) if time is not None] or [latest]
        elements.append(
            MapElement(
                kind=element.kind,
                points=georeference.from_wgs84(element.degrees),
                confidence=min(max(confidence, 0.0), 1.0),
                observations=max(int(1 if element.observations is None else element.observations), 0),
                first_seen=min(times),
                last_seen=max(times),
                track_ids=element.track_ids,
                deviation=element.deviation,
                sources=element.sources,
                source_track_ids=element.source_track_ids,
                heights=element.heights,
                name=element.name,
                paint=element.paint,
            )
        )
    return elements


def _provenance(origin: Any, path: Path, notes: ReadingNotes) -> dict[str, Any]:
    """Return the provenance with the observed ground checked; raises ValueError for ground that is no rings."""
    if not isinstance(origin, Mapping) or not origin:
        if origin != {}:
            notes.add("its provenance is lost, and with it what ground was seen: that near its elements is taken")
        return {}
    provenance = dict(origin)
    observed = provenance.get("observed")
    if observed is None:
        provenance.pop("observed", None)
        return provenance
    try:
        rings = [np.array([position[:2] for position in ring], dtype=np.float64) for ring in observed]
        fits = all(ring.ndim == 2 and len(ring) >= 4 and (np.abs(ring) <= [180.0, 90.0]).all() for ring in rings)
    except (TypeError, ValueError, IndexError, KeyError):
        fits = False
    if not fits:
        raise ValueError(
            f"{path}: 'observed' of its provenance must be rings of at least four positions (longitude, latitude), "
            f"not {str(observed)[:60]}"
        )
    provenance["observed"] = [ring.tolist() for ring in rings]
    return provenance
