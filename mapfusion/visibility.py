"""What ground a car could see at one instant: its region of interest, as far as cameras look and nothing is in the way.

A detector that says nothing of a place has either looked and found nothing, or could not look. Only the first is
evidence against what the map holds there. Whoever knows the difference tells it with ``FrameMap.visible``: outlines of
the visible ground, from cameras and things in the way by :func:`visible_ground`, or from anything else (free space of
a lidar, a range image). Whoever does not leaves it None, and the whole region counts as looked at.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import shapely
from numpy.typing import NDArray

from mapfusion.elements import FrameMap, RegionOfInterest
from mapfusion.geometry import transform_points
from mapfusion.ground import ground_within, rings_around

Float = NDArray[np.float64]

SECTOR_STEP = np.radians(5.0)
"""Arcs have a vertex every so many radians."""


@dataclass(frozen=True)
class CameraSector:
    """The ground that a camera looks at: a sector without end.

    Attributes:
        position: ``(2,) float64``, metres, ego frame.
        heading: of the optical axis, radians from x (forward) towards y (left).
        field_of_view: horizontal, radians, at most a full turn.
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


def shadow(eye: Float, thing: Float, reach: float) -> shapely.Polygon:
    """Return the ground that a convex thing hides, what it stands on included.

    Args:
        eye: ``(2,)``, where the camera is, metres.
        thing: ``(n, 2)``, outline on the ground, metres; taller than the camera is high.
        reach: how far the shadow goes, metres.
    """
    away = thing - eye
    far = eye + away * (reach / np.maximum(np.linalg.norm(away, axis=1, keepdims=True), 1e-6))
    return shapely.MultiPoint(np.vstack([thing, far])).convex_hull


def visible_ground(
    roi: RegionOfInterest, cameras: Sequence[CameraSector], things: Sequence[Float] = ()
) -> tuple[Float, ...]:
    """Return the ground that at least one camera sees, for ``FrameMap.visible``.

    Args:
        roi: the region that the detector reports on.
        cameras: of the car.
        things: convex outlines ``(n, 2)``, metres, ego frame, of what is taller than the cameras are high: trucks,
            buses, walls. Lower ones hide little ground.

    Returns:
        Rings ``(n, 2)``, metres, ego frame; a ring within another is a hole.

    Example:
        >>> truck = np.array([[5.0, 2.0], [13.0, 2.0], [13.0, 4.5], [5.0, 4.5]])
        >>> rings = visible_ground(RegionOfInterest(), [CameraSector(np.zeros(2))], [truck])
        >>> bool(shapely.contains_xy(ground_within(rings), 15.0, 8.0)), bool(
        ...     shapely.contains_xy(ground_within(rings), 15.0, -8.0)
        ... )
        (False, True)
    """
    reach = 2.0 * float(np.hypot(*roi.size))
    seen = [
        shapely.difference(
            camera.ground(reach), shapely.union_all([shadow(camera.position, thing, 2.0 * reach) for thing in things])
        )
        for camera in cameras
    ]
    return tuple(rings_around(shapely.intersection(shapely.union_all(seen), region(roi))))


def region(roi: RegionOfInterest) -> shapely.Polygon:
    """Return the rectangle of a region of interest, ego frame."""
    return shapely.box(*(-roi.size / 2), *(roi.size / 2))


def ground_problem(frame_map: FrameMap) -> str | None:
    """Say what is wrong with the visible ground that a frame states, or None."""
    for ring in frame_map.visible or ():
        if np.ndim(ring) != 2 or np.shape(ring)[1] != 2 or len(ring) < 3 or not np.isfinite(ring).all():
            return "visible ground is no polygon"
    return None


def frame_ground(frame_map: FrameMap) -> shapely.Geometry:
    """Return the ground that was looked at in a frame, global frame, metres."""
    ground = region(frame_map.roi)
    if frame_map.visible is not None:
        ground = shapely.intersection(ground, ground_within(frame_map.visible))
    return shapely.transform(ground, lambda points: transform_points(frame_map.ego_to_global, points))
