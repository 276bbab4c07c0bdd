"""Merge the pieces of one pedestrian crossing on nuScenes maps, as the official code does."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import shapely
from shapely import Polygon

from mapfusion.arrays import Bool, Float, Rows
from predmapnet.datasets.ground_truth.patch import parts_of_type

PARALLEL = 0.01
"""Two long sides are parallel if one minus their cosine is below this (8.1 degrees)."""
ALIGNED = 0.001
"""The same for a piece and the union it would join (2.6 degrees)."""
FILLED = 0.8
"""A union must fill this part of its convex hull."""
MINIMUM_AREA = 1.0
"""Crossings below this area, square metres, are crumbs."""
MINIMUM_COVERED_AREA = 20.0
"""Below this area, square metres, a crossing that another one covers is dropped."""


def merge_crossings(polygons: Sequence[Polygon]) -> list[Polygon]:
    """Merge valid pieces that belong together and drop crumbs, of less than one square metre.

    Both passes compare a piece with the original base, not with what the base has grown to, and neither is
    repeated; two pieces with a gap between them stay two.
    """
    if not polygons:
        return []
    merged = _merge_small_pieces(_merge_parallel(list(polygons)))
    parts, _ = parts_of_type(merged, "Polygon")
    return _drop_crumbs([part for part in parts if part.is_valid])


def _merge_parallel(polygons: list[Polygon]) -> list[Polygon]:
    """First pass: join pieces with parallel long sides whose union is compact, from the largest piece down."""
    polygons = [polygons[row] for row in np.argsort(-shapely.area(polygons), kind="stable")]
    if len(polygons) == 1:
        return polygons
    sides = _rectangle_sides(polygons)
    long_side = np.where(_norm(sides[:, 0]) > _norm(sides[:, 1]), 0, 1)
    directions = sides[np.arange(len(sides)), long_side]

    def joins(base: int, other: int) -> bool:
        parallel = 1 - _cosine(directions[base], directions[other]) < PARALLEL
        return parallel and _is_compact(polygons[base].union(polygons[other]))

    return _merge(polygons, np.arange(len(polygons)), joins)


def _merge_small_pieces(polygons: list[Polygon]) -> list[Polygon]:
    """Second pass: join a smaller piece to a base whose rectangle keeps its direction, in the order of the list."""
    if len(polygons) == 1:
        return polygons
    areas, sides = shapely.area(polygons), _rectangle_sides(polygons)

    def joins(base: int, other: int) -> bool:
        if areas[other] >= areas[base]:
            return False
        union = polygons[base].union(polygons[other])
        union_sides = _rectangle_sides([union])[0]
        cosines = np.array([_cosine(first, second) for first in sides[base] for second in union_sides])
        return np.count_nonzero(1 - cosines < ALIGNED) == 2 and _is_compact(union)

    return _merge(polygons, np.argsort(-areas, kind="stable"), joins)


def _merge(polygons: list[Polygon], order: Rows, joins: Callable[[int, int], bool]) -> list[Polygon]:
    """Give each piece, in the order of the list, those that touch it and join it; each is given away once."""
    touching = _boxes_touch(polygons)
    absorbed = np.zeros(len(polygons), dtype=bool)
    result = []
    for base, polygon in enumerate(polygons):
        if absorbed[base]:
            continue
        absorbed[base] = True
        whole = polygon
        for other in order[touching[base][order]]:
            if not absorbed[other] and joins(base, other):
                whole = whole.union(polygons[other])
                absorbed[other] = True
        result.append(whole)
    return result


def _drop_crumbs(polygons: list[Polygon]) -> list[Polygon]:
    areas = shapely.area(polygons)
    return [
        polygon
        for row, polygon in enumerate(polygons)
        if areas[row] >= MINIMUM_COVERED_AREA
        or (
            areas[row] >= MINIMUM_AREA
            and not any(other.covers(polygon) for index, other in enumerate(polygons) if index != row)
        )
    ]


def _rectangle_sides(polygons: Sequence[Polygon]) -> Float:
    """``(n, 2, 2)``: the two side vectors of each polygon's rectangle of least area.

    Every edge of the convex hull is tried, the first of equals wins. The routine of GEOS finds the same area but may
    take another of two equal rectangles, which can turn a merge around.
    """
    return np.stack([_least_rectangle(shapely.get_coordinates(hull)) for hull in shapely.convex_hull(polygons)])


def _least_rectangle(hull: Float) -> Float:
    edges = np.diff(hull, axis=0)
    along = edges / np.linalg.norm(edges, axis=1, keepdims=True)
    across = np.stack([-along[:, 1], along[:, 0]], axis=1)
    length = np.ptp(along @ hull.T, axis=1)
    width = np.ptp(across @ hull.T, axis=1)
    best = int(np.argmin(length * width))
    return np.stack([along[best] * length[best], across[best] * width[best]])


def _boxes_touch(polygons: Sequence[Polygon]) -> Bool:
    """``(n, n) bool``: whose bounding boxes meet."""
    low_x, low_y, high_x, high_y = shapely.bounds(polygons).T
    meet_x = (low_x[:, None] <= high_x[None]) & (low_x[None] <= high_x[:, None])
    return np.asarray(meet_x & (low_y[:, None] <= high_y[None]) & (low_y[None] <= high_y[:, None]))


def _norm(vectors: Float) -> Float:
    return np.asarray(np.linalg.norm(vectors, axis=-1))


def _cosine(first: Float, second: Float) -> float:
    return float(abs(first @ second) / (_norm(first) * _norm(second)))


def _is_compact(area: Polygon) -> bool:
    return bool(area.area / area.convex_hull.area > FILLED)
