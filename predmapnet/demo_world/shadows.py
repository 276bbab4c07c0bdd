"""Where things that stand on the ground darken it: outlines of their feet and of the shadows they cast."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull

from predmapnet.demo_world.world import Solids

Float = NDArray[np.float64]
Float32 = NDArray[np.float32]

_SQUARE = np.array([[-0.5, -0.5], [0.5, -0.5], [0.5, 0.5], [-0.5, 0.5]])
_ANGLES = np.linspace(0, 2 * np.pi, 12, endpoint=False)
_CIRCLE = 0.5 * np.stack([np.cos(_ANGLES), np.sin(_ANGLES)], axis=1)


def _outline(solids: Solids, index: int, grow: float = 0.0) -> Float:
    """Outline seen from above, ``(n, 2)`` metres."""
    unit = _SQUARE if solids.shape[index] == "box" else _CIRCLE
    cosine, sine = np.cos(solids.yaw[index]), np.sin(solids.yaw[index])
    local = unit * (solids.size[index, :2] + 2 * grow)
    return local @ np.array([[cosine, sine], [-sine, cosine]]) + solids.centre[index, :2]


def contact_polygons(solids: Solids, mask: NDArray[np.bool_]) -> list[tuple[Float, float]]:
    """Ground below and close to things, and how much of the sky's light it lacks.

    Args:
        solids: all solids of the world.
        mask: ``(n,) bool``, which to take.
    """
    low = solids.centre[:, 2] - solids.size[:, 2] / 2
    rows = np.flatnonzero(mask & (low < 0.4))
    return [(_outline(solids, row, 0.12), 0.85 if solids.texture[row] == "vehicle" else 0.5) for row in rows]


def shadow_polygons(solids: Solids, mask: NDArray[np.bool_], sun_direction: Float32) -> list[Float]:
    """Convex outlines of the cast shadows on the plane z = 0, ``(k, 2)`` metres each.

    Args:
        solids: all solids of the world.
        mask: ``(n,) bool``, which to take.
        sun_direction: ``(3,)``, unit vector towards the sun, above the horizon.
    """
    slope = -np.asarray(sun_direction[:2], dtype=np.float64) / max(float(sun_direction[2]), 0.05)
    polygons = []
    for row in np.flatnonzero(mask):
        middle, half = solids.centre[row, 2], solids.size[row, 2] / 2
        outline = _outline(solids, row)
        if solids.shape[row] == "ellipsoid":
            # Slices of the ellipsoid, each shifted by its height.
            heights = np.array([-0.8, -0.4, 0.0, 0.4, 0.8])
            rings = [
                solids.centre[row, :2]
                + np.sqrt(1 - h * h) * (outline - solids.centre[row, :2])
                + slope * (middle + h * half)
                for h in heights
            ]
        else:
            # A vehicle's roof is smaller than its floor.
            roof = (
                outline
                if solids.texture[row] != "vehicle"
                else (solids.centre[row, :2] + 0.75 * (outline - solids.centre[row, :2]))
            )
            rings = [outline + slope * max(middle - half, 0.0), roof + slope * (middle + half)]
        points = np.concatenate(rings)
        polygons.append(points[ConvexHull(points).vertices])
    return polygons
