"""Geometries of map files as editors leave them, taken apart into the lines and rings of one kind."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import shapely

from mapfusion.arrays import Float
from mapfusion.formats.reading_notes import ReadingNotes

SMALLEST_PART = 1e-3
"""Parts of a crossing that crosses itself are kept from this share of the whole area on."""


@dataclass(frozen=True)
class DrawnPath:
    """Line or ring of a feature.

    Attributes:
        positions: ``(n, 2) float64``, in the reference system of the file; a ring ends where it begins.
        rows: ``(n,)`` position of each vertex in the file, None where the vertices are new.
        stored: number of positions in the file.
        heights: ``(n,)``, metres, NaN where the file has none; None where it has none at all.
    """

    positions: Float
    rows: Any
    stored: int
    heights: Float | None = None


def paths_of(geometry: Any, is_ring: bool, feature: int, notes: ReadingNotes) -> list[DrawnPath]:
    """Return the lines (or rings) of a GeoJSON geometry.

    Parts of multi-part geometries come one by one, open rings are closed, rings that cross themselves are split (and
    lose their heights), and what has no length or no area is left out; ``notes`` says so. A height of exactly 0 is
    none: programs write it where they know none.

    Args:
        geometry: as in GeoJSON; None for a feature without one.
        is_ring: whether the kind is a ring.
        feature: position in the file.
        notes: receives what was changed.

    Raises:
        ValueError: positions that are not numbers.
    """
    found: list[DrawnPath] = []
    if geometry is None:
        notes.add("without a geometry: left out", feature)
        return found
    parts = list(_parts(geometry, feature, notes))
    if len(parts) > 1:
        notes.add("a geometry of several parts: each part is an element", feature)
    for name, coordinates in parts:
        rings = coordinates if name == "Polygon" else [coordinates]
        if not isinstance(rings, (list, tuple)) or not rings:
            notes.add("an empty geometry: left out", feature)
            continue
        if len(rings) > 1:
            notes.add("an area with holes: the holes are left out", feature)
        positions, heights = _positions(rings[0])
        if is_ring:
            found.extend(_rings(positions, heights, feature, notes))
            continue
        if name == "Polygon":
            notes.add("a line that is drawn as an area: its outline is taken", feature)
        if len(positions) < 2 or not np.ptp(positions, axis=0).any():
            notes.add("a line without length: left out", feature)
        else:
            found.append(DrawnPath(positions, np.arange(len(positions)), len(positions), heights))
    return found


def _parts(geometry: Any, feature: int, notes: ReadingNotes) -> Iterator[tuple[str, Any]]:
    """Yield the LineStrings and Polygons of a geometry with their coordinates."""
    if not isinstance(geometry, Mapping):
        raise ValueError(f"its geometry is not an object but {str(geometry)[:40]!r}")
    name = geometry.get("type")
    coordinates: Any = geometry.get("geometries" if name == "GeometryCollection" else "coordinates")
    if str(name).startswith(("Geometry", "Multi")) and not coordinates:
        notes.add("an empty geometry: left out", feature)
    elif name == "GeometryCollection":
        for part in coordinates:
            yield from _parts(part, feature, notes)
    elif name in ("LineString", "Polygon"):
        yield name, coordinates
    elif name in ("MultiLineString", "MultiPolygon"):
        for part in coordinates:
            yield name.removeprefix("Multi"), part
    elif name in ("Point", "MultiPoint"):
        notes.add("a point, which is no element of a map: left out", feature)
    else:
        raise ValueError(f"a geometry must be a LineString or a Polygon, not {str(name)[:40]!r}")


def _positions(coordinates: Any) -> tuple[Float, Float | None]:
    """Return ``(n, 2)`` positions, and their heights if there are any."""
    if not isinstance(coordinates, (list, tuple)):
        raise ValueError(f"its coordinates are not a list but {str(coordinates)[:40]!r}")
    if not coordinates:
        return np.zeros((0, 2)), None
    try:
        flat = all(len(position) == 2 for position in coordinates)
        positions = np.array(coordinates if flat else [position[:2] for position in coordinates], dtype=np.float64)
        third = [] if flat else [position[2] if len(position) > 2 else np.nan for position in coordinates]
        heights = np.array(third, dtype=np.float64)
    except (TypeError, ValueError, KeyError) as error:
        raise ValueError(f"its coordinates are not positions: {str(coordinates)[:60]}") from error
    if positions.ndim != 2 or positions.shape[1] != 2 or not np.isfinite(positions).all():
        raise ValueError(f"its coordinates are not positions of two numbers: {str(coordinates)[:60]}")
    heights = np.where(np.isfinite(heights) & (heights != 0.0), heights, np.nan)
    return positions, None if np.isnan(heights).all() else heights


def _rings(positions: Float, heights: Float | None, feature: int, notes: ReadingNotes) -> list[DrawnPath]:
    """Return the rings that a drawn ring stands for: one, unless it crosses itself."""
    stored, rows = len(positions), np.arange(len(positions))
    if stored and not np.array_equal(positions[0], positions[-1]):
        rows = np.append(rows, 0)
        positions = positions[rows]
        if len(positions) >= 4:
            notes.add("a ring that was not closed: closed", feature)
    if len(positions) < 4:
        notes.add("a crossing without area: left out", feature)
        return []
    polygon = shapely.Polygon(positions)
    if polygon.is_valid and polygon.area > 0.0:
        return [DrawnPath(positions, rows, stored, None if heights is None else heights[rows])]
    parts = [part for part in _polygons(shapely.make_valid(polygon)) if part.area > 0.0]
    parts = [part for part in parts if part.area >= SMALLEST_PART * sum(whole.area for whole in parts)]
    if not parts:
        notes.add("a crossing without area: left out", feature)
        return []
    lost = "" if heights is None else ", without heights"
    notes.add(f"a ring that crosses itself: its parts are taken{lost}", feature)
    return [DrawnPath(shapely.get_coordinates(part.exterior), None, stored) for part in parts]


def _polygons(geometry: Any) -> Sequence[Any]:
    parts = shapely.get_parts(shapely.get_parts(shapely.get_parts(geometry)))
    return [part for part in parts if part.geom_type == "Polygon"]
