"""Presence, localisation and shape of pairs of lines: the single values of the stability metric, compiled with numba.

The current line ``c`` is compared with the previous line ``p``, moved into the current ego frame by the poses. Formulas
follow the public toolbox of the benchmark *Stability Under Scrutiny* (ICLR 2026), peculiarities included: see
:mod:`predmapnet.evaluation.stability`.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from mapfusion.arrays import Float, Integer

PRESENCE_THRESHOLD = np.float32(0.3)
APPEARANCE = np.float32(0.2)
"""Presence of an instance that appears; everything else has 1."""
SAMPLES = 100
"""Places along x at which two lines are compared."""
OFFSET_SCALE = 15.0
"""Metres of lateral offset at which the localisation is 0."""
WINDOW = (30.0, 15.0)
"""Vertices of the moved line beyond these ``|x|``, ``|y|``, metres, are dropped before the localisation."""


def presence(current_scores: NDArray[np.float32], previous_scores: NDArray[np.float32]) -> Float:
    """Presence ``(m,)`` by two scores, 0 where nothing was matched: 0.2 for an instance that appears, else 1.

    That holds for one that vanishes, too.
    """
    appears = (current_scores >= PRESENCE_THRESHOLD) & (previous_scores <= PRESENCE_THRESHOLD)
    return np.where(appears, APPEARANCE, np.float32(1.0)).astype(np.float64)


def localisation_and_shape(
    points: Float, offsets: Integer, lines: Integer, poses: Float, frames: Integer
) -> tuple[Float, Float]:
    """Compare pairs of lines: localisation and shape, ``(m,)`` each, in [0, 1].

    Args:
        points: ``(k, 2) float64``, vertices of all lines one after the other, metres, each in its own ego frame.
        offsets: ``(n + 1,)``; line ``i`` is ``points[offsets[i]:offsets[i + 1]]``.
        lines: ``(m, 2)`` current and previous line of each pair; -1 for none.
        poses: ``(f, 4, 4)`` ego to global.
        frames: ``(m, 2)`` rows of ``poses``: the current and the previous one of each pair.
    """
    values: tuple[Float, Float] = _values(points, offsets, lines, np.ascontiguousarray(poses), frames)
    return values


def localisation_matrix(
    current: Float, current_offsets: Integer, previous: Float, previous_offsets: Integer
) -> NDArray[np.float32]:
    """Localisation ``(n, m) float32`` of every current line against every previous one, in one frame, without a window.

    Vertices ``(k, 2)``, metres, come line after line; the offsets say where each line begins, and the end.
    """
    matrix: NDArray[np.float32] = _matrix(current, current_offsets, previous, previous_offsets).astype(np.float32)
    return matrix


@njit(cache=True)
def into_current_frame(
    points: Float, current_pose: Float, previous_pose: Float
) -> Float:  # pragma: no cover - compiled
    """Move points ``(n, 2)`` from the previous ego frame into the current one; the height is dropped afterwards.

    Equal points stay equal to the last bit, which the turning angles rely on.
    """
    moved = np.empty((len(points), 2))
    world = np.empty(3)
    for row in range(len(points)):
        x, y = points[row, 0], points[row, 1]
        for axis in range(3):
            world[axis] = previous_pose[axis, 0] * x + previous_pose[axis, 1] * y + previous_pose[axis, 3]
            world[axis] -= current_pose[axis, 3]
        for axis in range(2):
            moved[row, axis] = (
                current_pose[0, axis] * world[0] + current_pose[1, axis] * world[1] + current_pose[2, axis] * world[2]
            )
    return moved


@njit(cache=True)
def stations_of(line: Float) -> Float:  # pragma: no cover - compiled
    """Return the 100 x at which a line is compared, over its extent; a line without extent gets 0.2 m."""
    low, high = line[:, 0].min(), line[:, 0].max()
    if low == high:
        low, high = low - 0.1, high + 0.1
    step = (high - low) / (SAMPLES - 1)
    stations: Float = low + np.arange(SAMPLES) * step
    stations[SAMPLES - 1] = high
    return stations


@njit(cache=True)
def heights(line: Float, stations: Float) -> Float:  # pragma: no cover - compiled
    """Walk along a line ``(n, 2)`` and read y at ascending stations x, never going back.

    Only a line of ascending x is interpolated.
    """
    last = len(line) - 1
    found = np.empty(len(stations))
    piece = 0
    for row in range(len(stations)):
        x = stations[row]
        while piece < last and x > line[piece + 1, 0]:
            piece += 1
        if piece == last:
            found[row] = line[last, 1]
        elif x < line[piece, 0]:
            found[row] = line[0, 1]
        elif line[piece, 0] == line[piece + 1, 0]:
            found[row] = (line[piece, 1] + line[piece + 1, 1]) / 2.0
        else:
            share = (x - line[piece, 0]) / (line[piece + 1, 0] - line[piece, 0])
            found[row] = line[piece, 1] + share * (line[piece + 1, 1] - line[piece, 1])
    return found


@njit(cache=True)
def _localisation(first: Float, second: Float) -> float:  # pragma: no cover - compiled
    off = 0.0
    for row in range(SAMPLES):
        off += abs(first[row] - second[row]) / OFFSET_SCALE
    return min(max(1.0 - off / SAMPLES, 0.0), 1.0)


@njit(cache=True)
def _mean_turn(line: Float) -> float:  # pragma: no cover - compiled
    """Mean angle between following pieces, radians; vertices beside a piece without length are left out."""
    total, count = 0.0, 0
    for row in range(1, len(line) - 1):
        in_x, in_y = line[row, 0] - line[row - 1, 0], line[row, 1] - line[row - 1, 1]
        out_x, out_y = line[row + 1, 0] - line[row, 0], line[row + 1, 1] - line[row, 1]
        lengths = np.sqrt(in_x * in_x + in_y * in_y) * np.sqrt(out_x * out_x + out_y * out_y)
        if lengths > 0.0:
            total += np.arccos(min(max((in_x * out_x + in_y * out_y) / lengths, -1.0), 1.0))
            count += 1
    return total / count if count else 0.0


@njit(cache=True)
def _inside(line: Float) -> Float:  # pragma: no cover - compiled
    kept = np.empty_like(line)
    count = 0
    for row in range(len(line)):
        if abs(line[row, 0]) <= WINDOW[0] and abs(line[row, 1]) <= WINDOW[1]:
            kept[count] = line[row]
            count += 1
    return kept[:count]


@njit(cache=True)
def _values(
    points: Float, offsets: Integer, lines: Integer, poses: Float, frames: Integer
) -> tuple[Float, Float]:  # pragma: no cover - compiled
    localisation, shape = np.zeros(len(lines)), np.zeros(len(lines))
    for row in range(len(lines)):
        if lines[row, 0] < 0 or lines[row, 1] < 0:
            continue
        current = points[offsets[lines[row, 0]] : offsets[lines[row, 0] + 1]]
        before = points[offsets[lines[row, 1]] : offsets[lines[row, 1] + 1]]
        moved = into_current_frame(before, poses[frames[row, 0]], poses[frames[row, 1]])
        kept = _inside(moved)
        if len(current) and len(kept):
            stations = stations_of(current)
            localisation[row] = _localisation(heights(current, stations), heights(kept, stations))
        if len(current) < 2 or len(before) < 2:
            continue
        if len(current) < 3 or len(kept) < 3:
            shape[row] = 1.0
        else:
            shape[row] = max(0.0, 1.0 - abs(_mean_turn(current) - _mean_turn(moved)) / np.pi)
    return localisation, shape


@njit(cache=True)
def _matrix(
    current: Float, current_offsets: Integer, previous: Float, previous_offsets: Integer
) -> Float:  # pragma: no cover - compiled
    matrix = np.zeros((len(current_offsets) - 1, len(previous_offsets) - 1))
    for row in range(matrix.shape[0]):
        line = current[current_offsets[row] : current_offsets[row + 1]]
        stations = stations_of(line)
        own = heights(line, stations)
        for column in range(matrix.shape[1]):
            other = previous[previous_offsets[column] : previous_offsets[column + 1]]
            matrix[row, column] = _localisation(own, heights(other, stations))
    return matrix
