"""Left-hand traffic: a town for right-hand traffic seen in a mirror."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import shapely
from shapely import Polygon

from mapfusion.arrays import Float
from predmapnet.demo_world.town.street_plan import TOWN_CENTRE
from predmapnet.demo_world.world import VectorMap


def mirrored(points: Float) -> Float:
    """Reflect points ``(..., 2)`` so that x runs the other way and the centre of the town stays."""
    reflected: Float = np.asarray(points) * [-1.0, 1.0] + [2 * TOWN_CENTRE[0], 0.0]
    return reflected


def _polygon(polygon: Polygon) -> Polygon:
    reflected: Polygon = shapely.transform(polygon, mirrored)
    return reflected


def _heading(heading: float) -> float:
    return float(np.angle(np.exp(1j * (np.pi - heading))))


def mirrored_map(vector_map: VectorMap) -> VectorMap:
    """The same map in a mirror, for left-hand traffic."""
    return replace(
        vector_map,
        road_segments=tuple(map(_polygon, vector_map.road_segments)),
        lanes=tuple(map(_polygon, vector_map.lanes)),
        crossings=tuple(
            replace(crossing, polygon=_polygon(crossing.polygon), heading=_heading(crossing.heading))
            for crossing in vector_map.crossings
        ),
        dividers=tuple(replace(divider, points=mirrored(divider.points)) for divider in vector_map.dividers),
        # Walkways have needles that rounding can turn over.
        walkways=tuple(
            part
            for walkway in vector_map.walkways
            for part in shapely.get_parts(shapely.make_valid(_polygon(walkway)))
            if part.geom_type == "Polygon"
        ),
        parking=tuple(map(_polygon, vector_map.parking)),
        stop_lines=tuple(map(_polygon, vector_map.stop_lines)),
        lane_paths=tuple(map(mirrored, vector_map.lane_paths)),
        markings=tuple(replace(marking, points=mirrored(marking.points)) for marking in vector_map.markings),
        hatchings=tuple(
            replace(area, polygon=_polygon(area.polygon), heading=_heading(area.heading))
            for area in vector_map.hatchings
        ),
        left_hand=True,
    )
