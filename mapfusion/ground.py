"""Which ground a map speaks of: where nothing in the map means that nothing was there."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from functools import reduce

import numpy as np
import shapely
from numpy.typing import NDArray

from mapfusion.elements import GlobalMap, MapElement
from mapfusion.formats.geojson import Georeference, InvertibleGeoreference

Float = NDArray[np.float64]

NEAR = 8.0
"""Ground within this distance of an element that was found counts as looked at, metres."""

RIM = 2.0
"""This close to the edge of what was seen, nothing found means nothing, metres."""

SMALLEST_HOLE = 20.0
"""Smaller patches that a drive did not see are not told, square metres."""

CLOSING = 8.0
"""Gaps narrower than twice this between such grounds count, too: the middle of a wide road, metres."""


def coverage(global_map: GlobalMap, plane: InvertibleGeoreference | None = None) -> shapely.Geometry:
    """Return the ground that a map speaks of, metres, in the map's frame.

    A map that says so itself is believed: ``provenance["observed"]`` holds rings of longitude and latitude, as
    ``predmapnet infer`` writes them from the drive. Otherwise it is the ground near its elements: the car passed where
    it found something, and a detector that found the kerb would have found the crossing beside it.

    Args:
        global_map: the map.
        plane: leads from degrees to the map's frame; without it the second way is taken.
    """
    observed = global_map.provenance.get("observed")
    if observed and plane is not None:
        ground = ground_within([plane.from_wgs84(np.array(ring, dtype=np.float64)) for ring in observed])
    else:
        ground = near_elements(global_map)
    return shapely.buffer(ground, -RIM, quad_segs=2)


def observed_rings(ground: shapely.Geometry, georeference: Georeference) -> list[list[list[float]]]:
    """Return ground (metres) as it is written to ``provenance["observed"]``: rings in degrees, holes as rings, too."""
    simple = shapely.simplify(ground, 1.0)
    return [np.round(georeference.to_wgs84(ring), 7).tolist() for ring in rings_around(simple, SMALLEST_HOLE)]


def ground_within(rings: Sequence[Float]) -> shapely.Geometry:
    """Return what lies within an odd number of rings ``(n, 2)``, so that a ring within another is a hole."""
    polygons = (shapely.make_valid(shapely.Polygon(ring)) for ring in rings)
    return reduce(shapely.symmetric_difference, polygons, shapely.Polygon())


def rings_around(ground: shapely.Geometry, smallest_hole: float = 0.0) -> list[Float]:
    """Return the rings ``(n, 2)`` of ground, those of holes of at least some area (square of its unit) among them."""
    parts = [part for part in shapely.get_parts(ground) if part.geom_type == "Polygon" and not part.is_empty]
    holes = [hole for part in parts for hole in part.interiors if shapely.Polygon(hole).area >= smallest_hole]
    return [shapely.get_coordinates(ring) for ring in (*(part.exterior for part in parts), *holes)]


def near_elements(elements: Iterable[MapElement]) -> shapely.Geometry:
    """Return the ground beside elements, gaps closed, metres; past the end of a line nothing is known."""
    lines = shapely.simplify([shapely.LineString(element.points) for element in elements], 0.5)
    beside = shapely.union_all(shapely.buffer(lines, NEAR, quad_segs=2, cap_style="flat"))
    closed = shapely.buffer(shapely.buffer(beside, CLOSING, quad_segs=2), -CLOSING, quad_segs=2)
    return shapely.simplify(closed, 0.5)


def inside(ground: shapely.Geometry, points: Float) -> NDArray[np.bool_]:
    """Return which of ``(n, 2)`` points lie on the ground."""
    shapely.prepare(ground)
    return np.asarray(shapely.contains_xy(ground, points[:, 0], points[:, 1]))
