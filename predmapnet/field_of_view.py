"""The ground that a car's cameras look at, for the integrator: a camera that is missing has seen nothing."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
import shapely
from numpy.typing import NDArray

from mapfusion.elements import RegionOfInterest
from mapfusion.ground import CameraSector, ground_within, region, rings_around, visible_ground
from predmapnet.scenes import Camera, Frame

Float = NDArray[np.float64]

NARROW = 2.0
"""Gaps between neighbouring cameras narrower than twice this are bridged by what is seen on either side, metres."""

WHOLE = 0.99
"""From this share of the region on it counts as seen as a whole."""


def sector_of(camera: Camera) -> CameraSector:
    """Return the horizontal sector that a camera looks at."""
    focal, centre = camera.intrinsics[0, 0], camera.intrinsics[0, 2]
    left, right = np.arctan2(centre, focal), np.arctan2(camera.width - centre, focal)
    axis = camera.camera_to_ego[:2, 2]
    heading = np.arctan2(axis[1], axis[0]) + (left - right) / 2
    return CameraSector(camera.camera_to_ego[:2, 3], float(heading), float(left + right))


def seen_by(cameras: Iterable[Camera], roi: RegionOfInterest) -> tuple[Float, ...] | None:
    """Return the ground that cameras look at, as ``FrameMap.visible``: rings ``(n, 2)``, or None for all of the ROI."""
    ground = ground_within(visible_ground(roi, [sector_of(camera) for camera in cameras]))
    closed = shapely.buffer(shapely.buffer(ground, NARROW, quad_segs=2), -NARROW, quad_segs=2)
    if shapely.intersection(closed, region(roi)).area >= WHOLE * region(roi).area:
        return None
    return tuple(rings_around(closed))


def seen_in(frame: Frame, roi: RegionOfInterest) -> tuple[Float, ...] | None:
    """Return the ground that the cameras look at of which a frame has images."""
    return seen_by((camera for camera in frame.rig if camera.name in frame.images), roi)
