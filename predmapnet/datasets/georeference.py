"""Georeferences of the data sets: from metric frames to longitude and latitude (WGS84)."""

from __future__ import annotations

import re
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from pyproj import CRS, Transformer

from mapfusion.arrays import Float
from mapfusion.formats.local_plane import LocalPlane
from mapfusion.georeference import check_reach
from predmapnet.errors import UserError

NUSCENES_ORIGINS = {
    "boston-seaport": (42.336849169438615, -71.05785369873047),
    "singapore-onenorth": (1.2882100868743724, 103.78475189208984),
    "singapore-hollandvillage": (1.2993652317780957, 103.78217697143555),
    "singapore-queenstown": (1.2782562240223188, 103.76741409301758),
}
"""Latitude and longitude of the maps' lower left corners, from the nuScenes devkit's pose export."""

ARGOVERSE2_CITIES = {
    "ATX": (30.27464237939507, -97.7404457407424, 14),
    "DTW": (42.29993066912924, -83.17555750783717, 17),
    "MIA": (25.77452579915163, -80.19656914449405, 17),
    "PAO": (37.416065, -122.13571963362166, 10),
    "PIT": (40.44177902989321, -80.01294377242584, 17),
    "WDC": (38.889377, -77.0355047439081, 18),
}
"""Latitude, longitude and UTM zone (north) of the city frames' origins, from the av2 package."""

SEEDS = 10_000
"""Number of the demo world's towns."""

POINT_NEMO = (-48.8767, -123.3933)
"""Latitude and longitude of the point of the ocean farthest from any land: home of the demo world."""


@dataclass(frozen=True)
class SphereGeoreference:
    """Bearing and distance from an origin, degrees, on a sphere of the equatorial radius, as in the nuScenes devkit."""

    name: str
    latitude: float
    longitude: float
    radius: float = 6378137.0

    def to_wgs84(self, points: Float) -> Float:
        """Map ``(n, 2)`` metres (x east, y north) to ``(n, 2)`` longitude and latitude, degrees."""
        check_reach(points, self.name)
        latitude = np.radians(self.latitude)
        bearing = np.arctan2(points[:, 0], points[:, 1])
        angle = np.hypot(points[:, 0], points[:, 1]) / self.radius
        there = np.arcsin(np.sin(latitude) * np.cos(angle) + np.cos(latitude) * np.sin(angle) * np.cos(bearing))
        east = np.arctan2(
            np.sin(bearing) * np.sin(angle) * np.cos(latitude), np.cos(angle) - np.sin(latitude) * np.sin(there)
        )
        longitude = np.radians(self.longitude) + east
        return np.stack([np.degrees(longitude), np.degrees(there)], axis=1)


@dataclass(frozen=True)
class UtmGeoreference:
    """A city frame that is UTM shifted to an origin, degrees, as Argoverse 2 defines it; northern hemisphere."""

    name: str
    latitude: float
    longitude: float
    zone: int

    @cached_property
    def _utm(self) -> Transformer:
        return Transformer.from_crs(CRS.from_epsg(4326), CRS.from_epsg(32600 + self.zone), always_xy=True)

    def to_wgs84(self, points: Float) -> Float:
        """Map ``(n, 2)`` metres, city frame, to ``(n, 2)`` longitude and latitude, degrees."""
        check_reach(points, self.name)
        east, north = self._utm.transform(self.longitude, self.latitude)
        longitude, latitude = self._utm.transform(points[:, 0] + east, points[:, 1] + north, direction="INVERSE")
        return np.stack([longitude, latitude], axis=1)


@dataclass(frozen=True)
class LocalFrame:
    """A frame whose place on Earth is not known: its maps lie about longitude 0 and latitude 0, where no road is.

    Maps of one ``frame`` may be merged; ``east`` and ``north`` are metres taken off large coordinates (as of UTM).
    """

    frame: str
    east: float = 0.0
    north: float = 0.0

    @property
    def name(self) -> str:
        """Name for metadata."""
        shifted = f", {self.east:.0f} m east and {self.north:.0f} m north taken off" if self.east or self.north else ""
        return f"local frame of {self.frame}, whose place on Earth is not known{shifted}"

    def to_wgs84(self, points: Float) -> Float:
        """Map ``(n, 2)`` metres to ``(n, 2)`` longitude and latitude, degrees."""
        return LocalPlane(0.0, 0.0, self.name).to_wgs84(points - [self.east, self.north])

    def from_wgs84(self, points: Float) -> Float:
        """Map ``(n, 2)`` longitude and latitude, degrees, to ``(n, 2)`` metres."""
        return np.array([self.east, self.north]) + LocalPlane(0.0, 0.0, self.name).from_wgs84(points)


LOCAL_GRID = 100_000.0
"""Spacing of the origins of local frames, metres, so that logs of one place get the same one."""


def local_frame(name: str, position: Float) -> LocalFrame:
    """Return a local frame for poses around ``position``, ``(2,)``, metres."""
    east, north = (np.round(position / LOCAL_GRID) * LOCAL_GRID).tolist()
    return LocalFrame(name, east, north)


def given_origin(text: str) -> LocalPlane:
    """Return the frame whose origin a user gives as ``latitude,longitude``, x east and y north. Raises UserError."""
    try:
        latitude, longitude = (float(number) for number in text.split(","))
    except ValueError as error:
        raise UserError(f"--origin {text}: latitude,longitude in degrees are expected, as in 49.01,8.41") from error
    return plane_at(latitude, longitude, "given origin", f"--origin {text}")


def plane_at(latitude: float, longitude: float, name: str, where: str) -> LocalPlane:
    """Return the plane about a place, degrees; UserError with ``where`` if there is no such place for a map."""
    if not (abs(latitude) < 85 and abs(longitude) <= 180):
        raise UserError(f"{where} does not lie on Earth; latitude comes first")
    return LocalPlane(longitude, latitude, name)


def nuscenes_georeference(location: str) -> SphereGeoreference | None:
    """Return the georeference of a nuScenes map, or None for a map that nuScenes does not know."""
    origin = NUSCENES_ORIGINS.get(location)
    return None if origin is None else SphereGeoreference(location, *origin)


def argoverse2_georeference(city: str) -> UtmGeoreference | None:
    """Return the georeference of an Argoverse 2 city (``PIT``), or None for an unknown one."""
    origin = ARGOVERSE2_CITIES.get(city)
    return None if origin is None else UtmGeoreference(city, *origin)


def demo_georeference(name: str, index: int) -> SphereGeoreference:
    """Return a place in the South Pacific for a demo town of that seed.

    Towns lie on a grid of 0.1 degrees and never overlap; they may be 10 km across. Raises UserError for other seeds.
    """
    if not 0 <= index < SEEDS:
        raise UserError(f"{name}: there is no town {index}; towns are numbered from 0 to {SEEDS - 1}.")
    row, column = divmod(index, 20)
    return SphereGeoreference(name, POINT_NEMO[0] + 0.1 * row, POINT_NEMO[1] + 0.1 * column)


def georeference_of(location: str, synthetic: bool = False) -> SphereGeoreference | UtmGeoreference | None:
    """Return where a frame lies (``boston-seaport``, ``PIT``, ``town-0101``), or None for an unknown location.

    A made-up (``synthetic``) place never lies where a real one does.
    """
    town = re.fullmatch(r"town-(\d{4})", location)
    if town is not None:
        return demo_georeference(f"demo world, {location}", int(town[1]))
    return None if synthetic else nuscenes_georeference(location) or argoverse2_georeference(location)
