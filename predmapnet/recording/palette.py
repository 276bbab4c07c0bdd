"""Rasters in the colours of their kinds."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mapfusion.colours import BACKGROUND, KIND_COLOURS
from mapfusion.elements import ElementKind

Bytes = NDArray[np.uint8]


def raster_picture(rasters: NDArray[np.float32], kinds: NDArray[np.int64]) -> Bytes:
    """Draw probability rasters ``(n, rows, columns)`` in the colours of their kinds: ``(rows, columns, 3) uint8``.

    Where several overlap the strongest shows; near black where there is nothing.
    """
    background = np.array(BACKGROUND, dtype=np.float64)
    if len(rasters) == 0:
        return np.broadcast_to(background.astype(np.uint8), (*rasters.shape[1:], 3)).copy()
    palette = np.array([KIND_COLOURS[kind] for kind in ElementKind], dtype=np.float64)
    strongest = np.argmax(rasters, axis=0)
    strength = np.take_along_axis(rasters, strongest[None], axis=0)[0][..., None].clip(0.0, 1.0)
    picture: Bytes = np.round(background + strength * (palette[kinds[strongest]] - background)).astype(np.uint8)
    return picture
