"""Geometry of polylines and poses: resample, transform, clip, measure."""

from __future__ import annotations

import numpy as np
import shapely
from scipy.spatial import cKDTree

from mapfusion.arrays import Float, Integer
from mapfusion.elements import RegionOfInterest

FARTHEST_POSE = 1e8
"""Poses farther from the origin of their frame are none, metres; UTM takes ten million."""
UNIT_TOLERANCE = 1e-14
"""Distance from 1 up to which a squared quaternion length counts as 1."""


def arc_length(points: Float) -> Float:
    """Return the distance along a line ``(n, 2)`` at each vertex, metres, ``(n,)``, from 0."""
    steps = np.linalg.norm(np.diff(points, axis=0), axis=1)
    return np.concatenate([[0.0], np.cumsum(steps)])


def resample(points: Float, count: int) -> Float:
    """Return ``count`` points (at least 2) at equal distances along a line ``(n, 2)``, both ends included.

    A line without length repeats its first point.
    """
    distance = arc_length(points)
    if distance[-1] == 0.0:
        return np.repeat(np.asarray(points[:1], dtype=np.float64), count, axis=0)
    stations = np.linspace(0.0, distance[-1], count)
    return np.stack([np.interp(stations, distance, points[:, axis]) for axis in range(2)], axis=1)


def tangents(points: Float, stops: Integer | None = None) -> Float:
    """Return unit directions ``(n, 2)`` at the vertices of lines, from their neighbours.

    Args:
        points: ``(n, 2)``, metres, lines of at least two vertices end to end.
        stops: ascending, past the last vertex of each line; one line if None.
    """
    stops = np.array([len(points)]) if stops is None else stops
    step = np.empty_like(points)
    step[1:-1] = points[2:] - points[:-2]
    first, last = np.append(0, stops[:-1]), stops - 1
    step[first] = points[first + 1] - points[first]
    step[last] = points[last] - points[last - 1]
    length = np.sqrt(step[:, 0] ** 2 + step[:, 1] ** 2)
    return step / np.maximum(length, 1e-9)[:, None]


def rigid_pose_problem(a_to_b: Float) -> str | None:
    """Return the fault of a pose, or None: it must be ``(4, 4)``, finite and rigid."""
    pose = np.asarray(a_to_b)
    if pose.shape != (4, 4):
        return "pose is not 4 x 4"
    if not np.isfinite(pose).all():
        return "pose is not finite"
    if np.abs(pose[3] - [0.0, 0.0, 0.0, 1.0]).max() > 1e-6:
        return "the last row of the pose is not 0, 0, 0, 1 (are rows and columns exchanged?)"
    if np.abs(pose[:3, 3]).max() > FARTHEST_POSE:
        return f"pose lies more than {FARTHEST_POSE:g} m away"
    rotation = pose[:3, :3]
    (a, b, c), (d, e, f), (g, h, i) = rotation.tolist()
    determinant = a * (e * i - f * h) - b * (d * i - f * g) + c * (d * h - e * g)
    if np.abs(rotation @ rotation.T - np.eye(3)).max() > 1e-3 or determinant < 0:
        return "pose is not rigid"
    return None


def rotation_of_quaternion(quaternion: Float) -> Float:
    """Return the rotations ``(..., 3, 3)`` of quaternions ``(..., 4)``, order w, x, y, z; normalised here."""
    w, x, y, z = np.moveaxis(quaternion, -1, 0)
    square = w * w + x * x + y * y + z * z
    # Order and grouping of the operations are those of the reader that the official data sets use. Their ground truth
    # depends on the last bits of poses, so nothing here may go through a matrix product, whose bits vary by machine.
    length = np.where(np.abs(1.0 - square) < UNIT_TOLERANCE, 1.0, np.sqrt(square))
    w, x, y, z = w / length, x / length, y / length, z / length
    left = ((x, w, -z, y), (y, z, w, -x), (z, -y, x, w))
    right = ((x, w, z, -y), (y, -z, w, x), (z, y, -x, w))
    rows = [
        [row[0] * column[0] + row[1] * column[1] + row[2] * column[2] + row[3] * column[3] for column in right]
        for row in left
    ]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def transform_points(a_to_b: Float, points_a: Float) -> Float:
    """Move points ``(n, 2)``, metres, of the plane z = 0 of frame a to frame b by a pose ``(4, 4)``, and drop z."""
    return points_a @ a_to_b[:2, :2].T + a_to_b[:2, 3]


def inverse_pose(a_to_b: Float) -> Float:
    """Return ``b_to_a`` of a rigid ``(4, 4)`` pose, without a general matrix inverse."""
    b_to_a = np.eye(4)
    b_to_a[:3, :3] = a_to_b[:3, :3].T
    b_to_a[:3, 3] = -a_to_b[:3, :3].T @ a_to_b[:3, 3]
    return b_to_a


def simplified_rows(points: Float, tolerance: float) -> Integer:
    """Return the rows of a line ``(n, 2)`` that stay when it is simplified to within ``tolerance``, metres."""
    simple = shapely.get_coordinates(shapely.simplify(shapely.LineString(points), tolerance))
    row_of = {point: row for row, point in enumerate(map(tuple, points.tolist()))}
    return np.array([row_of[point] for point in map(tuple, simple.tolist())], dtype=np.int64)


def clip_line(points: Float, roi: RegionOfInterest) -> list[Float]:
    """Cut a line ``(n, 2)``, ego frame, at the ROI: the parts inside, in its order (Liang and Barsky, 1984).

    A line that crosses itself is cut at the border only.
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
    """Return the mean of the two directed mean nearest-point distances, metres (as in the chamfer AP of the field).

    Point sets ``(n, 2)`` and ``(m, 2)`` are usually densely resampled lines.
    """
    forward = cKDTree(second).query(first)[0].mean()
    backward = cKDTree(first).query(second)[0].mean()
    return float((forward + backward) / 2)
