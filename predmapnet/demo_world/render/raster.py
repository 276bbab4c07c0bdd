"""The z-buffer: which face covers which sample of the image, at what depth.

Samples form a grid of ``supersampling`` by ``supersampling`` per pixel. ``1 / depth`` is linear over a flat face, so a
face is one plane per camera, and depth is exact wherever it is evaluated.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from mapfusion.arrays import Float, Float32, Integer, Integer32
from predmapnet.demo_world.render.jit import kernel, part

Vector = tuple[float, float, float]

NEAR = 0.12
"""Metres before the camera where faces are cut."""


class ZBuffer(NamedTuple):
    """Faces in sight of a camera.

    Attributes:
        nearness: ``(samples * height, samples * width) float32``, ``1 / depth``; 0 where there is no solid.
        ids: the same shape, ``int32``: face, or number of faces plus ellipsoid; -1 where there is no solid.
        planes: ``(f, 3) float64``, the :func:`face_plane` of each face that was drawn; others are not filled in.
        ground: ``float32``, soundings of ground with slopes (:func:`.relief.sound_ground`); ``(0, 0)`` if it is flat.
    """

    nearness: Float32
    ids: Integer32
    planes: Float
    ground: Float32


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


@part
def pixel_ray(view: View, x: float, y: float) -> Vector:
    """Direction through pixel position (x, y), global frame, its component along the optical axis being 1."""
    across, down = (x - view.centre_x) / view.focal_x, (y - view.centre_y) / view.focal_y
    rotation = view.rotation
    return (
        rotation[0, 0] * across + rotation[0, 1] * down + rotation[0, 2],
        rotation[1, 0] * across + rotation[1, 1] * down + rotation[1, 2],
        rotation[2, 0] * across + rotation[2, 1] * down + rotation[2, 2],
    )


@part
def face_plane(corners: Float, normals: Float, face: int, view: View) -> Vector:
    """Coefficients of ``1 / depth = p0 * x + p1 * y + p2`` over a face, pixels."""
    rotation, position = view.rotation, view.position
    nx, ny, nz = normals[face, 0], normals[face, 1], normals[face, 2]
    distance = nx * (corners[face, 0, 0] - position[0])
    distance += ny * (corners[face, 0, 1] - position[1]) + nz * (corners[face, 0, 2] - position[2])
    if abs(distance) < 1e-9:
        distance = -1e-9
    along = (nx * rotation[0, 0] + ny * rotation[1, 0] + nz * rotation[2, 0]) / distance / view.focal_x
    down = (nx * rotation[0, 1] + ny * rotation[1, 1] + nz * rotation[2, 1]) / distance / view.focal_y
    constant = (nx * rotation[0, 2] + ny * rotation[1, 2] + nz * rotation[2, 2]) / distance
    return along, down, constant - along * view.centre_x - down * view.centre_y


@kernel
def _project_clipped(corners: Float, count: int, view: View, scratch: Float) -> int:
    """Cut a face at the near plane and project it into rows 8 to 17 of ``scratch`` (18, 3); returns how many."""
    local, screen = scratch[:8], scratch[8:]
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


@part
def _span(screen: Float, count: int, y: float, columns: int) -> tuple[int, int]:
    """First column whose centre lies inside a convex outline at height ``y``, and the one past the last."""
    low, high = 1e30, -1e30
    for index in range(count):
        following = index + 1 if index + 1 < count else 0
        y0, y1 = screen[index, 1], screen[following, 1]
        if (y0 <= y) != (y1 <= y):
            x = screen[index, 0] + (y - y0) / (y1 - y0) * (screen[following, 0] - screen[index, 0])
            low, high = min(low, x), max(high, x)
    if high < low:
        return 0, 0
    first = max(0, int(np.ceil(max(low, -1.0) - 0.5)))
    return first, min(columns, int(np.ceil(min(high, columns + 1.0) - 0.5)))


@part
def _rows_of(screen: Float, count: int, rows: int) -> tuple[int, int]:
    """First row whose centre lies inside an outline, and the one past the last."""
    top, bottom = 1e30, -1e30
    for index in range(count):
        top, bottom = min(top, screen[index, 1]), max(bottom, screen[index, 1])
    first = max(0, int(np.ceil(max(top, -1.0) - 0.5)))
    return first, min(rows, int(np.ceil(min(bottom, rows + 1.0) - 0.5)))


@kernel
def draw_faces(
    corners: Float, counts: Integer, normals: Float, view: View, samples: int, scratch: Float, nearness: Float32,
    ids: Integer32, planes: Float,
) -> None:  # fmt: skip
    """Draw all faces of a mesh into a z-buffer ``(samples * height, samples * width)``.

    Of each sample ``nearness`` keeps the largest ``1 / depth`` and ``ids`` the face that has it, -1 for none;
    ``scratch (18, 3)`` is overwritten, and ``planes (f, 3)`` receives the :func:`face_plane` of faces that are drawn.
    """
    screen = scratch[8:]
    rows, columns = nearness.shape
    for face in range(len(counts)):
        facing = 0.0
        for axis in range(3):
            facing += normals[face, axis] * (corners[face, 0, axis] - view.position[axis])
        if facing >= 0:
            continue
        count = _project_clipped(corners[face], counts[face], view, scratch)
        if count < 3:
            continue
        left, right = 1e30, -1e30
        for index in range(count):
            screen[index, 0] *= samples
            screen[index, 1] *= samples
            left, right = min(left, screen[index, 0]), max(right, screen[index, 0])
        if right < 0 or left > columns:
            continue
        plane = face_plane(corners, normals, face, view)
        planes[face, 0], planes[face, 1], planes[face, 2] = plane
        top, bottom = _rows_of(screen, count, rows)
        slope = plane[0] / samples
        for row in range(top, bottom):
            first, last = _span(screen, count, row + 0.5, columns)
            constant = plane[1] * (row + 0.5) / samples + plane[2]
            for column in range(first, last):
                value = np.float32(slope * (column + 0.5) + constant)
                if value > nearness[row, column]:
                    nearness[row, column] = value
                    ids[row, column] = face


@part
def _ball_space(balls: Float, index: int, x: float, y: float, z: float) -> Vector:
    """A vector of the global frame, in units of an ellipsoid's half axes."""
    cosine, sine = balls[index, 6], balls[index, 7]
    u, v = (cosine * x + sine * y) / balls[index, 3], (cosine * y - sine * x) / balls[index, 4]
    return u, v, z / balls[index, 5]


@part
def ball_depth(balls: Float, index: int, view: View, px: float, py: float) -> float:
    """Depth along the optical axis where the ray of pixel position (px, py) meets an ellipsoid, or -1."""
    ray = pixel_ray(view, px, py)
    du, dv, dw = _ball_space(balls, index, ray[0], ray[1], ray[2])
    x, y, z = (
        view.position[0] - balls[index, 0], view.position[1] - balls[index, 1], view.position[2] - balls[index, 2],
    )  # fmt: skip
    su, sv, sw = _ball_space(balls, index, x, y, z)
    square, half = du * du + dv * dv + dw * dw, du * su + dv * sv + dw * sw
    inside = half * half - square * (su * su + sv * sv + sw * sw - 1)
    if inside < 0:
        return -1.0
    return float((-half - np.sqrt(inside)) / square)


@kernel
def draw_balls(
    balls: Float, leafy: Integer, order: Integer, first_id: int, view: View, samples: int, noise: Float32,
    nearness: Float32, ids: Integer32,
) -> None:  # fmt: skip
    """Draw ellipsoids ``(b, 8)``, the first of id ``first_id``; ``leafy (b,)`` ones have a ragged outline with gaps.

    ``order`` is that of drawing, quickest where near ones come first; ``noise`` is a tile in [0, 1]; the rest is as in
    :func:`draw_faces`.
    """
    rows, columns = nearness.shape
    position, rotation = view.position, view.rotation
    for index in order:
        radius = max(balls[index, 3], max(balls[index, 4], balls[index, 5]))
        x, y, z = position[0] - balls[index, 0], position[1] - balls[index, 1], position[2] - balls[index, 2]
        depth = -(x * rotation[0, 2] + y * rotation[1, 2] + z * rotation[2, 2])
        su, sv, sw = _ball_space(balls, index, x, y, z)
        outside = su * su + sv * sv + sw * sw - 1
        if depth < -radius or outside < 0.02:
            continue
        top, bottom, nearest = 0, rows, np.float32(1e30)
        if depth > 1.5 * radius:
            # The sphere around the ellipsoid, seen from outside: a bound that is never too small.
            down = -(x * rotation[0, 1] + y * rotation[1, 1] + z * rotation[2, 1])
            across = -(x * rotation[0, 0] + y * rotation[1, 0] + z * rotation[2, 0])
            reach = radius * (1 + (abs(across) + abs(down)) / depth) / (depth - radius)
            middle, aside = down / depth * view.focal_y + view.centre_y, across / depth * view.focal_x + view.centre_x
            if abs(aside - 0.5 * view.width) > 0.5 * view.width + reach * view.focal_x:
                continue
            reach *= view.focal_y
            top, bottom = max(0, int((middle - reach) * samples)), min(rows, int((middle + reach) * samples) + 1)
            nearest = np.float32(1.0001 / (depth - radius))
        gx, gy, gz = rotation[0, 0] / view.focal_x, rotation[1, 0] / view.focal_x, rotation[2, 0] / view.focal_x
        eu, ev, ew = _ball_space(balls, index, gx, gy, gz)
        eu, ev, ew = eu / samples, ev / samples, ew / samples
        for row in range(top, bottom):
            ray = pixel_ray(view, 0.5 / samples, (row + 0.5) / samples)
            du, dv, dw = _ball_space(balls, index, ray[0], ray[1], ray[2])
            # Along a row, the discriminant of the ray's equation is a parabola over the columns: solve for its span.
            a0, a1, a2 = du * du + dv * dv + dw * dw, du * eu + dv * ev + dw * ew, eu * eu + ev * ev + ew * ew
            b0, b1 = du * su + dv * sv + dw * sw, eu * su + ev * sv + ew * sw
            p0, p1, p2 = b0 * b0 - a0 * outside, b0 * b1 - a1 * outside, b1 * b1 - a2 * outside
            root = p1 * p1 - p0 * p2
            if root <= 0:
                continue
            root = np.sqrt(root)
            first, last = 0, columns
            if p2 < 0:
                first = max(0, int(np.ceil(max((-p1 + root) / p2, -1.0))))
                last = min(columns, int(np.floor(min((-p1 - root) / p2, columns + 1.0))) + 1)
            for column in range(first, last):
                before = nearness[row, column]
                if before > nearest:
                    continue
                square, half = a0 + column * (2 * a1 + column * a2), b0 + column * b1
                inside = half * half - square * outside
                if inside < 0:
                    continue
                inside = np.sqrt(inside)
                hit = (-half - inside) / square
                if hit <= NEAR or hit * before >= 1:
                    continue
                if leafy[index] == 1:
                    step = column / samples
                    px, py, pz = (
                        x + hit * (ray[0] + step * gx),
                        y + hit * (ray[1] + step * gy),
                        z + hit * (ray[2] + step * gz),
                    )
                    # sqrt(inside) / square is half the way through the crown, in rays: leaves are sparse at the rim.
                    thickness = inside / np.sqrt(square)
                    if abs(pz) > 0.6 * radius:
                        u, v = int(np.floor(px * 8)) & 1023, int(np.floor(py * 8)) & 1023
                    elif abs(px) > abs(py):
                        u, v = int(np.floor(py * 8)) & 1023, int(np.floor(pz * 8)) & 1023
                    else:
                        u, v = int(np.floor(px * 8)) & 1023, int(np.floor(pz * 8)) & 1023
                    if noise[v, u] > 0.25 + 1.1 * thickness:
                        continue
                nearness[row, column] = np.float32(1 / hit)
                ids[row, column] = first_id + index


@kernel
def draw_mask(corners: Float, counts: Integer, view: View, value: int, scratch: Float, mask: NDArray[np.uint8]) -> None:
    """Mark the pixels of flat polygons (shadows of what moves) in a mask ``(height, width)``."""
    screen = scratch[8:]
    rows, columns = mask.shape
    for face in range(len(counts)):
        count = _project_clipped(corners[face], counts[face], view, scratch)
        if count < 3:
            continue
        top, bottom = _rows_of(screen, count, rows)
        for row in range(top, bottom):
            first, last = _span(screen, count, row + 0.5, columns)
            for column in range(first, last):
                mask[row, column] = min(mask[row, column], value)
