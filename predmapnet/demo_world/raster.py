"""The z-buffer: which face covers which sample of the image, at what depth.

Samples form a grid of ``supersampling`` by ``supersampling`` per pixel. ``1 / depth`` is linear over a flat face, so a
face is one plane per camera, and depth is exact wherever it is evaluated.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from predmapnet.demo_world.jit import kernel

Float = NDArray[np.float64]
Float32 = NDArray[np.float32]
Integer32 = NDArray[np.int32]

NEAR = 0.12
"""Metres before the camera where faces are cut."""


class View(NamedTuple):
    """A camera at one instant, as plain numbers.

    Attributes:
        rotation: ``(3, 3) float64``, camera to global.
        position: ``(3,) float64``, metres, global.
        focal_x, focal_y, centre_x, centre_y: pixels; the first pixel's centre lies at 0.5.
        width, height: pixels.
    """

    rotation: Float
    position: Float
    focal_x: float
    focal_y: float
    centre_x: float
    centre_y: float
    width: int
    height: int


@kernel
def face_plane(corner: Float, normal: Float, view: View, plane: Float) -> None:
    """Write into ``plane`` (3,) the coefficients of ``1 / depth = p0 * x + p1 * y + p2``, pixels."""
    rotation, position = view.rotation, view.position
    distance = 0.0
    for axis in range(3):
        distance += normal[axis] * (corner[axis] - position[axis])
    if abs(distance) < 1e-9:
        distance = -1e-9
    along = np.empty(3)
    for axis in range(3):
        along[axis] = (
            normal[0] * rotation[0, axis] + normal[1] * rotation[1, axis] + normal[2] * rotation[2, axis]
        ) / distance
    plane[0] = along[0] / view.focal_x
    plane[1] = along[1] / view.focal_y
    plane[2] = along[2] - plane[0] * view.centre_x - plane[1] * view.centre_y


@kernel
def _project_clipped(corners: Float, count: int, view: View, screen: Float) -> int:
    """Cut a face at the near plane and project it; returns the number of corners written to ``screen`` (10, 2)."""
    local = np.empty((8, 3))
    nearest, farthest = 1e30, -1e30
    for index in range(count):
        for axis in range(3):
            local[index, axis] = (
                (corners[index, 0] - view.position[0]) * view.rotation[0, axis]
                + (corners[index, 1] - view.position[1]) * view.rotation[1, axis]
                + (corners[index, 2] - view.position[2]) * view.rotation[2, axis]
            )
        nearest = min(nearest, local[index, 2])
        farthest = max(farthest, local[index, 2])
    if farthest <= NEAR:
        return 0
    written = 0
    for index in range(count):
        following = index + 1 if index + 1 < count else 0
        depth, after = local[index, 2], local[following, 2]
        if depth > NEAR:
            screen[written, 0] = local[index, 0] / depth * view.focal_x + view.centre_x
            screen[written, 1] = local[index, 1] / depth * view.focal_y + view.centre_y
            written += 1
        if (depth > NEAR) != (after > NEAR):
            share = (NEAR - depth) / (after - depth)
            x = local[index, 0] + share * (local[following, 0] - local[index, 0])
            y = local[index, 1] + share * (local[following, 1] - local[index, 1])
            screen[written, 0] = x / NEAR * view.focal_x + view.centre_x
            screen[written, 1] = y / NEAR * view.focal_y + view.centre_y
            written += 1
    return written


@kernel
def draw_faces(
    corners: Float,
    counts: NDArray[np.int64],
    normals: Float,
    view: View,
    samples: int,
    nearness: Float32,
    ids: Integer32,
) -> None:
    """Draw all faces.

    Args:
        corners, counts, normals: as in :class:`predmapnet.demo_world.mesh.Mesh`.
        view: the camera.
        samples: per pixel and direction.
        nearness: ``(samples * height, samples * width)``: largest ``1 / depth`` so far, changed in place.
        ids: same shape: face that is nearest, -1 for none, changed in place.
    """
    screen = np.empty((10, 2))
    plane = np.empty(3)
    rows, columns = nearness.shape
    for face in range(len(counts)):
        facing = 0.0
        for axis in range(3):
            facing += normals[face, axis] * (corners[face, 0, axis] - view.position[axis])
        if facing >= 0:
            continue
        count = _project_clipped(corners[face], counts[face], view, screen)
        if count < 3:
            continue
        top, bottom, left, right = 1e30, -1e30, 1e30, -1e30
        for index in range(count):
            screen[index, 0] *= samples
            screen[index, 1] *= samples
            left, right = min(left, screen[index, 0]), max(right, screen[index, 0])
            top, bottom = min(top, screen[index, 1]), max(bottom, screen[index, 1])
        if right <= 0 or left >= columns or bottom <= 0 or top >= rows:
            continue
        face_plane(corners[face, 0], normals[face], view, plane)
        for row in range(max(0, int(np.ceil(top - 0.5))), min(rows, int(np.ceil(bottom - 0.5)))):
            y = row + 0.5
            low, high = 1e30, -1e30
            for index in range(count):
                following = index + 1 if index + 1 < count else 0
                y0, y1 = screen[index, 1], screen[following, 1]
                if (y0 <= y) != (y1 <= y):
                    x = screen[index, 0] + (y - y0) / (y1 - y0) * (screen[following, 0] - screen[index, 0])
                    low, high = min(low, x), max(high, x)
            if high < low:
                continue
            first = max(0, int(np.ceil(max(low, -1.0) - 0.5)))
            last = min(columns, int(np.ceil(min(high, columns + 1.0) - 0.5)))
            constant = plane[1] * y / samples + plane[2]
            slope = plane[0] / samples
            for column in range(first, last):
                value = np.float32(slope * (column + 0.5) + constant)
                if value > nearness[row, column]:
                    nearness[row, column] = value
                    ids[row, column] = face


@kernel
def ball_depth(ball: Float, view: View, x: float, y: float) -> float:
    """Depth along the optical axis where the ray of pixel position (x, y) meets an ellipsoid, or -1."""
    cosine, sine = np.cos(ball[6]), np.sin(ball[6])
    across, down = (x - view.centre_x) / view.focal_x, (y - view.centre_y) / view.focal_y
    ray_x = view.rotation[0, 0] * across + view.rotation[0, 1] * down + view.rotation[0, 2]
    ray_y = view.rotation[1, 0] * across + view.rotation[1, 1] * down + view.rotation[1, 2]
    ray_z = (view.rotation[2, 0] * across + view.rotation[2, 1] * down + view.rotation[2, 2]) / ball[5]
    start_x, start_y = view.position[0] - ball[0], view.position[1] - ball[1]
    start_z = (view.position[2] - ball[2]) / ball[5]
    ray_u, ray_v = (cosine * ray_x + sine * ray_y) / ball[3], (cosine * ray_y - sine * ray_x) / ball[4]
    start_u, start_v = (cosine * start_x + sine * start_y) / ball[3], (cosine * start_y - sine * start_x) / ball[4]
    square = ray_u * ray_u + ray_v * ray_v + ray_z * ray_z
    half = ray_u * start_u + ray_v * start_v + ray_z * start_z
    constant = start_u * start_u + start_v * start_v + start_z * start_z - 1
    inside = half * half - square * constant
    if inside < 0:
        return -1.0
    return float((-half - np.sqrt(inside)) / square)


@kernel
def draw_balls(
    balls: Float, leafy: NDArray[np.int64], first_id: int, view: View, samples: int, noise: Float32, nearness: Float32,
    ids: Integer32,
) -> None:  # fmt: skip
    """Draw ellipsoids; those marked ``leafy`` have a ragged outline with gaps.

    Args:
        balls: ``(b, 7)`` as in :class:`predmapnet.demo_world.mesh.Mesh`.
        leafy: ``(b,)``, 1 for foliage.
        first_id: id of the first ball.
        view, samples, nearness, ids: as in :func:`draw_faces`.
        noise: tile in [0, 1].
    """
    rows, columns = nearness.shape
    for index in range(len(balls)):
        ball = balls[index]
        radius = max(ball[3], max(ball[4], ball[5]))
        x = y = depth = 0.0
        for axis in range(3):
            offset = ball[axis] - view.position[axis]
            x += offset * view.rotation[axis, 0]
            y += offset * view.rotation[axis, 1]
            depth += offset * view.rotation[axis, 2]
        if depth < -radius:
            continue
        left, right, top, bottom = 0, columns, 0, rows
        if depth > 1.5 * radius:
            # The sphere around the ellipsoid, seen from outside: a bound that is never too small.
            reach = radius * (1 + (abs(x) + abs(y)) / depth) / (depth - radius) * max(view.focal_x, view.focal_y)
            middle_x, middle_y = x / depth * view.focal_x + view.centre_x, y / depth * view.focal_y + view.centre_y
            if (
                middle_x + reach < 0
                or middle_x - reach > view.width
                or middle_y + reach < 0
                or middle_y - reach > view.height
            ):
                continue
            left, right = max(0, int((middle_x - reach) * samples)), min(columns, int((middle_x + reach) * samples) + 1)
            top, bottom = max(0, int((middle_y - reach) * samples)), min(rows, int((middle_y + reach) * samples) + 1)
        elif x * x + y * y + depth * depth < 1.05 * radius * radius:
            continue
        for row in range(top, bottom):
            for column in range(left, right):
                pixel_x, pixel_y = (column + 0.5) / samples, (row + 0.5) / samples
                hit = ball_depth(ball, view, pixel_x, pixel_y)
                if hit <= NEAR or 1 / hit <= nearness[row, column]:
                    continue
                if leafy[index] == 1:
                    across, down = (pixel_x - view.centre_x) / view.focal_x, (pixel_y - view.centre_y) / view.focal_y
                    point = np.empty(3)
                    for axis in range(3):
                        point[axis] = (
                            view.position[axis]
                            - ball[axis]
                            + hit
                            * (view.rotation[axis, 0] * across + view.rotation[axis, 1] * down + view.rotation[axis, 2])
                        )
                    facing = 0.0
                    length = 0.0
                    for axis in range(3):
                        towards = view.position[axis] - ball[axis] - point[axis]
                        gradient = point[axis] / (ball[3 + axis] * ball[3 + axis])
                        facing += towards * gradient
                        length += gradient * gradient
                    facing /= np.sqrt(length) * hit
                    u = int(np.floor((point[0] + 0.6 * point[2]) * 9)) & 1023
                    v = int(np.floor((point[1] - 0.7 * point[2]) * 9)) & 1023
                    if noise[v, u] > 0.22 + 2.0 * facing:
                        continue
                nearness[row, column] = np.float32(1 / hit)
                ids[row, column] = first_id + index


@kernel
def draw_mask(corners: Float, counts: NDArray[np.int64], view: View, value: int, mask: NDArray[np.uint8]) -> None:
    """Mark the pixels of flat polygons (shadows of what moves) in a mask ``(height, width)``."""
    screen = np.empty((10, 2))
    rows, columns = mask.shape
    for face in range(len(counts)):
        count = _project_clipped(corners[face], counts[face], view, screen)
        if count < 3:
            continue
        top, bottom = 1e30, -1e30
        for index in range(count):
            top, bottom = min(top, screen[index, 1]), max(bottom, screen[index, 1])
        for row in range(
            max(0, int(np.ceil(max(top, -1.0) - 0.5))), min(rows, int(np.ceil(min(bottom, rows + 1.0) - 0.5)))
        ):
            y = row + 0.5
            low, high = 1e30, -1e30
            for index in range(count):
                following = index + 1 if index + 1 < count else 0
                y0, y1 = screen[index, 1], screen[following, 1]
                if (y0 <= y) != (y1 <= y):
                    x = screen[index, 0] + (y - y0) / (y1 - y0) * (screen[following, 0] - screen[index, 0])
                    low, high = min(low, x), max(high, x)
            first = max(0, int(np.ceil(max(low, -1.0) - 0.5)))
            last = min(columns, int(np.ceil(min(high, columns + 1.0) - 0.5)))
            for column in range(first, last):
                mask[row, column] = min(mask[row, column], value)
