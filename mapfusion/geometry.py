"""Polylines and poses: resample, transform, clip, measure."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from mapfusion.elements import RegionOfInterest

Float = NDArray[np.float64]


def arc_length(points: Float) -> Float:
    """Distance along the line at each vertex.

    Args:
        points: ``(n, 2)``, metres.

    Returns:
        ``(n,) float64``, metres, starting at 0.
    """
    steps = np.linalg.norm(np.diff(points, axis=0), axis=1)
    return np.concatenate([[0.0], np.cumsum(steps)])


def resample(points: Float, count: int) -> Float:
    """Place ``count`` points at equal distances along the line, both ends included.

    Args:
        points: ``(n, 2)``, ``n >= 1``; a line without length repeats its first point.
        count: number of points, at least 2.

    Returns:
        ``(count, 2) float64``.
    """
    distance = arc_length(points)
    if distance[-1] == 0.0:
        return np.repeat(np.asarray(points[:1], dtype=np.float64), count, axis=0)
    stations = np.linspace(0.0, distance[-1], count)
    return np.stack([np.interp(stations, distance, points[:, axis]) for axis in range(2)], axis=1)


def transform_points(a_to_b: Float, points_a: Float) -> Float:
    """Move points of the plane z = 0 of frame a to frame b and drop z.

    Args:
        a_to_b: ``(4, 4)`` pose.
        points_a: ``(n, 2)``, metres.

    Returns:
        ``(n, 2) float64``, metres, frame b.
    """
    return points_a @ a_to_b[:2, :2].T + a_to_b[:2, 3]


def inverse_pose(a_to_b: Float) -> Float:
    """Return ``b_to_a`` of a rigid ``(4, 4)`` pose, without a general matrix inverse."""
    b_to_a = np.eye(4)
    b_to_a[:3, :3] = a_to_b[:3, :3].T
    b_to_a[:3, 3] = -a_to_b[:3, :3].T @ a_to_b[:3, 3]
    return b_to_a


def clip_line(points: Float, roi: RegionOfInterest) -> list[Float]:
    """Cut a line at the ROI and return the parts inside, in the order of the line (Liang and Barsky, 1984).

    A line that crosses itself is cut at the border only.

    Args:
        points: ``(n, 2)``, metres, ego frame.
        roi: the rectangle around the ego origin.

    Returns:
        List of ``(k, 2) float64`` with ``k >= 2``.
    """
    half = roi.size / 2
    points = points[np.append(True, (np.diff(points, axis=0) != 0.0).any(axis=1))]
    start, step = points[:-1], np.diff(points, axis=0)
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        sides = np.stack([-half - start, half - start]) / step
    parallel = step == 0.0
    beside = np.where(np.abs(start) <= half, -np.inf, np.inf)
    enter = np.where(parallel, beside, sides.min(axis=0)).max(axis=1, initial=0.0)
    leave = np.where(parallel, np.inf, sides.max(axis=0)).min(axis=1, initial=1.0)
    inside = np.flatnonzero(enter < leave)
    breaks = np.flatnonzero((np.diff(inside) > 1) | (leave[inside[:-1]] < 1.0) | (enter[inside[1:]] > 0.0)) + 1
    parts = []
    for rows in np.split(inside, breaks) if len(inside) else []:
        last = start[rows[-1]] + leave[rows[-1]] * step[rows[-1]]
        part = np.vstack([start[rows] + enter[rows, None] * step[rows], last])
        parts.append(np.clip(part, -half, half))
    return parts


def chamfer_distance(first: Float, second: Float) -> float:
    """Mean of the two directed mean nearest-point distances, metres (as in the chamfer AP of the field).

    Args:
        first, second: ``(n, 2)`` and ``(m, 2)`` point sets, usually densely resampled lines.
    """
    forward = cKDTree(second).query(first)[0].mean()
    backward = cKDTree(first).query(second)[0].mean()
    return float((forward + backward) / 2)
