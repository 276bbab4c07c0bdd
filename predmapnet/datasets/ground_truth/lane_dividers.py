"""Dividers of Argoverse 2: lane boundaries between neighbours, chained, de-duplicated and connected.

The steps, their order and their quirks are those of the official vector-map code; step numbers in the docstrings
count them from the map's records to the finished lines.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray
from shapely import LineString

from mapfusion.arrays import Float

Vertex3D = tuple[float, float, float]

SAME = 0.9
"""Two lines are the same if their buffers overlap with at least this IoU."""
BOUNDARY_BUFFER = 0.01
PATH_SIMPLIFICATION = 0.2
PIECE_BUFFER = 0.1
JOINT = 0.1
"""Ends closer than this are one joint, metres."""
BESIDE_BOUNDARY = 0.3
ON_BOUNDARY = 0.2
QUADRANT_SEGMENTS = 16


@dataclass(frozen=True)
class LaneSide:
    """One boundary ``(n, 3)``, metres, of a lane that has a neighbour on that side; all lanes by their ids."""

    lane: int
    points: Float
    neighbour: int
    predecessors: tuple[int, ...] = field(default=())
    successors: tuple[int, ...] = field(default=())


Sides = Mapping[int, LaneSide]


def without_shared(left: Sides, right: Sides) -> tuple[Sides, Sides]:
    """Step 3: where two neighbours declare each other, keep the boundary of only one of them."""
    kept_right = dict(right)
    for side in left.values():
        kept_right.pop(side.neighbour, None)
    kept_left = dict(left)
    for side in kept_right.values():
        kept_left.pop(side.neighbour, None)
    return kept_left, kept_right


def twins_of(sides: Sequence[LaneSide]) -> set[tuple[int, int]]:
    """Pairs of lanes (both orders) whose boundaries are the same line, by the IoU of their thin buffers."""
    lines = [LineString(side.points) for side in sides]
    buffers = shapely.buffer(lines, BOUNDARY_BUFFER, quad_segs=QUADRANT_SEGMENTS)
    first, second = shapely.STRtree(buffers).query(buffers, predicate="intersects")
    upper = first < second
    first, second = first[upper], second[upper]
    same = _overlap(buffers[first], buffers[second]) >= SAME
    pairs = {(sides[a].lane, sides[b].lane) for a, b in zip(first[same], second[same], strict=True)}
    return pairs | {(b, a) for a, b in pairs}


def without_twins(sides: Sides, twins: set[tuple[int, int]]) -> Sides:
    """Step 4: drop boundaries that an earlier kept one repeats."""
    kept: dict[int, LaneSide] = {}
    for lane, side in sides.items():
        if not any((other, lane) in twins for other in kept):
            kept[lane] = side
    return kept


def relinked(sides: Sides) -> Sides:
    """Step 5: repair the links between lanes after some were dropped; only the first link of each list counts."""
    result = dict(sides)
    for lane in sides:
        before = result[lane].predecessors
        if before:
            if before[0] not in result or before[0] == lane:
                result[lane] = replace(result[lane], predecessors=())
            else:
                result[before[0]] = replace(result[before[0]], successors=(lane,))
        after = result[lane].successors
        if after:
            if after[0] not in result or after[0] == lane:
                result[lane] = replace(result[lane], successors=())
            else:
                result[after[0]] = replace(result[after[0]], predecessors=(lane,))
    return result


def chain_dividers(sides: Sides) -> list[LineString]:
    """Step 6: walk the graph of boundary vertices; every simple path from a start to an end is one line.

    Where lanes branch, paths overlap; a closed loop without a start gives nothing. Lines are simplified and keep z.
    """
    following: dict[Vertex3D, dict[Vertex3D, None]] = {}
    incoming: dict[Vertex3D, int] = {}

    def connect(start: Vertex3D, end: Vertex3D) -> None:
        for node in (start, end):
            following.setdefault(node, {})
            incoming.setdefault(node, 0)
        if end not in following[start]:
            following[start][end] = None
            incoming[end] += 1

    nodes = {lane: [_node(point) for point in np.round(side.points, 3)] for lane, side in sides.items()}
    for lane, side in sides.items():
        for start, end in zip(nodes[lane][:-1], nodes[lane][1:], strict=True):
            connect(start, end)
        for before in side.predecessors:
            if before in nodes and nodes[before][-1] != nodes[lane][0]:
                connect(nodes[before][-1], nodes[lane][0])
        for after in side.successors:
            if after in nodes and nodes[lane][-1] != nodes[after][0]:
                connect(nodes[lane][-1], nodes[after][0])
    rank = {node: number for number, node in enumerate(following)}
    paths: list[list[Vertex3D]] = []
    for root in (node for node, count in incoming.items() if count == 0):
        found = _simple_paths(root, following)
        paths += sorted(found, key=lambda path: rank[path[-1]])
    if not paths:
        return []
    lines = np.array([LineString(path) for path in paths], dtype=object)
    return list(shapely.simplify(lines, PATH_SIMPLIFICATION))


def _node(point: Float) -> Vertex3D:
    return (float(point[0]), float(point[1]), float(point[2]))


def _simple_paths(root: Vertex3D, following: Mapping[Vertex3D, Mapping[Vertex3D, None]]) -> list[list[Vertex3D]]:
    """All paths without a repeated node from ``root`` to a node where nothing follows, depth first."""
    paths: list[list[Vertex3D]] = []
    path = [root]
    on_path = {root}
    branches = [iter(following[root])]
    while branches:
        node = next(branches[-1], None)
        if node is None:
            branches.pop()
            on_path.discard(path.pop())
        elif node not in on_path:
            if following[node]:
                path.append(node)
                on_path.add(node)
                branches.append(iter(following[node]))
            else:
                paths.append([*path, node])
    return paths


def without_repeats(lines: Sequence[LineString]) -> list[LineString]:
    """Step 8: of lines whose buffers (flat ends) nearly coincide keep the first."""
    if len(lines) < 2:
        return list(lines)
    buffers = shapely.buffer(np.array(lines, dtype=object), PIECE_BUFFER, cap_style="flat", join_style="mitre")
    areas = shapely.area(buffers)
    first, second = shapely.STRtree(buffers).query(buffers, predicate="intersects")
    # Areas that differ by more than a tenth cannot overlap with an IoU of 0.9.
    similar = np.minimum(areas[first], areas[second]) >= SAME * np.maximum(areas[first], areas[second])
    candidate = (first < second) & similar
    first, second = first[candidate], second[candidate]
    same = _overlap(buffers[first], buffers[second]) >= SAME
    dropped: set[int] = set()
    order = np.lexsort((second[same], first[same]))
    for keep, drop in zip(first[same][order].tolist(), second[same][order].tolist(), strict=True):
        if keep not in dropped:
            dropped.add(drop)
    return [line for row, line in enumerate(lines) if row not in dropped]


def connected(lines: Sequence[Float]) -> list[Float]:
    """Step 9: join lines ``(n, 3)`` whose ends meet, first line first; what joins is appended with its vertex repeated.

    Lines come in the order in which they were finished.
    """
    waiting = list(lines)
    finished = []
    while waiting:
        this = waiting.pop(0)
        for index, other in enumerate(waiting):
            joined = _joined(this, other)
            if joined is not None:
                waiting.pop(index)
                waiting.insert(0, joined)
                break
        else:
            finished.append(this)
    return finished


def _joined(this: Float, other: Float) -> Float | None:
    gaps = np.linalg.norm(this[[0, -1]][:, None] - other[[0, -1]][None], axis=2) < JOINT
    if gaps[0, 0]:
        return np.concatenate([other[::-1], this])
    if gaps[0, 1]:
        return np.concatenate([other, this])
    if gaps[1, 0]:
        return np.concatenate([this, other])
    if gaps[1, 1]:
        return np.concatenate([this, other[::-1]])
    return None


def off_boundaries(dividers: Sequence[Float], boundaries: Sequence[Float]) -> list[Float]:
    """Step 10: drop dividers that run along a boundary (area of common buffer against the shorter length).

    The official test compares an area with a length, so a divider shorter than about 1.8 m is also dropped where it
    merely crosses a boundary.
    """
    if not dividers or not boundaries:
        return list(dividers)
    first = np.array([LineString(line[:, :2]) for line in dividers], dtype=object)
    second = np.array([LineString(line[:, :2]) for line in boundaries], dtype=object)
    near, beside = shapely.STRtree(second).query(first, predicate="dwithin", distance=2 * BESIDE_BOUNDARY)
    if len(near) == 0:
        return list(dividers)
    first_buffers = _buffer_used(first, near)
    second_buffers = _buffer_used(second, beside)
    common = shapely.area(shapely.intersection(first_buffers[near], second_buffers[beside]))
    shorter = np.minimum(shapely.length(first)[near], shapely.length(second)[beside])
    dropped = set(near[common > ON_BOUNDARY * shorter].tolist())
    return [line for row, line in enumerate(dividers) if row not in dropped]


def _buffer_used(lines: NDArray[Any], rows: NDArray[np.int64]) -> NDArray[Any]:
    """Buffers of the lines that are needed; None for the others."""
    buffers = np.full(len(lines), None, dtype=object)
    used = np.unique(rows)
    buffers[used] = shapely.buffer(lines[used], BESIDE_BOUNDARY, quad_segs=QUADRANT_SEGMENTS)
    return buffers


def _overlap(first: NDArray[Any], second: NDArray[Any]) -> Float:
    common = shapely.area(shapely.intersection(first, second))
    iou: Float = common / (shapely.area(first) + shapely.area(second) - common)
    return iou
