"""Middle lines of the streets of a road, from nothing but its outline.

The medial axis comes from the Voronoi diagram of points along the outline. Branches into corners are pruned, and what
is left is cut into streets between junctions and ends.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import shapely
from scipy.ndimage import gaussian_filter1d
from scipy.spatial import Voronoi
from shapely import MultiPolygon, Polygon

from mapfusion.arrays import Float, Integer
from mapfusion.geometry import arc_length, resample

OUTLINE_STEP = 1.5
"""Metres between the points along the outline."""
SMALLEST_HOLE = 25.0
"""A road runs round islands of this many square metres; smaller ones do not part it."""
SHORTEST_SPUR = 14.0
"""A dead end that is shorter, metres, is a corner or a driveway; so is one not much longer than the road is wide."""
SMOOTHING = 3.0
"""Standard deviation along the line, metres."""

Chain = list[int]
"""Vertices from one node to the next."""


@dataclass(frozen=True)
class Street:
    """A street between two nodes.

    Attributes:
        nodes: of its beginning and its end, rows of ``RoadSkeleton.places``.
        line: ``(n, 2)`` about every metre along its middle.
        half_width: ``(n,)`` metres, smooth, and never more than to the nearest kerb.
    """

    nodes: tuple[int, int]
    line: Float
    half_width: Float


@dataclass(frozen=True)
class RoadSkeleton:
    """Streets of a road, and ``(k, 2)`` places of the nodes, junctions and ends, between them."""

    places: Float
    streets: tuple[Street, ...]

    def degree(self, node: int) -> int:
        """Number of streets that begin or end there: 1 at an end, 3 and more at a junction."""
        return sum(street.nodes.count(node) for street in self.streets)


def road_skeleton(road: Polygon | MultiPolygon) -> RoadSkeleton:
    """Return the middle lines of a road's streets; loops without any junction are left out.

    Args:
        road: drivable area, metres.
    """
    area = shapely.union_all([_without_small_holes(part) for part in shapely.get_parts(road)])
    places, half_width, ridges = _medial_axis(area)
    neighbours: dict[int, set[int]] = {}
    for first, second in ridges.tolist():
        neighbours.setdefault(first, set()).add(second)
        neighbours.setdefault(second, set()).add(first)
    _prune(neighbours, places, half_width)
    return _streets(_chains(neighbours), places, half_width, shapely.boundary(area))


def _without_small_holes(part: Polygon) -> Polygon:
    return Polygon(part.exterior, [ring for ring in part.interiors if Polygon(ring).area > SMALLEST_HOLE])


def _medial_axis(road: shapely.Geometry) -> tuple[Float, Float, Integer]:
    """Return vertices ``(v, 2)``, their distances to the outline ``(v,)``, and pairs of them ``(e, 2)``."""
    rings = [ring for part in shapely.get_parts(road) for ring in (part.exterior, *part.interiors)]
    points = [
        shapely.get_coordinates(shapely.line_interpolate_point(ring, np.arange(0.0, ring.length - 0.1, OUTLINE_STEP)))
        for ring in rings
    ]
    diagram = Voronoi(np.unique(np.concatenate(points), axis=0))
    ridges = np.array(diagram.ridge_vertices)
    shapely.prepare(road)
    inside = shapely.contains_xy(road, diagram.vertices)
    ridges = ridges[(ridges >= 0).all(axis=1) & inside[ridges].all(axis=1)]
    ridges = ridges[shapely.contains(road, shapely.linestrings(diagram.vertices[ridges]))]
    half_width = shapely.distance(shapely.boundary(road), shapely.points(diagram.vertices))
    return np.asarray(diagram.vertices), np.asarray(half_width), ridges


def _chains(neighbours: dict[int, set[int]]) -> list[Chain]:
    """Chains of vertices from node to node; a node is whatever has not exactly two neighbours."""
    nodes = {vertex for vertex, near in neighbours.items() if len(near) != 2}
    chains, walked = [], set()
    for node in sorted(nodes):
        for following in sorted(neighbours[node]):
            if (node, following) in walked:
                continue
            chain = [node, following]
            while chain[-1] not in nodes:
                (onward,) = neighbours[chain[-1]] - {chain[-2]}
                chain.append(onward)
            walked |= {(node, following), (chain[-1], chain[-2])}
            chains.append(chain)
    return chains


def _length(chain: Chain, places: Float) -> float:
    return float(arc_length(places[chain])[-1])


def _prune(neighbours: dict[int, set[int]], places: Float, half_width: Float) -> None:
    """Take away dead ends that are too short to be streets, shortest first, as junctions vanish with them."""
    while True:
        spurs = []
        for chain in _chains(neighbours):
            for branch in (chain, chain[::-1]):
                foot, length = branch[0], _length(chain, places)
                longest = max(1.5 * half_width[foot] + 4.0, SHORTEST_SPUR)
                if len(neighbours[branch[-1]]) == 1 < len(neighbours[foot]) and length < longest:
                    spurs.append((length, branch))
        if not spurs:
            return
        shortened: set[int] = set()
        for _, branch in sorted(spurs):
            if branch[0] not in shortened:
                # One at a time from each junction: what is left of it may be a street that just goes on.
                shortened.add(branch[0])
                _remove(neighbours, branch[1:])


def _remove(neighbours: dict[int, set[int]], vertices: Chain) -> None:
    for vertex in vertices:
        for near in neighbours.pop(vertex):
            neighbours[near].discard(vertex)


def _streets(chains: list[Chain], places: Float, half_width: Float, kerbs: shapely.Geometry) -> RoadSkeleton:
    """Merge nodes whose mouths overlap, and make streets of the chains between the others."""
    merged = {end: end for chain in chains for end in (chain[0], chain[-1])}

    def root(node: int) -> int:
        while merged[node] != node:
            node = merged[node]
        return node

    for chain in chains:
        mouths = 0.9 * float(half_width[chain[0]] + half_width[chain[-1]])
        if _length(chain, places) < max(mouths, 6.0):
            merged[root(chain[-1])] = root(chain[0])
    roots = sorted({root(node) for node in merged})
    rows = {node: roots.index(root(node)) for node in merged}
    middles = [places[[node for node in merged if rows[node] == row]].mean(axis=0) for row in range(len(roots))]
    streets = [
        _street((rows[chain[0]], rows[chain[-1]]), places[chain], kerbs)
        for chain in chains
        if rows[chain[0]] != rows[chain[-1]]
    ]
    return RoadSkeleton(np.array(middles).reshape(-1, 2), tuple(streets))


def _street(nodes: tuple[int, int], line: Float, kerbs: shapely.Geometry) -> Street:
    """A street whose line is smooth, every metre."""
    length = float(arc_length(line)[-1])
    dense = resample(line, max(8, int(length / 0.5)))
    smooth = gaussian_filter1d(dense, SMOOTHING * len(dense) / length, axis=0, mode="nearest")
    middle = resample(smooth, max(4, round(length)))
    reach = shapely.distance(kerbs, shapely.points(middle))
    # Where the kerb bends away into a junction, smoothing alone would put lines beyond it.
    half_width = np.minimum(gaussian_filter1d(reach, SMOOTHING * len(middle) / length, mode="nearest"), reach)
    return Street(nodes, middle, half_width)
