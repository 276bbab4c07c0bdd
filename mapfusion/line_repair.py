"""Repair of lines: spikes and loops taken out, hairpins found, ends closed."""

from __future__ import annotations

import numpy as np
import shapely

from mapfusion.arrays import Float, Integer

SPIKE_COSINE = np.cos(np.radians(120.0))
"""Cosine of the turn between two stations from which on a line folds back on itself."""

HAIRPIN = 3
"""Number of stations past a turn for which a line must run back to be a hairpin, not a spike."""

CLOSING_GAP = 2.0
"""Distance up to which the ends of one line that run into each other are one place, metres."""


def hairpins(points: Float) -> list[int]:
    """Return the rows at which a line of stations turns back for good: the tip of a gore is an end of two lines.

    Its points ``(n, 2)`` lie about one metre apart.
    """
    if len(points) < 2 * HAIRPIN + 1:
        return []
    arrive, leave = points[HAIRPIN:-HAIRPIN] - points[: -2 * HAIRPIN], points[2 * HAIRPIN :] - points[HAIRPIN:-HAIRPIN]
    size = np.linalg.norm(arrive, axis=1) * np.linalg.norm(leave, axis=1)
    cosine = (arrive * leave).sum(axis=1) / np.maximum(size, 1e-9)
    tips: list[int] = []
    while len(cosine) and cosine.min() < SPIKE_COSINE:
        tip = int(np.argmin(cosine))
        tips.append(tip + HAIRPIN)
        cosine[max(tip - HAIRPIN, 0) : tip + HAIRPIN + 1] = 1.0
    return sorted(tips)


def repaired_rows(points: Float) -> Integer:
    """Return the rows of a line's vertices ``(n, 2)``, metres, that remain when spikes and loops are taken out."""
    rows = np.arange(len(points))
    while len(rows) > 2:
        moved = np.append(True, np.any(points[rows[1:]] != points[rows[:-1]], axis=1))
        if not moved.all():
            rows = rows[moved]
        elif len(spikes := _spikes(points[rows])):
            rows = np.delete(rows, spikes[:1])
        elif (loop := _first_loop(points[rows])) is not None:
            rows = np.delete(rows, np.arange(loop[0] + 1, loop[1] + 1))
        else:
            break
    return rows


def closes(points: Float) -> bool:
    """Whether a line of at least 8 m comes back to its start and runs into it."""
    gap = points[0] - points[-1]
    distance = float(np.linalg.norm(gap))
    if len(points) < 8 or distance > CLOSING_GAP:
        return False
    leave, arrive = points[1] - points[0], points[-1] - points[-2]
    return bool(leave @ arrive > 0.0 and (distance < 0.3 or (gap @ leave > 0.0 and gap @ arrive > 0.0)))


def _spikes(points: Float) -> Integer:
    step = np.diff(points, axis=0)
    length = np.maximum(np.linalg.norm(step, axis=1), 1e-9)
    cosine = (step[1:] * step[:-1]).sum(axis=1) / (length[1:] * length[:-1])
    return np.flatnonzero(cosine < SPIKE_COSINE) + 1


def _first_loop(points: Float) -> tuple[int, int] | None:
    """Return the segments ``i < j`` that cross with the fewest segments between them, or None."""
    if shapely.is_simple(shapely.LineString(points)):
        return None
    segments = shapely.linestrings(np.stack([points[:-1], points[1:]], axis=1))
    first, second = shapely.STRtree(segments).query(segments, predicate="intersects")
    between = second - first
    crossing = between > 1
    crossing &= ~((first == 0) & (second == len(segments) - 1) & (points[0] == points[-1]).all())
    if not crossing.any():
        return None
    best = np.flatnonzero(crossing)[np.argmin(between[crossing])]
    return int(first[best]), int(second[best])
