"""GeoJSON files (RFC 7946): one feature per element, WGS84, with the provenance in the member ``predmapnet``."""

from __future__ import annotations

import json
import re
import shutil
import tempfile
from collections.abc import Iterable, Mapping, Sequence
from contextlib import ExitStack
from datetime import UTC, datetime, timedelta
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np

from mapfusion.arrays import Float
from mapfusion.elements import ElementKind, GlobalMap, MapElement
from mapfusion.files import write_whole
from mapfusion.formats.local_plane import LocalPlane
from mapfusion.georeference import Georeference, InvertibleGeoreference

DECIMALS = 10
"""Digits of longitude and latitude: 1e-10 degrees are 0.01 mm."""

EPOCH = datetime(1970, 1, 1, tzinfo=UTC)


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
        self._low = np.full(2, np.inf)
        self._high = np.full(2, -np.inf)

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
        feature = feature_of(element, self._georeference)
        points = _positions(feature)
        self._low, self._high = np.minimum(self._low, points.min(axis=0)), np.maximum(self._high, points.max(axis=0))
        self._body.write((",\n" if self._count else "\n") + json.dumps(feature, separators=(",", ":"), allow_nan=False))
        self._count += 1

    def _finish(self) -> None:
        document: dict[str, Any] = {"type": "FeatureCollection"}
        if self._count:
            document["bbox"] = [*self._low.tolist(), *self._high.tolist()]
        document["predmapnet"] = origin_of(self._provenance, self._georeference)
        head = json.dumps(document, separators=(",", ":"), allow_nan=False)[:-1]
        self._body.seek(0)
        with write_whole(self._path) as temporary, temporary.open("w", encoding="utf-8") as file:
            file.write(f'{head},"features":[')
            shutil.copyfileobj(self._body, file)
            file.write("\n]}\n" if self._count else "]}\n")


def origin_of(provenance: Mapping[str, Any], georeference: Georeference) -> dict[str, Any]:
    """Return the provenance that every format writes, completed by georeference and time."""
    created = datetime.now(UTC).isoformat(timespec="seconds").replace("+00:00", "Z")
    return {**provenance, "georeference": georeference.name, "created": created}


def read_geojson(path: Path, georeference: InvertibleGeoreference | None = None) -> GlobalMap:
    """Read a map that :func:`write_geojson` wrote.

    Args:
        path: the file.
        georeference: leads back to the metric global frame; without one, the map is in metres east and north of
            the middle of the file's bounding box.

    Returns:
        The map; ``provenance`` is the file's ``predmapnet`` member.

    Raises:
        ValueError: not a file of ours; says where it breaks.
        OSError: the file cannot be read.
    """
    try:
        document = json.loads(path.read_text(encoding="utf-8"))
    except ValueError as error:
        raise ValueError(f"{path}: not JSON: {error}") from error
    if not isinstance(document, dict) or document.get("type") != "FeatureCollection":
        raise ValueError(f"{path}: not a GeoJSON FeatureCollection")
    elements = elements_of(document.get("features", []), georeference, document.get("bbox"), path)
    return GlobalMap(elements, document.get("predmapnet", {}))


def elements_of(
    features: Iterable[Mapping[str, Any]],
    georeference: InvertibleGeoreference | None,
    box: Sequence[float] | None,
    path: Path,
) -> tuple[MapElement, ...]:
    """Return the elements of features; without a georeference in metres about the middle of ``box`` (degrees).

    Raises:
        ValueError: a feature is not an element; says which, and in which file.
    """
    if georeference is None:
        west, south, east, north = box or (0.0, 0.0, 0.0, 0.0)
        georeference = LocalPlane((west + east) / 2, (south + north) / 2)
    elements = []
    for position, feature in enumerate(features):
        try:
            elements.append(element_of(feature, georeference))
        except (KeyError, TypeError, ValueError, IndexError) as error:
            raise ValueError(f"{path}: feature {position} is not an element of a map: {error!r}") from error
    return tuple(elements)


def format_timestamp(nanoseconds: int) -> str:
    """Return ISO 8601 UTC with nine digits: ``format_timestamp(1)`` is ``1970-01-01T00:00:00.000000001Z``."""
    seconds, rest = divmod(int(nanoseconds), 1_000_000_000)
    return (EPOCH + timedelta(seconds=seconds)).strftime("%Y-%m-%dT%H:%M:%S") + f".{rest:09d}Z"


def parse_timestamp(text: str) -> int:
    """Return the nanoseconds of a text that :func:`format_timestamp` made; raises ValueError for others."""
    match = re.fullmatch(r"(\d{4}-\d\d-\d\dT\d\d:\d\d:\d\d)\.(\d{9})Z", text)
    if match is None:
        raise ValueError(f"not a timestamp of the form 2024-01-31T12:00:00.123456789Z: {text!r}")
    moment = datetime.strptime(match[1] + "+0000", "%Y-%m-%dT%H:%M:%S%z") - EPOCH
    return (moment.days * 86_400 + moment.seconds) * 1_000_000_000 + int(match[2])


def geometry_of(kind: ElementKind, points: Float, georeference: Georeference) -> tuple[dict[str, Any], bool]:
    """Return the GeoJSON geometry of a line or ring, metres, and whether the ring was turned; ValueError off the globe.

    Rings turn counter-clockwise.
    """
    degrees = np.round(georeference.to_wgs84(points), DECIMALS)
    if not (np.isfinite(degrees).all() and (np.abs(degrees) <= [180.0, 90.0]).all()):
        raise ValueError(f"a {kind.label} lies outside the globe: the georeference does not fit the map")
    if not kind.is_ring:
        return {"type": "LineString", "coordinates": degrees.tolist()}, False
    degrees[-1] = degrees[0]
    x, y = (degrees - degrees[0]).T
    turned = float((x[:-1] * y[1:] - x[1:] * y[:-1]).sum()) < 0.0
    return {"type": "Polygon", "coordinates": [degrees[:: -1 if turned else 1].tolist()]}, turned


def feature_of(element: MapElement, georeference: Georeference) -> dict[str, Any]:
    """Return an element as a GeoJSON feature, which every format writes; raises ValueError off the globe."""
    geometry, turned = geometry_of(element.kind, element.points, georeference)
    properties: dict[str, Any] = {
        "kind": element.kind.label,
        "confidence": round(element.confidence, 4),
        "observations": element.observations,
        "first_seen": format_timestamp(element.first_seen),
        "last_seen": format_timestamp(element.last_seen),
        "track_ids": list(element.track_ids),
        "length_m": round(element.length, 3),
    }
    if element.deviation is not None:
        properties["deviation_m"] = np.round(element.deviation[:: -1 if turned else 1], 3).tolist()
    if element.sources:
        properties["sources"] = list(element.sources)
        if element.source_track_ids:
            properties["source_track_ids"] = [list(tracks) for tracks in element.source_track_ids]
    return {"type": "Feature", "geometry": geometry, "properties": properties}


def element_of(feature: Mapping[str, Any], georeference: InvertibleGeoreference) -> MapElement:
    """Return the element that :func:`feature_of` made a feature of; raises KeyError, TypeError or ValueError."""
    properties, geometry = feature["properties"], feature["geometry"]
    kind = ElementKind[properties["kind"].upper()]
    expected = "Polygon" if kind.is_ring else "LineString"
    if geometry["type"] != expected:
        raise ValueError(f"a {kind.label} must be a {expected}, not a {geometry['type']}")
    degrees = np.array(geometry["coordinates"][0] if kind.is_ring else geometry["coordinates"], dtype=np.float64)
    deviation = properties.get("deviation_m")
    return MapElement(
        kind=kind,
        points=georeference.from_wgs84(degrees),
        confidence=float(properties["confidence"]),
        observations=int(properties["observations"]),
        first_seen=parse_timestamp(properties["first_seen"]),
        last_seen=parse_timestamp(properties["last_seen"]),
        track_ids=tuple(int(track) for track in properties["track_ids"]),
        deviation=None if deviation is None else np.array(deviation, dtype=np.float64),
        sources=tuple(map(str, properties.get("sources", ()))),
        source_track_ids=tuple(tuple(map(int, tracks)) for tracks in properties.get("source_track_ids", ())),
    )


def _positions(feature: Mapping[str, Any]) -> Float:
    geometry = feature["geometry"]
    return np.array(geometry["coordinates"][0] if geometry["type"] == "Polygon" else geometry["coordinates"])
