"""Shadows on the ground: outlines of the feet of things that stand there, and of the shadows they cast."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from mapfusion.arrays import Float, Float32
from predmapnet.demo_world.terrain import Terrain
from predmapnet.demo_world.world import Solids

LEAFY_SHADE = 64
"""Light left in the shadow of leaves, [0, 255]; flecks of sun are drawn where it is neither 0 nor 255."""

_SQUARE = np.array([[-0.5, -0.5], [0.5, -0.5], [0.5, 0.5], [-0.5, 0.5]])
_ANGLES = np.linspace(0, 2 * np.pi, 12, endpoint=False)
_CIRCLE = 0.5 * np.stack([np.cos(_ANGLES), np.sin(_ANGLES)], axis=1)


def _outline(solids: Solids, index: int, grow: float = 0.0) -> Float:
    """Outline seen from above, ``(n, 2)`` metres."""
    unit = _SQUARE if solids.shape[index] == "box" else _CIRCLE
    cosine, sine = np.cos(solids.yaw[index]), np.sin(solids.yaw[index])
    local = unit * (solids.size[index, :2] + 2 * grow)
    outline: Float = local @ np.array([[cosine, sine], [-sine, cosine]]) + solids.centre[index, :2]
    return outline


def contact_polygons(solids: Solids, mask: NDArray[np.bool_]) -> list[tuple[Float, int]]:
    """Ground below and close to the solids of a mask, and how much of the sky's light is left there, [0, 255]."""
    low = solids.centre[:, 2] - solids.size[:, 2] / 2
    rows = np.flatnonzero(mask & (low < 0.4)).tolist()
    return [(_outline(solids, row, 0.12), 38 if solids.texture[row] == "vehicle" else 128) for row in rows]


def shadow_polygons(
    solids: Solids, mask: NDArray[np.bool_], sun_direction: Float32, terrain: Terrain | None = None
) -> list[tuple[Float, int]]:
    """Outlines ``(k, 2)``, metres, of the shadows of a mask's solids on the ground, and the light left, [0, 255].

    ``sun_direction`` is a unit vector towards the sun, above the horizon. On a terrain each shadow falls on the plane
    that touches the ground at the solid's foot.
    """
    level = -np.asarray(sun_direction[:2], dtype=np.float64) / max(float(sun_direction[2]), 0.05)
    # Slices of an ellipsoid: their heights and how much narrower they are than its middle, three of them above it.
    heights = np.array([-0.8, -0.3, 0.3, 0.8])
    shrink = np.sqrt(1 - heights**2)
    rows, rises = np.flatnonzero(mask), np.zeros(len(mask))
    if terrain is not None:
        rises[rows] = terrain.gradients(solids.centre[rows, :2]) @ level
    polygons = []
    for row in rows.tolist():
        # Falling ground lengthens a shadow, rising ground meets it sooner.
        slope = level / max(1 + rises[row], 0.3)
        middle, half = solids.centre[row, 2], solids.size[row, 2] / 2
        outline, foot = _outline(solids, row), solids.centre[row, :2]
        if solids.shape[row] == "ellipsoid":
            rings = (
                shrink[:, None, None] * (outline - foot) + (foot + (middle + half * heights)[:, None] * slope)[:, None]
            )
        else:
            # A vehicle's roof is smaller than its floor.
            roof = foot + 0.75 * (outline - foot) if solids.texture[row] == "vehicle" else outline
            rings = np.stack([outline + slope * max(middle - half, 0.0), roof + slope * (middle + half)])
        # Relative to the foot, single precision is exact enough for any city's coordinates.
        hull = cv2.convexHull((rings.reshape(-1, 2) - foot).astype(np.float32))[:, 0]
        polygons.append((hull + foot, LEAFY_SHADE if solids.texture[row] == "foliage" else 0))
    return polygons
