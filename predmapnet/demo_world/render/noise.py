"""Tiles of noise that repeat without a seam; every texture of the demo world is made from them."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

TILE = 1024
"""Side of a tile, texels; a power of two, so that coordinates wrap by a bit mask."""


@lru_cache(maxsize=8)
def fractal_tile(roughness: float, seed: int = 7) -> NDArray[np.float32]:
    """Return periodic noise ``(TILE, TILE) float32`` in [0, 1], every value equally frequent.

    Its spectrum is ``1 / f ** roughness``: 0 is white noise, 2 is smooth like clouds.
    """
    white = np.random.default_rng(seed).standard_normal((TILE, TILE))
    frequency = np.hypot(np.fft.fftfreq(TILE)[:, None], np.fft.rfftfreq(TILE)[None, :])
    frequency[0, 0] = 1.0
    rough = np.fft.irfft2(np.fft.rfft2(white) / frequency**roughness, s=(TILE, TILE))
    rank = np.empty(TILE * TILE, dtype=np.float32)
    rank[np.argsort(rough, axis=None)] = np.linspace(0.0, 1.0, TILE * TILE, dtype=np.float32)
    return rank.reshape(TILE, TILE)
