"""Steps that nuScenes and Argoverse 2 share: affine moves, crossing contours, boundary rings.

Operations and their order follow the official data converters to the last bit where it matters: a crossing whose
edge lies on the border of the region changes shape with the rounding of its coordinates.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
import shapely
from shapely import LineString, Polygon, STRtree

from mapfusion.arrays import Float

BORDER = 0.2
"""Boundaries end this far inside the region, metres: it removes the artificial edges along the cut."""
CLOSED_TOLERANCE = 1e-3
ROUNDING = 1e-6
"""Differences below this (metres, square metres) come from rounding."""


def rotation_about(angle_degrees: float, centre: Sequence[float] | Float) -> Float:
    """Affine rotation about a point as ``(2, 3)``, with the exact zeros of right angles."""
    angle = angle_degrees * math.pi / 180.0
    cosine, sine = (0.0 if abs(value) < 2.5e-16 else value for value in (math.cos(angle), math.sin(angle)))
    x, y = centre
    return np.array([[cosine, -sine, x - x * cosine + y * sine], [sine, cosine, y - x * sine - y * cosine]])


def apply(affine: Float, points: Float) -> Float:
    """Move ``(n, 2)`` points by a ``(2, 3)`` affine map."""
    x, y = points[:, 0], points[:, 1]
    return np.stack([row[0] * x + row[1] * y + row[2] for row in affine], axis=1)


def patch_polygon(centre: Sequence[float] | Float, extent_x: float, extent_y: float, angle_degrees: float) -> Polygon:
    """Rectangle around ``centre``, turned by ``angle_degrees``, in the frame of the map."""
    x, y = centre
    box = shapely.box(x - extent_x / 2.0, y - extent_y / 2.0, x + extent_x / 2.0, y + extent_y / 2.0)
    affine = rotation_about(angle_degrees, centre)
    return shapely.transform(box, lambda points: apply(affine, points))


def parts_of_type(geometries: Iterable[Any], name: str) -> tuple[list[Any], list[int]]:
    """Explode collections and keep one type of part, with the index of the geometry that each came from."""
    array = np.asarray(list(geometries), dtype=object)
    parts, index = shapely.get_parts(array, return_index=True)
    # Collections may hold multi geometries: a second round reaches their parts.
    parts, inner = shapely.get_parts(parts, return_index=True)
    keep = (shapely.get_type_id(parts) == shapely.GeometryType[name.upper()].value) & ~shapely.is_empty(parts)
    return list(parts[keep]), [int(row) for row in index[inner][keep]]


def is_closed(line: Float, tolerance: float = CLOSED_TOLERANCE) -> bool:
    """Whether first and last vertex agree, as the official code tests it."""
    return bool(np.allclose(line[0], line[-1], atol=tolerance))


def crossing_contours(polygons: Sequence[Polygon], box: Polygon) -> list[Float | None]:
    """Outline ``(k, 2)`` of each crossing inside the closed box: the ring is cut, and closed by a straight segment.

    None for one of which nothing is inside; holes are ignored.
    """
    if not len(polygons):
        return []
    rings = shapely.get_exterior_ring(np.asarray(polygons, dtype=object))
    clockwise = ~shapely.is_ccw(rings)
    rings[clockwise] = shapely.reverse(rings[clockwise])
    return [_closed_contour(cut) for cut in shapely.intersection(rings, box)]


def restored_corners(polygons: Sequence[Polygon], contours: Sequence[Float | None], box: Polygon) -> list[Float | None]:
    """Restore contours that lost the corner of the region to rounding.

    Crossings that were cut by the region in one frame and turned into another have their cut edges on its border up
    to rounding. Edges that come out just outside are lost when the ring is cut again; two of them take the corner of
    the region with them. The official code loses corners in this way.
    """
    return [
        contour
        if contour is not None and abs(_enclosed(contour) - shapely.Polygon(polygon.exterior).area) < ROUNDING
        else crossing_contours([_snap_to_border(polygon, box)], box)[0]
        for polygon, contour in zip(polygons, contours, strict=True)
    ]


def _enclosed(ring: Float) -> float:
    """Area inside a closed ring of any number of points, square metres."""
    x, y = (ring - ring[0]).T
    return abs(float(x[:-1] @ y[1:] - x[1:] @ y[:-1])) / 2


def _snap_to_border(polygon: Polygon, box: Polygon) -> Polygon:
    low_x, low_y, high_x, high_y = box.bounds

    def snap(points: Float) -> Float:
        points = points.copy()
        for axis, limits in enumerate(((low_x, high_x), (low_y, high_y))):
            for limit in limits:
                points[np.abs(points[:, axis] - limit) < ROUNDING, axis] = limit
        return points

    return shapely.transform(polygon, snap)


def _closed_contour(cut: Any) -> Float | None:
    lines, _ = parts_of_type([cut], "LineString")
    if not lines:
        return None
    if len(lines) > 1:
        merged = shapely.line_merge(shapely.multilinestrings(lines))
        lines = list(shapely.get_parts(merged))
    points = shapely.get_coordinates(lines)
    return points if is_closed(points) else np.concatenate([points, points[:1]])


def area_rings(area: Any) -> list[LineString]:
    """Rings of a (multi) polygon, drivable side on the right hand: exteriors clockwise, then holes the other way."""
    polygons, _ = parts_of_type([area], "Polygon")
    exteriors = [polygon.exterior for polygon in polygons]
    interiors = [ring for polygon in polygons for ring in polygon.interiors]
    clockwise = [ring.reverse() if ring.is_ccw else ring for ring in exteriors]
    return clockwise + [ring if ring.is_ccw else ring.reverse() for ring in interiors]


def cut_rings(rings: Sequence[Any], region: Any) -> list[Float]:
    """Cut rings by a region and join the two parts that only the start vertex of a ring separates.

    A ring that lies inside stays closed.
    """
    cut = shapely.intersection(np.asarray(rings, dtype=object), region)
    several = shapely.get_type_id(cut) >= shapely.GeometryType.MULTIPOINT.value
    for row in np.flatnonzero(several):
        lines, _ = parts_of_type([cut[row]], "LineString")
        cut[row] = shapely.line_merge(shapely.multilinestrings(lines))
    lines, _ = parts_of_type(cut, "LineString")
    return [shapely.get_coordinates(line) for line in lines]


def midpoint(line: Float) -> Float:
    """Middle of the middle segment of a line: a point that lies on it."""
    middle = len(line) // 2
    return np.asarray((line[middle - 1] + line[middle]) / 2)


def nearest_rows(tree: STRtree, points: Sequence[Float]) -> list[int]:
    """Index of the geometry nearest to each point, the lowest of several."""
    if not points or len(tree) == 0:
        return [-1] * len(points)
    query, rows = tree.query_nearest(shapely.points(np.array(points)))
    return [int(rows[query == number].min()) for number in range(len(points))]
