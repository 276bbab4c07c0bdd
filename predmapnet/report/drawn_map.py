"""Elements of maps packed for the canvas of a page: small, and quick to unpack."""

from __future__ import annotations

import base64
import zlib
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import shapely
from numpy.typing import NDArray

from mapfusion.arrays import Float, Integer
from mapfusion.elements import MapElement

STEP = 0.05
"""Grid of the drawn points, metres."""

UNKNOWN = 255
"""Deviation of an element that states none."""

TRUTH = 3
"""Added to the kinds of elements of the ground truth."""


@dataclass(frozen=True)
class DrawnElement:
    """Element as it is drawn.

    Attributes:
        element: itself.
        shift: ``(2,)``, from its frame to the sheet, metres.
        row: of the table, the drive or map that it belongs to.
        truth: whether it is ground truth.
    """

    element: MapElement
    shift: Float
    row: int
    truth: bool = False


def packed(drawn: Sequence[DrawnElement]) -> dict[str, int | str]:
    """Return elements as the page's script reads them: numbers of elements and points, and the rest in base64.

    The rest, compressed by zlib, is in this order, little-endian: row (uint32), number of points (uint32), observations
    (uint16), kind, confidence in 1/255, largest deviation in 2 cm (uint8); then the points on a grid of 5 cm, each as
    two differences from the point before, zigzag varints.
    """
    points, owner = shapely.get_coordinates(_simplified(drawn), return_index=True)
    counts = np.bincount(owner, minlength=len(drawn))
    grid = np.round(points / STEP).astype(np.int64)
    steps = np.diff(grid, axis=0, prepend=np.zeros((1, 2), dtype=np.int64))
    elements = [item.element for item in drawn]
    deviations = [
        UNKNOWN if e.deviation is None else min(254, round(float(e.deviation.max()) / 0.02)) for e in elements
    ]
    columns = (
        np.array([item.row for item in drawn], dtype="<u4"),
        counts.astype("<u4"),
        np.array([min(e.observations, 65535) for e in elements], dtype="<u2"),
        np.array([int(item.element.kind) + TRUTH * item.truth for item in drawn], dtype=np.uint8),
        np.array([round(255 * e.confidence) for e in elements], dtype=np.uint8),
        np.array(deviations, dtype=np.uint8),
        varints(steps.ravel()),
    )
    content = zlib.compress(b"".join(column.tobytes() for column in columns), 6)
    return {"elements": len(drawn), "points": len(points), "packed": base64.b64encode(content).decode()}


def _simplified(drawn: Sequence[DrawnElement]) -> NDArray[np.object_]:
    if not drawn:
        return np.zeros(0, dtype=object)
    lengths = [len(item.element.points) for item in drawn]
    shifts = np.repeat([item.shift for item in drawn], lengths, axis=0)
    points = np.concatenate([item.element.points for item in drawn]) + shifts
    lines = shapely.linestrings(points, indices=np.repeat(np.arange(len(drawn)), lengths))
    simple: NDArray[np.object_] = shapely.simplify(lines, STEP)
    return simple


def varints(numbers: Integer) -> NDArray[np.uint8]:
    """Return integers as zigzag varints: seven bits a byte, the lowest first, the eighth bit where more follow."""
    rest = np.where(numbers < 0, -2 * numbers - 1, 2 * numbers).astype(np.uint64)
    sizes = np.ones(len(rest), dtype=np.int64)
    for size in range(1, 6):
        sizes[rest >= np.uint64(1 << (7 * size))] = size + 1
    starts = np.cumsum(sizes) - sizes
    out = np.zeros(int(sizes.sum()), dtype=np.uint8)
    for byte in range(6):
        rows = np.flatnonzero(sizes > byte)
        bits = (rest[rows] >> np.uint64(7 * byte)) & np.uint64(127)
        out[starts[rows] + byte] = bits.astype(np.uint8) | np.where(sizes[rows] > byte + 1, 128, 0).astype(np.uint8)
    return out
