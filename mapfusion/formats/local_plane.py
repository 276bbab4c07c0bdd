"""Local metric plane, for maps that come without the frame they were made in."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from mapfusion.arrays import Float
from mapfusion.georeference import check_reach

WGS84_SEMI_MAJOR_AXIS = 6_378_137.0
WGS84_ECCENTRICITY_SQUARED = 6.69437999014e-3

ORIGIN_GRID = 0.02
"""Spacing of the grid on which origins of common planes lie, degrees, so that later merges cut the same tiles."""

WIDEST = 1.0
"""Largest extent of the maps of one city, degrees."""


@dataclass(frozen=True)
class LocalPlane:
    """Plane of metres east and north of a point, by the ellipsoid's radii of curvature there.

    The way there and back is exact. Distances are true at the latitude of the origin; 5 km north of it, at 45 degrees,
    those from west to east are off by 0.08 %.

    Attributes:
        longitude, latitude: of the origin, degrees.
        name: for metadata.
    """

    longitude: float
    latitude: float
    name: str = "local plane"

    @property
    def origin(self) -> Float:
        """``(2,)``: longitude and latitude, degrees."""
        return np.array([self.longitude, self.latitude])

    @cached_property
    def scale(self) -> Float:
        """``(2,)``: metres per degree, east and north."""
        sine = math.sin(math.radians(self.latitude))
        root = math.sqrt(1.0 - WGS84_ECCENTRICITY_SQUARED * sine**2)
        meridian = WGS84_SEMI_MAJOR_AXIS * (1.0 - WGS84_ECCENTRICITY_SQUARED) / root**3
        parallel = WGS84_SEMI_MAJOR_AXIS / root * math.cos(math.radians(self.latitude))
        return np.asarray(np.radians(np.array([parallel, meridian])))

    def to_wgs84(self, points: Float) -> Float:
        """Map ``(n, 2)`` metres to ``(n, 2)`` longitude and latitude, degrees; ValueError far from the origin."""
        check_reach(points, self.name)
        return np.asarray(points / self.scale + self.origin)

    def from_wgs84(self, points: Float) -> Float:
        """Map ``(n, 2)`` longitude and latitude, degrees, to ``(n, 2)`` metres; ValueError far from the origin."""
        metres = np.asarray((points - self.origin) * self.scale)
        check_reach(metres, self.name)
        return metres


def common_plane(boxes: Float) -> LocalPlane:
    """Return one plane for several maps; it depends on what they cover, not on their order.

    Args:
        boxes: ``(n, 4)``: west, south, east, north of each map, degrees.

    Raises:
        ValueError: the maps lie too far apart to be of one city.
    """
    low, high = boxes[:, :2].min(axis=0), boxes[:, 2:].max(axis=0)
    if (high - low > WIDEST).any():
        raise ValueError(
            f"the maps are not of one city: they reach from {low[0]:.3f}, {low[1]:.3f} to {high[0]:.3f}, "
            f"{high[1]:.3f} degrees (longitude, latitude); give maps that lie within {WIDEST:g} degree"
        )
    longitude, latitude = np.round((low + high) / 2 / ORIGIN_GRID) * ORIGIN_GRID
    return LocalPlane(float(longitude), float(latitude))
