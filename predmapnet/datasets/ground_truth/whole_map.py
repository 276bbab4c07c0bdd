"""The true map of a whole log, as a perfect mapper would have made it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Protocol

import numpy as np
import shapely
from scipy.spatial import cKDTree
from shapely import LineString, Polygon

from mapfusion.arrays import Float
from mapfusion.elements import ElementKind, GlobalMap, MapElement, RegionOfInterest

SAME_LINE = 0.1
"""A divider within this distance of a longer one, metres, is the same line digitised twice."""
TOUCHING = 0.1
"""Ends of dividers this close together, metres, are one joint."""
STRAIGHT_ON = np.cos(np.radians(20.0))


class MapTruth(Protocol):
    """Ground truth that can be asked for whole elements in an area."""

    def region(self, pose: Float, roi: RegionOfInterest) -> Polygon:
        """Return the rectangle that a frame covers, in the global frame."""

    def elements_within(self, area: Any) -> list[tuple[ElementKind, Float]]:
        """Return all elements cut by an area, global frame."""


def truth_map(truth: MapTruth, frames: Sequence[tuple[int, Float]], roi: RegionOfInterest) -> GlobalMap:
    """Return every element that came within reach of any frame, cut by the union of the frames' rectangles.

    Frames are their times (nanoseconds) and poses (as the map's ``frame`` takes them).

    Returns:
        Crossings as merged rings, dividers joined where they run on, boundaries of the whole drivable surface;
        confidence 1, ``observations`` the number of frames whose rectangle each element meets.
    """
    regions = np.array([truth.region(pose, roi) for _, pose in frames], dtype=object)
    timestamps = np.array([timestamp for timestamp, _ in frames], dtype=np.int64)
    pieces = truth.elements_within(shapely.union_all(regions))
    dividers = join_lines(drop_repeated_lines([points for kind, points in pieces if kind is ElementKind.DIVIDER]))
    pieces = [(kind, points) for kind, points in pieces if kind is not ElementKind.DIVIDER]
    pieces += [(ElementKind.DIVIDER, points) for points in dividers]
    pieces.sort(key=lambda piece: piece[0])
    elements = []
    for kind, points in pieces:
        seen = timestamps[shapely.intersects(regions, LineString(points))]
        if len(seen) == 0:
            continue
        elements.append(
            MapElement(
                kind=kind,
                points=points,
                confidence=1.0,
                observations=len(seen),
                first_seen=int(seen.min()),
                last_seen=int(seen.max()),
            )
        )
    return GlobalMap(tuple(elements), {"ground_truth": True})


def drop_repeated_lines(lines: Sequence[Float]) -> list[Float]:
    """Drop lines that run along a longer one over their whole length; the order of the rest is kept."""
    if not lines:
        return []
    geometries = np.array([LineString(line) for line in lines], dtype=object)
    covers = shapely.buffer(geometries, SAME_LINE)
    tree = shapely.STRtree(geometries)
    inner, outer = tree.query(geometries, predicate="dwithin", distance=SAME_LINE)
    lengths = shapely.length(geometries)
    # Of two equal lines the first stays.
    longer = (lengths[outer] > lengths[inner]) | ((lengths[outer] == lengths[inner]) & (outer < inner))
    inner, outer = inner[longer], outer[longer]
    repeated = inner[shapely.covers(covers[outer], geometries[inner])]
    return [line for row, line in enumerate(lines) if row not in set(repeated.tolist())]


def join_lines(lines: Sequence[Float]) -> list[Float]:
    """Join open lines end to end where exactly two meet and run straight on."""
    lines = [line for line in lines if len(line) >= 2]
    if len(lines) < 2:
        return list(lines)
    ends = np.array([end for line in lines for end in (line[0], line[-1])])
    outward = np.array([_unit(vector) for line in lines for vector in (line[0] - line[1], line[-1] - line[-2])])
    partner = np.full(len(ends), -1)
    for end, near in enumerate(cKDTree(ends).query_ball_point(ends, TOUCHING)):
        others = [other for other in near if other // 2 != end // 2]
        if len(near) == 2 and len(others) == 1 and -outward[end] @ outward[others[0]] > STRAIGHT_ON:
            partner[end] = others[0]
    starts = [end for end in range(len(ends)) if partner[end] < 0]
    used = np.zeros(len(lines), dtype=bool)
    result = []
    # Chains are walked from their loose ends first; what is left then are loops.
    for start in [*starts, *range(len(ends))]:
        chain = []
        end = start
        while end >= 0 and not used[end // 2]:
            used[end // 2] = True
            line = lines[end // 2]
            chain.append(line if end % 2 == 0 else line[::-1])
            end = int(partner[end ^ 1])
        if chain:
            result.append(np.concatenate([chain[0], *(line[1:] for line in chain[1:])]))
    return result


def _unit(vector: Float) -> Float:
    length = np.linalg.norm(vector)
    return vector / length if length > 0 else vector
