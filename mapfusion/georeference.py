"""Protocols of a georeference: how a metric frame leads to WGS84 and back."""

from __future__ import annotations

from typing import Protocol

import numpy as np

from mapfusion.arrays import Float

LOCAL_FRAME = "local_frame"
"""Key of the provenance that names a frame whose place on Earth is not known."""

FARTHEST = 100_000.0
"""Farthest that a point may lie from the origin of a local frame, metres: beyond, its lengths are not true."""


def check_reach(points: Float, name: str) -> None:
    """Raise ValueError unless points ``(n, 2)``, metres, lie within 100 km of the origin of the frame ``name``."""
    if len(points) and float(np.abs(points).max()) > FARTHEST:
        farthest = points[int(np.abs(points).max(axis=1).argmax())]
        raise ValueError(
            f"a point lies {np.hypot(*farthest) / 1000:.0f} km from the origin of its frame ({name}), at "
            f"{farthest[0]:.0f} m, {farthest[1]:.0f} m; within {FARTHEST / 1000:.0f} km its place is true. Are the "
            "coordinates those of another frame (UTM, for example), or is the origin another?"
        )


class Georeference(Protocol):
    """Georeference of a metric frame: the way to WGS84, used where maps are written."""

    @property
    def name(self) -> str:
        """Name of the metric frame, for a file's metadata."""

    def to_wgs84(self, points: Float) -> Float:
        """Map ``(n, 2)`` metres, global frame, to ``(n, 2)`` longitude and latitude, degrees."""


class InvertibleGeoreference(Georeference, Protocol):
    """Georeference that also leads back."""

    def from_wgs84(self, points: Float) -> Float:
        """Map ``(n, 2)`` longitude and latitude, degrees, to ``(n, 2)`` metres, global frame."""
