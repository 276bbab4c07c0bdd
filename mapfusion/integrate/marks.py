"""Marks of places and tracks: sets of at most 64 bits that tell how many different ones saw a station."""

from __future__ import annotations

import numpy as np

from mapfusion.arrays import Float, Marks

PLACE = 5.0
"""Side of the square cells that stand for the place from which the car saw a station, metres."""


def place_mark(log: int, position: Float) -> int:
    """Return the bit that stands for where the car was: one of 64, neighbours differ."""
    x, y = int(np.floor(position[0] / PLACE)), int(np.floor(position[1] / PLACE))
    return 1 << ((x + 27 * y + 11 * log) % 64)


def track_mark(log: int, track: int) -> int:
    """Return the bit that stands for a track: one of 64."""
    return 1 << ((track + 37 * log) % 64)


def distinct(marks: Marks) -> Float:
    """Estimate how many different things have left a mark (linear counting: Whang et al., TODS 1990), at least 1."""
    free = np.maximum(64.0 - np.bitwise_count(marks), 0.5)
    return np.asarray(np.maximum(-64.0 * np.log(free / 64.0), 1.0))
