"""Protocols of a georeference: how a metric frame leads to WGS84 and back."""

from __future__ import annotations

from typing import Protocol

from mapfusion.arrays import Float


class Georeference(Protocol):
    """Georeference of a metric frame: the way to WGS84, used where maps are written."""

    @property
    def name(self) -> str:
        """Name of the metric frame, for a file's metadata."""
        ...

    def to_wgs84(self, points: Float) -> Float:
        """Map ``(n, 2)`` metres, global frame, to ``(n, 2)`` longitude and latitude, degrees."""
        ...


class InvertibleGeoreference(Georeference, Protocol):
    """Georeference that also leads back."""

    def from_wgs84(self, points: Float) -> Float:
        """Map ``(n, 2)`` longitude and latitude, degrees, to ``(n, 2)`` metres, global frame."""
        ...
