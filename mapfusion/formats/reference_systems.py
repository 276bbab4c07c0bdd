"""Coordinate reference systems of map files that other programs wrote: the way to longitude and latitude (WGS84)."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from typing import Any

import numpy as np

from mapfusion.arrays import Float

BEYOND = 3.0
"""Degrees beyond the borders of a system's area in which it is used all the same, as UTM is beyond its zones."""

ON_THE_GLOBE = np.array([180.0, 90.0])


class ToDegrees:
    """Transformation of positions of a reference system to longitude and latitude, degrees (WGS84).

    Args:
        name: of the system, as the file gives it: an EPSG code, a URN or WKT.
        where: file and layer, for the message.

    Raises:
        ValueError: PROJ knows no such system, or no way from it to WGS84.
    """

    def __init__(self, name: str, where: str) -> None:
        self._where = where
        try:
            self._transformer = _transformer(name)
        except ValueError as error:
            raise ValueError(
                f"{where}: its coordinate reference system cannot be turned into longitude and latitude ({error}). "
                "Save it in WGS84 (EPSG:4326)"
            ) from error

    def positions(self, positions: Float) -> Float:
        """Map ``(n, 2)`` positions of the system to ``(n, 2)`` degrees; raises ValueError for those off the globe."""
        if self._transformer is None:
            degrees = positions
        else:
            degrees = np.stack(self._transformer.transform(positions[:, 0], positions[:, 1]), axis=1)
        if not (np.abs(degrees) <= ON_THE_GLOBE).all():  # False for NaN, too
            first = positions[int(np.argmin((np.abs(degrees) <= ON_THE_GLOBE).all(axis=1)))]
            raise ValueError(
                f"{self._where}: positions such as {first.tolist()} are not longitude and latitude in degrees (WGS84)"
            )
        return degrees

    def box(self, box: Sequence[float]) -> list[float]:
        """Map west, south, east and north of the system to degrees."""
        if self._transformer is None:
            return list(box)
        return list(self._transformer.transform_bounds(*box))


class FromDegrees:
    """Transformation of longitude and latitude, degrees (WGS84), to a reference system.

    Args:
        name: of the system: an EPSG code, ``EPSG:32632``.

    Raises:
        ValueError: PROJ knows no such system, or it is none of places on Earth in two axes.
    """

    def __init__(self, name: str) -> None:
        from pyproj import CRS
        from pyproj.exceptions import CRSError

        self.name = name
        try:
            self._system = CRS.from_user_input(name)
        except CRSError as error:
            raise ValueError(
                f"PROJ knows no reference system '{name}'; an EPSG code is expected, EPSG:32632"
            ) from error
        if not (self._system.is_projected or self._system.is_geographic) or len(self._system.axis_info) != 2:
            raise ValueError(f"{name} ({self._system.name}) is no system of places in two axes; take a projected one")

    def positions(self, degrees: Float) -> Float:
        """Map ``(n, 2)`` degrees to ``(n, 2)`` positions; raises ValueError where the system does not hold."""
        area = self._system.area_of_use
        if area is not None and len(degrees):
            low = np.array([area.west, area.south]) - BEYOND
            high = np.array([area.east, area.north]) + BEYOND
            outside = ~((degrees >= low) & (degrees <= high)).all(axis=1)
            if area.west <= area.east and outside.any():
                place = degrees[int(np.argmax(outside))]
                raise ValueError(
                    f"the map lies at {place[0]:.3f}, {place[1]:.3f} degrees (longitude, latitude), outside the area "
                    f"of {self.name}: {area.name}"
                )
        transformer = _transformer(self.name)
        if transformer is None:
            return degrees
        return np.stack(transformer.transform(degrees[:, 0], degrees[:, 1], direction="INVERSE"), axis=1)


@lru_cache(maxsize=16)
def _transformer(name: str) -> Any:
    """Return the transformer of a system, None for longitude and latitude themselves; raises ValueError."""
    if not name.strip():
        raise ValueError("it names none")
    if "undefined" in name[:40].lower():  # of a GeoPackage: degrees, but nobody knows on which datum
        raise ValueError("it is undefined")
    if name in ("EPSG:4326", "OGC:CRS84", "urn:ogc:def:crs:OGC:1.3:CRS84"):
        return None
    from pyproj import CRS, Transformer
    from pyproj.exceptions import ProjError

    try:
        system, degrees = CRS.from_user_input(name), CRS.from_epsg(4326)
        if system.equals(degrees, ignore_axis_order=True):
            return None
        return Transformer.from_crs(system, degrees, always_xy=True)
    except ProjError as error:
        raise ValueError(f"{name[:60]!r} is unknown to PROJ") from error
