"""Poses that are off as in RTMap (arXiv 2507.00980), and how far corrected ones still are."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from mapfusion.arrays import Float
from mapfusion.geometry import inverse_pose
from tests.mapfusion.simulation import pose

SIDEWAYS, ALONG, TURN = 0.75, 1.5, np.radians(0.85)
"""Standard deviations of the errors of poses: metres, metres, radians."""


def off_by_frame(poses: Sequence[Float], rng: np.random.Generator) -> list[Float]:
    """Return poses that are each off by themselves."""
    return [at @ pose(*(rng.normal(size=3) * (ALONG, SIDEWAYS, TURN))) for at in poses]


def off_by_drive(poses: Sequence[Float], rng: np.random.Generator) -> list[Float]:
    """Return poses that are off as a whole: shifted along and across the mean direction, turned about their middle."""
    positions = np.array([at[:2, 3] for at in poses])
    way = np.mean([at[:2, 0] for at in poses], axis=0)
    x, y = positions.mean(axis=0)
    middle = pose(x, y, float(np.arctan2(way[1], way[0])))
    motion = middle @ pose(*(rng.normal(size=3) * (ALONG, SIDEWAYS, TURN))) @ inverse_pose(middle)
    return [motion @ at for at in poses]


def remaining_errors(own: Sequence[Float], true: Sequence[Float]) -> tuple[float, float, float]:
    """Return root mean squares of what poses are off sideways (metres), along (metres) and in heading (degrees)."""
    off = [inverse_pose(at) @ mine for mine, at in zip(own, true, strict=True)]
    rows = [(d[1, 3], d[0, 3], np.degrees(np.arctan2(d[1, 0], d[0, 0]))) for d in off]
    sideways, along, turn = np.sqrt(np.mean(np.square(rows), axis=0)).tolist()
    return sideways, along, turn
