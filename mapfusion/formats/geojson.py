"""GeoJSON files (RFC 7946): one feature per element, WGS84, with the provenance in the member ``predmapnet``."""

from __future__ import annotations

import json
import shutil
import tempfile
from collections.abc import Mapping
from contextlib import ExitStack
from datetime import UTC, datetime
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np

from mapfusion import json_text
from mapfusion.arrays import Float
from mapfusion.elements import ElementKind, GlobalMap, MapElement
from mapfusion.formats.features import Feature, map_of
from mapfusion.formats.foreign_values import format_timestamp
from mapfusion.formats.identities import ElementNames
from mapfusion.formats.reading_notes import ReadingNotes
from mapfusion.formats.reference_systems import ToDegrees
from mapfusion.formats.seal import SEAL, UNSEALED, write_sealed
from mapfusion.georeference import Georeference, InvertibleGeoreference

DECIMALS = 10
"""Digits of longitude and latitude: 1e-10 degrees are 0.01 mm."""

HEIGHT_DECIMALS = 3
"""Digits of heights, metres."""


def write_geojson(
    global_map: GlobalMap,
    path: Path,
    georeference: Georeference,
    provenance: Mapping[str, Any] | None = None,
) -> None:
    """Write a map; the file appears complete or not at all, and is the same every time but for ``created``.

    Lines become LineStrings, crossings Polygons with counter-clockwise rings. Timestamps are ISO 8601 UTC with nine
    digits after the second, because integers of nanoseconds exceed what JSON readers keep exactly (2**53).

    Args:
        global_map: elements in the metric global frame.
        path: file to write; an existing one is replaced.
        georeference: of that global frame.
        provenance: what else the file should tell of its origin, beside ``global_map.provenance``.

    Raises:
        ValueError: coordinates that are not finite or not on the globe.
        OSError: the file cannot be written; a file that was there before is left as it was.
    """
    with GeoJsonWriter(path, georeference, {**global_map.provenance, **(provenance or {})}) as writer:
        for element in global_map:
            writer.write(element)


class GeoJsonWriter:
    """Writes elements as they come, for maps that are larger than memory, as :func:`write_geojson` does.

    Use it as a context manager. An exception inside leaves no file.

    Args:
        path: file to write; an existing one is replaced.
        georeference: of the metric frame.
        provenance: what the file should tell of its origin.
    """

    def __init__(self, path: Path, georeference: Georeference, provenance: Mapping[str, Any]) -> None:
        self._path = path
        self._georeference = georeference
        self._provenance = provenance
        self._count = 0
        self._names = ElementNames()
        self._low = np.full(3, np.inf)
        self._high = np.full(3, -np.inf)

    def __enter__(self) -> Self:
        self._stack = ExitStack()
        self._body = self._stack.enter_context(tempfile.TemporaryFile("w+", encoding="utf-8"))
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        with self._stack:
            if kind is None:
                self._finish()

    def write(self, element: MapElement) -> None:
        """Append one element; raises ValueError for one that does not lie on the globe."""
        feature = feature_of(self._names.named(element), self._georeference)
        points = _positions(feature)
        axes = points.shape[1]
        self._low[:axes] = np.minimum(self._low[:axes], points.min(axis=0))
        self._high[:axes] = np.maximum(self._high[:axes], points.max(axis=0))
        self._body.write((",\n" if self._count else "\n") + json.dumps(feature, separators=(",", ":"), allow_nan=False))
        self._count += 1

    def _finish(self) -> None:
        document: dict[str, Any] = {"type": "FeatureCollection"}
        if self._count:
            axes = np.isfinite(self._low)
            document["bbox"] = [*self._low[axes].tolist(), *self._high[axes].tolist()]
        document["predmapnet"] = origin_of(self._provenance, self._georeference)
        head = json.dumps(document, separators=(",", ":"), allow_nan=False)[:-1]
        self._body.seek(0)
        with write_sealed(self._path) as temporary, temporary.open("w", encoding="utf-8") as file:
            file.write(f'{head},"features":[')
            shutil.copyfileobj(self._body, file)
            file.write("\n]}\n" if self._count else "]}\n")


def origin_of(provenance: Mapping[str, Any], georeference: Georeference) -> dict[str, Any]:
    """Return the provenance that every format writes, completed by georeference, time and an empty seal."""
    created = datetime.now(UTC).isoformat(timespec="seconds").replace("+00:00", "Z")
    return {**provenance, "georeference": georeference.name, "created": created, SEAL: UNSEALED}


def read_geojson(path: Path, georeference: InvertibleGeoreference | None = None) -> GlobalMap:
    """Read a map that :func:`write_geojson` wrote, also after another program or a person has edited it.

    Args:
        path: the file.
        georeference: leads back to the metric global frame; without one, the map is in metres east and north of
            the middle of its bounds.

    Returns:
        The map; ``provenance`` is the file's ``predmapnet`` member, ``notes`` tell what was repaired or left out.

    Raises:
        ValueError: no map; says where it breaks.
        OSError: the file cannot be read.
    """
    try:
        document = json_text.parse(path.read_bytes())
    except ValueError as error:
        raise ValueError(f"{path}: not JSON: {error}") from error
    if not isinstance(document, dict) or document.get("type") != "FeatureCollection":
        raise ValueError(f"{path}: not a GeoJSON FeatureCollection")
    features = document.get("features")
    if not isinstance(features, list):
        raise ValueError(f"{path}: not a GeoJSON FeatureCollection: its member 'features' is not a list")
    to_degrees = ToDegrees(_reference_system(document.get("crs")), str(path))
    stored = (Feature(feature, to_degrees) for feature in features)
    return map_of(stored, document.get("predmapnet"), path, georeference, ReadingNotes())


def _reference_system(member: Any) -> str:
    """Return the name of the reference system in the member ``crs``, which GDAL and QGIS write for all but WGS84."""
    if member is None:
        return "EPSG:4326"
    properties = member.get("properties") if isinstance(member, dict) else None
    return str(properties.get("name", "")) if isinstance(properties, dict) else ""


def geometry_of(
    kind: ElementKind, points: Float, georeference: Georeference, heights: Float | None = None
) -> tuple[dict[str, Any], bool]:
    """Return the GeoJSON geometry of a line or ring, metres, and whether the ring was turned; ValueError off the globe.

    Rings turn counter-clockwise. With heights, positions have three numbers.
    """
    degrees = np.round(georeference.to_wgs84(points), DECIMALS)
    if not (np.isfinite(degrees).all() and (np.abs(degrees) <= [180.0, 90.0]).all()):
        raise ValueError(f"a {kind.label} lies outside the globe: the georeference does not fit the map")
    positions = degrees if heights is None else np.column_stack([degrees, np.round(heights, HEIGHT_DECIMALS)])
    if not kind.is_ring:
        return {"type": "LineString", "coordinates": positions.tolist()}, False
    positions[-1] = positions[0]
    x, y = (degrees - degrees[0]).T
    turned = float((x[:-1] * y[1:] - x[1:] * y[:-1]).sum()) < 0.0
    return {"type": "Polygon", "coordinates": [positions[:: -1 if turned else 1].tolist()]}, turned


def feature_of(element: MapElement, georeference: Georeference) -> dict[str, Any]:
    """Return an element as a GeoJSON feature, which every format writes; raises ValueError off the globe."""
    geometry, turned = geometry_of(element.kind, element.points, georeference, element.heights)
    length, width = element.extent
    properties: dict[str, Any] = {
        "kind": element.kind.label,
        "confidence": round(element.confidence, 4),
        "observations": element.observations,
        "first_seen": format_timestamp(element.first_seen),
        "last_seen": format_timestamp(element.last_seen),
        "track_ids": list(element.track_ids),
        "length_m": round(length, 3),
    }
    if element.kind.is_ring:
        properties["width_m"] = round(width, 3)
    if element.deviation is not None:
        properties["deviation_m"] = np.round(element.deviation[:: -1 if turned else 1], 3).tolist()
    if element.sources:
        properties["sources"] = list(element.sources)
        if element.source_track_ids:
            properties["source_track_ids"] = [list(tracks) for tracks in element.source_track_ids]
    if element.paint:
        properties["paint"] = element.paint
    named = {"id": element.name} if element.name else {}
    return {"type": "Feature", **named, "geometry": geometry, "properties": properties}


def _positions(feature: Mapping[str, Any]) -> Float:
    geometry = feature["geometry"]
    return np.array(geometry["coordinates"][0] if geometry["type"] == "Polygon" else geometry["coordinates"])
