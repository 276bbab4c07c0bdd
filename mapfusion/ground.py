"""Ground as polygons: what a car could see at one instant, what a drive looked at, and what a map speaks of.

A detector that reports nothing at a place has either looked and found nothing, or could not look. Only the first is
evidence against what the map holds there. ``FrameMap.visible`` tells the difference: outlines of the visible ground,
made by :func:`visible_ground` from cameras and obstacles, or by anything else (free space of a lidar, a range image).
Where it is None, the whole region counts as looked at.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import partial, reduce

import numpy as np
import shapely

from mapfusion.arrays import Bool, Float
from mapfusion.elements import FrameMap, GlobalMap, MapElement, RegionOfInterest
from mapfusion.geometry import transform_points
from mapfusion.georeference import Georeference, InvertibleGeoreference

SECTOR_STEP = np.radians(5.0)
"""Angle between the vertices of an arc, radians."""

NEAR = 8.0
"""Ground within this distance of an element that was found counts as looked at, metres."""

RIM = 2.0
"""Width of the rim of the seen ground in which a missing element means nothing, metres."""

SMALLEST_HOLE = 20.0
"""Holes in the seen ground smaller than this are not written, square metres."""

CLOSING = 8.0
"""Gaps narrower than twice this between stretches of looked-at ground count as looked at: the middle of a wide road,
metres."""


@dataclass(frozen=True)
class CameraSector:
    """Horizontal sector that a camera looks at, without a far end: from a position ``(2,)``, metres, ego frame.

    The heading of its axis is in radians from x (forward) towards y (left), its field at most a full turn.
    """

    position: Float
    heading: float = 0.0
    field_of_view: float = 2 * np.pi

    def ground(self, reach: float) -> shapely.Polygon:
        """Return the sector up to a distance, metres."""
        if self.field_of_view >= 2 * np.pi:
            return shapely.Point(self.position).buffer(reach)
        steps = max(int(np.ceil(self.field_of_view / SECTOR_STEP)), 2)
        angle = self.heading + self.field_of_view * np.linspace(-0.5, 0.5, steps + 1)
        arc = self.position + reach * np.stack([np.cos(angle), np.sin(angle)], axis=1)
        return shapely.Polygon(np.vstack([self.position, arc]))


def shadow(eye: Float, obstacle: Float, reach: float) -> shapely.Polygon:
    """Return the ground that a convex obstacle hides, its own footprint included.

    Args:
        eye: ``(2,)``, position of the camera, metres.
        obstacle: ``(n, 2)``, outline on the ground, metres; taller than the camera is high.
        reach: length of the shadow, metres.
    """
    away = obstacle - eye
    far = eye + away * (reach / np.maximum(np.linalg.norm(away, axis=1, keepdims=True), 1e-6))
    return shapely.MultiPoint(np.vstack([obstacle, far])).convex_hull


def visible_ground(
    roi: RegionOfInterest, cameras: Sequence[CameraSector], obstacles: Sequence[Float] = ()
) -> tuple[Float, ...]:
    """Return the ground that at least one camera sees, for ``FrameMap.visible``.

    Args:
        roi: the region that the detector reports on.
        cameras: of the car.
        obstacles: convex outlines ``(n, 2)``, metres, ego frame, of what is taller than the cameras are high: trucks,
            buses, walls. Lower ones hide little ground.

    Returns:
        Rings ``(n, 2)``, metres, ego frame; a ring within another is a hole.

    Example:
        >>> truck = np.array([[5.0, 2.0], [13.0, 2.0], [13.0, 4.5], [5.0, 4.5]])
        >>> rings = visible_ground(RegionOfInterest(), [CameraSector(np.zeros(2))], [truck])
        >>> shapely.contains_xy(ground_within(rings), [15.0, 15.0], [8.0, -8.0]).tolist()
        [False, True]
    """
    reach = 2.0 * float(np.hypot(*roi.size))
    seen = []
    for camera in cameras:
        shadows = [shadow(camera.position, outline, 2.0 * reach) for outline in obstacles]
        seen.append(shapely.difference(camera.ground(reach), shapely.union_all(shadows)))
    return tuple(rings_around(shapely.intersection(shapely.union_all(seen), region(roi))))


def region(roi: RegionOfInterest) -> shapely.Polygon:
    """Return the rectangle of a region of interest, ego frame."""
    return shapely.box(*(-roi.size / 2), *(roi.size / 2))


def ground_problem(frame_map: FrameMap) -> str | None:
    """Return the fault of the visible ground that a frame states, or None."""
    for ring in frame_map.visible or ():
        if np.ndim(ring) != 2 or np.shape(ring)[1] != 2 or len(ring) < 3 or not np.isfinite(ring).all():
            return "visible ground is no polygon"
    return None


def seen_along(frame_maps: Iterable[FrameMap]) -> shapely.Geometry:
    """Return the ground that was looked at on a drive: the union over its frames, global frame, metres.

    Frames that share one ``visible`` (one rig, all cameras there) share its outline, which makes 10,000 of them a
    matter of seconds.
    """
    grounds: list[shapely.Geometry] = []
    last: FrameMap | None = None
    ego_ground = shapely.Polygon()
    for frame_map in frame_maps:
        if last is None or frame_map.visible is not last.visible or frame_map.roi != last.roi:
            ego_ground = _ego_ground(frame_map)
        last, pose = frame_map, frame_map.ego_to_global
        grounds.append(shapely.transform(ego_ground, partial(transform_points, pose)))
    return shapely.union_all(grounds)


def _ego_ground(frame_map: FrameMap) -> shapely.Geometry:
    ground = region(frame_map.roi)
    if frame_map.visible is None:
        return ground
    return shapely.intersection(ground, ground_within(frame_map.visible))


def coverage(global_map: GlobalMap, plane: InvertibleGeoreference | None = None) -> shapely.Geometry:
    """Return the ground that a map speaks of, metres, in the map's frame.

    A map that says so itself is believed: ``provenance["observed"]`` holds rings of longitude and latitude, as
    ``predmapnet infer`` writes them from the drive. Otherwise, or without a ``plane`` that leads from degrees to the
    map's frame, it is the ground near its elements: the car passed where it found something, and a detector that
    found the kerb would have found the crossing beside it.
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


def inside(ground: shapely.Geometry, points: Float) -> Bool:
    """Return which of ``(n, 2)`` points lie on the ground."""
    shapely.prepare(ground)
    return np.asarray(shapely.contains_xy(ground, points[:, 0], points[:, 1]))
