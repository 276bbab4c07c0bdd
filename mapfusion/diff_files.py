"""Files of differences between two maps: GeoJSON that is no map, though its features look like elements."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from mapfusion.arrays import Float
from mapfusion.diff import Change, Difference, MapDiff
from mapfusion.elements import ElementKind
from mapfusion.formats.features import DIFFERENCE
from mapfusion.formats.geojson import geometry_of, origin_of
from mapfusion.formats.local_plane import LocalPlane
from mapfusion.formats.seal import write_sealed
from mapfusion.georeference import Georeference


def write_diff(
    difference: MapDiff, path: Path, georeference: Georeference, provenance: dict[str, Any] | None = None
) -> None:
    """Write a diff as GeoJSON: LineStrings (crossings Polygons) with ``change``, ``kind``, ``length_m``, ``moved_m``.

    Raises ValueError for coordinates that are not on the globe, OSError if the file cannot be written.
    """
    features = [_feature(item, georeference) for item in difference.differences]
    origin = origin_of(provenance or {}, georeference)
    document = {"type": "FeatureCollection", "predmapnet": origin, "features": features}
    with write_sealed(path) as temporary:
        temporary.write_text(json.dumps(document, separators=(",", ":"), allow_nan=False) + "\n", encoding="utf-8")


def read_diff(path: Path) -> tuple[MapDiff, LocalPlane, dict[str, Any]]:
    """Read a file of :func:`write_diff`: the differences in a metric plane, that plane, and the provenance.

    Raises:
        ValueError: it is no such file; says where it breaks.
        OSError: the file cannot be read.
    """
    try:
        document = json.loads(path.read_text(encoding="utf-8-sig"))
        features = document["features"]
        degrees = [_positions(feature["geometry"]) for feature in features]
        middle = np.concatenate(degrees) if degrees else np.zeros((1, 2))
        plane = LocalPlane(*((middle.min(axis=0) + middle.max(axis=0)) / 2).tolist())
        found = (
            _difference(feature["properties"], plane.from_wgs84(at))
            for feature, at in zip(features, degrees, strict=True)
        )
        return MapDiff(tuple(found), None), plane, dict(document.get("predmapnet") or {})
    except (ValueError, TypeError, KeyError, IndexError, AttributeError) as error:
        raise ValueError(f"{path}: these are no differences that 'predmapnet diff' wrote: {error}") from error


def holds_differences(path: Path) -> bool:
    """Whether a file holds the differences of two maps, which it says of each. Raises OSError."""
    if path.suffix.lower() not in (".geojson", ".json"):
        return False
    content = path.read_bytes()
    return all(f'"{name}"'.encode() in content for name in DIFFERENCE) or b'"predmapnet diff"' in content


def _feature(item: Difference, georeference: Georeference) -> dict[str, Any]:
    properties = {
        "change": item.change.value,
        "kind": item.kind.label,
        "length_m": round(item.length, 3),
        "moved_m": None if np.isnan(item.moved_by) else round(item.moved_by, 3),
        "confidence": round(item.confidence, 4),
    }
    geometry, _ = geometry_of(item.kind, item.points, georeference)
    return {"type": "Feature", "geometry": geometry, "properties": properties}


def _positions(geometry: dict[str, Any]) -> Float:
    """Return longitude and latitude ``(n, 2)`` of a line or of the ring of a polygon."""
    coordinates = geometry["coordinates"][0] if geometry["type"] == "Polygon" else geometry["coordinates"]
    positions = np.array(coordinates, dtype=np.float64)
    if positions.ndim != 2 or len(positions) < 2 or not np.isfinite(positions).all():
        raise ValueError("a geometry is neither a line nor a ring")
    return positions[:, :2]


def _difference(properties: dict[str, Any], points: Float) -> Difference:
    moved = properties["moved_m"]
    kind = {kind.label: kind for kind in ElementKind}[properties["kind"]]
    return Difference(
        Change(properties["change"]),
        kind,
        points,
        float(properties["length_m"]),
        float("nan") if moved is None else float(moved),
        float(properties["confidence"]),
    )
