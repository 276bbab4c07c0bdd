"""Colours of the recording: one per kind, distinct to colour-blind eyes, readable on a dark background."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mapfusion.elements import ElementKind

Bytes = NDArray[np.uint8]

KIND_COLOURS: dict[ElementKind, tuple[int, int, int]] = {
    ElementKind.PED_CROSSING: (86, 180, 233),
    ElementKind.DIVIDER: (255, 176, 0),
    ElementKind.BOUNDARY: (64, 214, 137),
}
"""Okabe and Ito's sky blue, orange and green, brightened."""

TRUTH_COLOUR = (125, 125, 130)
"""Ground truth: a grey that stays behind everything."""


def lighter(colour: tuple[int, int, int], share: float = 0.55) -> tuple[int, int, int]:
    """Blend a colour with white; forecasts are drawn so."""
    red, green, blue = (round(channel + (255 - channel) * share) for channel in colour)
    return red, green, blue


def darker(colour: tuple[int, int, int], share: float = 0.45) -> tuple[int, int, int]:
    """Blend a colour with black; the global map is drawn so, behind the current tracks."""
    red, green, blue = (round(channel * (1 - share)) for channel in colour)
    return red, green, blue


def raster_picture(rasters: NDArray[np.float32], kinds: NDArray[np.int64]) -> Bytes:
    """Draw probability rasters in the colours of their kinds; where several overlap the strongest shows.

    Args:
        rasters: ``(n, rows, columns)`` in ``[0, 1]``.
        kinds: ``(n,)``.

    Returns:
        ``(rows, columns, 3) uint8``, near black where there is nothing.
    """
    background = np.array([14.0, 16.0, 20.0])
    if len(rasters) == 0:
        return np.broadcast_to(background.astype(np.uint8), (*rasters.shape[1:], 3)).copy()
    palette = np.array([KIND_COLOURS[kind] for kind in ElementKind], dtype=np.float64)
    strongest = np.argmax(rasters, axis=0)
    strength = np.take_along_axis(rasters, strongest[None], axis=0)[0][..., None].clip(0.0, 1.0)
    picture: Bytes = np.round(background + strength * (palette[kinds[strongest]] - background)).astype(np.uint8)
    return picture
