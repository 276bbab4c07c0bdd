"""Fusion of the crossings of several maps: signed distances averaged on a grid (Curless and Levoy, 1996)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import shapely
from scipy.special import expit

from mapfusion.arrays import Float
from mapfusion.corners import drawn_outline
from mapfusion.elements import MapElement, united_origins
from mapfusion.formats.identities import element_name
from mapfusion.merge.config import MergeConfig
from mapfusion.merge.contribution import Contribution, certainty, doubt, information
from mapfusion.road_heights import RoadHeights, filled, mean_heights
from mapfusion.signed_distance import positive_areas, signed_distance

CELL = 0.25
"""Side of a grid cell, metres."""


@dataclass
class _Cluster:
    """Cluster of rings of different maps that are one crossing."""

    rings: list[MapElement] = field(default_factory=list)
    polygons: list[shapely.Geometry] = field(default_factory=list)
    sources: list[int] = field(default_factory=list)


def fuse_rings(contributions: Sequence[Contribution], config: MergeConfig) -> list[MapElement]:
    """Fuse the crossings of several maps of one place: those that more likely exist than not.

    The contributions, one per map, come in an order that does not depend on how the maps were given.
    """
    clusters: list[_Cluster] = []
    for contribution in contributions:
        _assign(clusters, contribution, config)
    fused = []
    for cluster in clusters:
        sure = sum(certainty(ring, config) for ring in cluster.rings)
        for contribution in contributions:
            if contribution.source not in cluster.sources:
                shared = shapely.intersection(cluster.polygons[0], contribution.ground).area
                if shared > 0.8 * cluster.polygons[0].area:
                    middle = shapely.get_coordinates(cluster.polygons[0].point_on_surface())
                    sure -= float(doubt(contribution, middle, config)[0])
        outline = _outline(cluster, config)
        if sure > 0.0 and outline is not None:
            fused.append(_element(cluster, outline, sure, config))
    return fused


def _assign(clusters: list[_Cluster], contribution: Contribution, config: MergeConfig) -> None:
    """File the rings of one map; each crossing takes at most one of them, best overlap first."""
    polygons = [shapely.make_valid(shapely.Polygon(ring.points)) for ring in contribution.elements]
    if not polygons:
        return
    options: list[tuple[float, int, int]] = []
    if clusters:
        known = [cluster.polygons[0] for cluster in clusters]
        rows, places = shapely.STRtree(known).query(polygons, predicate="intersects")
        for row, place in zip(rows.tolist(), places.tolist(), strict=True):
            common = shapely.intersection(polygons[row], known[place]).area
            share = common / max(polygons[row].area + known[place].area - common, 1e-9)
            # half a crossing lies within the whole one
            within = 0.5 * common / max(min(polygons[row].area, known[place].area), 1e-9)
            options.append((max(share, within), row, place))
    taken: dict[int, int] = {}
    for share, row, place in sorted(options, key=lambda option: (-option[0], option[1], option[2])):
        if share >= config.ring_overlap and row not in taken and place not in taken.values():
            taken[row] = place
    for row, ring in enumerate(contribution.elements):
        if row not in taken:
            clusters.append(_Cluster())
        cluster = clusters[taken[row]] if row in taken else clusters[-1]
        cluster.rings.append(ring)
        cluster.polygons.append(polygons[row])
        cluster.sources.append(contribution.source)


def _outline(cluster: _Cluster, config: MergeConfig) -> Float | None:
    """Return the outline where the weighted mean of the signed distances is zero, ``(n, 2)`` closed, or None."""
    if len(cluster.rings) == 1:
        return cluster.rings[0].points
    points = np.concatenate([ring.points for ring in cluster.rings])
    low = np.floor((points.min(axis=0) - 0.5) / CELL) * CELL
    shape = np.ceil((points.max(axis=0) + 0.5 - low) / CELL).astype(int)
    x, y = (low[axis] + CELL * (np.arange(shape[axis]) + 0.5) for axis in range(2))
    total = np.zeros(shape)
    for ring in cluster.rings:
        total += float(information(ring, config).mean()) * signed_distance(x, y, ring.points)
    polygons = positive_areas(total)
    if not polygons:
        return None
    outline = shapely.get_coordinates(polygons[0]) * CELL + low + 0.5 * CELL
    fused: Float = shapely.get_coordinates(shapely.orient_polygons(drawn_outline(shapely.Polygon(outline))))
    return fused


def _element(cluster: _Cluster, outline: Float, sure: float, config: MergeConfig) -> MapElement:
    weight = sum(float(information(ring, config).mean()) for ring in cluster.rings)
    heights = filled(mean_heights((RoadHeights.of_elements([ring]) for ring in cluster.rings), outline), outline)
    return MapElement(
        kind=cluster.rings[0].kind,
        points=outline,
        confidence=float(expit(min(sure, 6.0))),
        observations=sum(ring.observations for ring in cluster.rings),
        first_seen=min(ring.first_seen for ring in cluster.rings),
        last_seen=max(ring.last_seen for ring in cluster.rings),
        deviation=np.full(len(outline), 1.0 / np.sqrt(weight)),
        heights=heights,
        name=element_name(cluster.rings[0]),
    ).with_origins(united_origins(ring.origins for ring in cluster.rings))
