"""Where rays meet ground with slopes, and what that ground hides.

Along a ray, the height above the ground bends by at most ``bend`` per metre squared. From where it is now and how it
changes there, that bounds how early it can reach zero: a stride to that place never steps over a crest, and strides
become Newton's near the ground.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from mapfusion.arrays import Float, Float32, Integer32
from predmapnet.demo_world.render.jit import kernel, part
from predmapnet.demo_world.render.raster import Vector, View, pixel_ray
from predmapnet.demo_world.terrain import Terrain

SIGHT = 2000.0
"""Metres, seen from above, beyond which a ray that has met no ground sees the sky."""
_STRIDES = 200
_SUNK = 0.01
"""Metres that things may stand in the ground without being cut: wheels touch a plane, the ground is none."""


class Relief(NamedTuple):
    """A :class:`~predmapnet.demo_world.terrain.Terrain` as plain numbers.

    Attributes:
        coefficients: ``(n, n) float32``.
        per_metre: cells per metre.
        bend, top: bounds of its second derivative and of its height.
        feet: ``(solids,) float64``, height of the ground below the middle of each solid.
    """

    coefficients: Float32
    per_metre: float
    bend: float
    top: float
    feet: Float


def relief_of(terrain: Terrain, centres: Float) -> Relief:
    """Return a terrain as plain numbers, with the feet of solids whose middles are ``(n, 2+)``."""
    feet = terrain.heights(centres[:, :2])
    return Relief(terrain.coefficients, 1 / terrain.cell, terrain.bend, terrain.top, feet)


@part
def ground_height(relief: Relief, x: float, y: float) -> Vector:
    """Height of the ground and its slopes towards x and y."""
    mask = relief.coefficients.shape[0] - 1
    x, y = x * relief.per_metre, y * relief.per_metre
    column, row = int(np.floor(x)), int(np.floor(y))
    u, v = x - column, y - row
    x0, x1, x2 = 0.5 * (1 - u) * (1 - u), 0.5 + u * (1 - u), 0.5 * u * u
    y0, y1, y2 = 0.5 * (1 - v) * (1 - v), 0.5 + v * (1 - v), 0.5 * v * v
    left, middle, right = (column - 1) & mask, column & mask, (column + 1) & mask
    height = east = north = 0.0
    for index in range(3):
        line = (row + index - 1) & mask
        a = float(relief.coefficients[line, left])
        b = float(relief.coefficients[line, middle])
        c = float(relief.coefficients[line, right])
        here = x0 * a + x1 * b + x2 * c
        weight = y0 if index == 0 else (y1 if index == 1 else y2)
        height += weight * here
        east += weight * ((u - 1) * a + (1 - 2 * u) * b + u * c)
        north += ((v - 1) if index == 0 else ((1 - 2 * v) if index == 1 else v)) * here
    return height, east * relief.per_metre, north * relief.per_metre


@part
def stand_of(relief: Relief | None, start: Float) -> Vector:
    """Height of a place ``(3,)`` above the ground, and the slopes of the ground below it."""
    if relief is None:
        return 0.0, 0.0, 0.0
    height, east, north = ground_height(relief, start[0], start[1])
    return start[2] - height, east, north


@part
def meet_ground(relief: Relief, start: Float, stand: Vector, ray: Vector, most: float) -> Vector:
    """How many times ``ray`` from ``start`` leads to the ground first, and the ground's slopes there.

    ``stand`` is the :func:`stand_of` the start, which lies above the ground; infinite where the way is beyond ``most``.
    """
    level = ray[0] * ray[0] + ray[1] * ray[1]
    bend = relief.bend * level
    most = min(most, SIGHT / np.sqrt(level + 1e-12))
    above, east, north = stand
    travelled = 0.0
    for _ in range(_STRIDES):
        climb = ray[2] - east * ray[0] - north * ray[1]
        if above <= 1e-6:
            break
        if climb < 0 and _newton_is_near(bend, above, climb, travelled):
            travelled -= above / climb
            break
        travelled += 2 * above / max(np.sqrt(climb * climb + 2 * bend * above) - climb, 1e-9)
        z = start[2] + travelled * ray[2]
        if travelled > most or (ray[2] >= 0 and z > relief.top):
            return np.inf, 0.0, 0.0
        height, east, north = ground_height(relief, start[0] + travelled * ray[0], start[1] + travelled * ray[1])
        above = z - height
    return (travelled if travelled <= most else np.inf), east, north


@part
def _newton_is_near(bend: float, above: float, climb: float, travelled: float) -> bool:
    """Whether Newton's step, which misses by ``bend / 2 * above ** 2 / climb ** 3`` at most, is good enough."""
    return bend * above * above < -(2e-3 + 1e-4 * travelled) * climb * climb * climb


class Footing(NamedTuple):
    """Where the ray of a pixel meets the ground.

    Attributes:
        depth: along the optical axis; infinite where it meets none.
        east, north: slopes of the ground there.
        base: height at (0, 0) of the plane that touches the ground there: the next pixel's guess.
    """

    depth: float
    east: float
    north: float
    base: float


@part
def first_guess(view: View, stand: Vector) -> Footing:
    """The plane that touches the ground below the camera."""
    above, east, north = stand
    base = view.position[2] - above - east * view.position[0] - north * view.position[1]
    return Footing(np.inf, east, north, base)


@part
def footing(relief: Relief | None, view: View, stand: Vector, ray: Vector, near: Footing) -> Footing:
    """Return where the ray of a pixel first meets the ground; ``near`` is that of a pixel beside it."""
    if relief is None:
        return Footing(-view.position[2] / ray[2] if ray[2] < -1e-5 else np.inf, 0.0, 0.0, 0.0)
    position = view.position
    level = ray[0] * ray[0] + ray[1] * ray[1]
    above, east, north = stand[0], near.east, near.north
    depth = near.base + east * position[0] + north * position[1] - position[2]
    depth /= min(ray[2] - east * ray[0] - north * ray[1], -1e-6)
    x, y = position[0] + depth * ray[0], position[1] + depth * ray[1]
    # No crest fits between a place as near as that and the camera: any meeting there is the first one.
    if depth > 0 and relief.bend * level * depth * depth < 1.9 * above:
        height, east, north = ground_height(relief, x, y)
        above, climb = position[2] + depth * ray[2] - height, ray[2] - east * ray[0] - north * ray[1]
        if climb < 0 and _newton_is_near(relief.bend * level, above, climb, depth):
            return Footing(depth - above / climb, east, north, height - east * x - north * y)
    depth, east, north = meet_ground(relief, position, stand, ray, np.inf)
    if depth == np.inf:
        return Footing(depth, near.east, near.north, near.base)
    x, y = position[0] + depth * ray[0], position[1] + depth * ray[1]
    return Footing(depth, east, north, position[2] + depth * ray[2] - east * x - north * y)


@part
def facing_of(relief: Relief | None, view: View, ray: Vector, foot: Footing) -> tuple[float, float, float, float]:
    """How a ray and a pixel's sides approach the ground: rates of height above its plane, and the plane's cosine.

    Returns the rate along the ray (negative), per unit to the right and down in the image plane, and the cosine of the
    plane's tilt.
    """
    rotation = view.rotation
    if relief is None:
        return ray[2], rotation[2, 0], rotation[2, 1], 1.0
    east, north = foot.east, foot.north
    # A ray that grazes a crest would smear without end.
    along = min(ray[2] - east * ray[0] - north * ray[1], -1e-3)
    right = rotation[2, 0] - east * rotation[0, 0] - north * rotation[1, 0]
    down = rotation[2, 1] - east * rotation[0, 1] - north * rotation[1, 1]
    return along, right, down, 1 / np.sqrt(1 + east * east + north * north)


@part
def mirrored(relief: Relief | None, ray: Vector, along: float, foot: Footing, ripple: float) -> Vector:
    """A ray mirrored in the ground, of which it leaves ``ripple`` times as fast as it came (1 for still water)."""
    if relief is None:
        return ray[0], ray[1], -ray[2] * ripple
    east, north = foot.east, foot.north
    push = -(1 + ripple) * along / (1 + east * east + north * north)
    return ray[0] - push * east, ray[1] - push * north, ray[2] + push


@part
def height_over_foot(relief: Relief | None, owner: int, z: float) -> float:
    """Height of a place on a solid above the ground at the solid's middle."""
    if relief is None:
        return z
    return z - relief.feet[owner]


@part
def _seen(
    relief: Relief, view: View, stand: Vector, slack: float, ray: Vector, depth: float
) -> int:
    """1 if nothing hides the point at ``depth`` along a ray for sure, -1 if it lies in the ground, 0 if unknown.

    ``slack`` is how much lower, per metre of depth, a point of the same pixel may lie.
    """
    level = ray[0] * ray[0] + ray[1] * ray[1]
    sag = 0.5 * relief.bend * level * depth * depth
    eye, east, north = stand
    if eye + depth * (ray[2] - east * ray[0] - north * ray[1] - slack) > sag:
        return 1
    x, y = view.position[0] + depth * ray[0], view.position[1] + depth * ray[1]
    above = view.position[2] + depth * ray[2] - ground_height(relief, x, y)[0]
    if above < -_SUNK:
        return -1
    # A height that sags by ``s * (l - s) * bend / 2`` between two ends stays positive under this condition.
    above -= slack * depth
    return 1 if above > 0 and np.sqrt(eye) + np.sqrt(above) > np.sqrt(sag) else 0


@kernel
def hide_behind_ground(relief: Relief, view: View, samples: int, nearness: Float32, ids: Integer32) -> None:
    """Take out of a z-buffer what lies in the ground or behind it; see :func:`.raster.draw_faces`."""
    stand = stand_of(relief, view.position)
    for row in range(view.height):
        for column in range(view.width):
            first = ids[row * samples, column * samples]
            same = True
            for i in range(samples):
                for j in range(samples):
                    same &= ids[row * samples + i, column * samples + j] == first
            if same and first < 0:
                continue
            if same:
                depth = 1.0 / nearness[row * samples, column * samples]
                ray = pixel_ray(view, column + 0.5, row + 0.5)
                if _seen(relief, view, stand, 1.0 / view.focal_y, ray, depth) == 1:
                    continue
            for i in range(samples):
                for j in range(samples):
                    if ids[row * samples + i, column * samples + j] < 0:
                        continue
                    depth = 1.0 / nearness[row * samples + i, column * samples + j]
                    ray = pixel_ray(view, column + (j + 0.5) / samples, row + (i + 0.5) / samples)
                    seen = _seen(relief, view, stand, 0.0, ray, depth)
                    if seen == 0:
                        # What touches the ground is met there, too: only ground well before it hides it.
                        most = 0.99 * depth - 0.02
                        seen = -1 if meet_ground(relief, view.position, stand, ray, most)[0] < most else 1
                    if seen < 0:
                        nearness[row * samples + i, column * samples + j] = 0.0
                        ids[row * samples + i, column * samples + j] = -1


@kernel
def meet_along(relief: Relief, start: Float, rays: Float, distance: Float) -> None:
    """Shorten the ``distance (n,)`` along ``rays (n, 3)`` from ``start (3,)`` to where each meets the ground before."""
    stand = stand_of(relief, start)
    for index in range(len(rays)):
        ray = (rays[index, 0], rays[index, 1], rays[index, 2])
        distance[index] = min(distance[index], meet_ground(relief, start, stand, ray, distance[index])[0])
