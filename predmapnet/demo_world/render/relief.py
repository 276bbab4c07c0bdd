"""Rays that meet ground with slopes, and things that such ground hides.

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
BLOCK = 4
"""Pixels between the rays that sound the depth of the ground before all others."""
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
def meet_ground(relief: Relief, start: Float, stand: Vector, ray: Vector, least: float, most: float) -> Vector:
    """Return after how many times ``ray`` from ``start`` the ground is met first, and its slopes there.

    ``stand`` is the :func:`stand_of` the start, which lies above the ground. It is known that the ground is not met
    before ``least``; the way is infinite where it is beyond ``most``.
    """
    level = ray[0] * ray[0] + ray[1] * ray[1]
    bend = relief.bend * level
    most = min(most, SIGHT / np.sqrt(level + 1e-12))
    above, east, north = stand
    travelled = 0.0
    if least > 0:
        height, east, north = ground_height(relief, start[0] + least * ray[0], start[1] + least * ray[1])
        above, travelled = start[2] + least * ray[2] - height, least
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
    """The place where the ray of a pixel meets the ground.

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
def footing(relief: Relief | None, view: View, stand: Vector, ray: Vector, near: Footing, least: float) -> Footing:
    """Return where the ray of a pixel first meets the ground.

    ``near`` is that of a pixel beside it, and the ground is known not to be met before the depth ``least``.
    """
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
    if least == np.inf:
        return Footing(least, near.east, near.north, near.base)
    depth, east, north = meet_ground(relief, position, stand, ray, least, np.inf)
    if depth == np.inf:
        return Footing(depth, near.east, near.north, near.base)
    x, y = position[0] + depth * ray[0], position[1] + depth * ray[1]
    return Footing(depth, east, north, position[2] + depth * ray[2] - east * x - north * y)


@part
def facing_of(relief: Relief | None, view: View, ray: Vector, foot: Footing) -> tuple[float, float, float, float]:
    """Measure how a ray and a pixel's sides approach the ground.

    Returns rates of the height above its plane: along the ray (negative), per unit to the right and down in the image
    plane; and the cosine of the plane's tilt.
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
def mirrored_ray(relief: Relief | None, ray: Vector, along: float, foot: Footing, ripple: float) -> Vector:
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
    return float(z - relief.feet[owner])


@part
def _hidden(relief: Relief, view: View, stand: Vector, ray: Vector, depth: float, least: float) -> bool:
    """Whether the ground hides the point at ``depth`` along a ray; it is not met before the depth ``least``."""
    level = ray[0] * ray[0] + ray[1] * ray[1]
    sag = 0.5 * relief.bend * level * depth * depth
    x, y = view.position[0] + depth * ray[0], view.position[1] + depth * ray[1]
    above = view.position[2] + depth * ray[2] - ground_height(relief, x, y)[0]
    if above < -_SUNK:
        return True
    # A height that sags by ``s * (l - s) * bend / 2`` between two ends stays positive under this condition.
    if np.sqrt(stand[0]) + np.sqrt(max(above, 0.0)) > np.sqrt(sag):
        return False
    # What touches the ground is met there, too: only ground well before it hides it.
    most = 0.99 * depth - 0.02
    return least < most and meet_ground(relief, view.position, stand, ray, least, most)[0] < most


@kernel
def sound_ground(relief: Relief, view: View, ground: Float32) -> None:
    """Note depths of the ground at the corners of blocks of :data:`BLOCK` by :data:`BLOCK` pixels.

    ``ground (rows + 1, columns + 1)`` receives 0.97 of it: no ground above a corner is nearer than that.
    """
    stand = stand_of(relief, view.position)
    foot = first_guess(view, stand)
    for row in range(ground.shape[0] - 1, -1, -1):
        for column in range(ground.shape[1]):
            least = 0.0
            if row + 1 < ground.shape[0]:
                least = float(min(ground[row + 1, max(column - 1, 0)], ground[row + 1, column]))
                least = min(least, float(ground[row + 1, min(column + 1, ground.shape[1] - 1)]))
            foot = footing(relief, view, stand, pixel_ray(view, BLOCK * column, BLOCK * row), foot, least)
            ground[row, column] = 0.97 * foot.depth


@part
def least_depth(relief: Relief | None, ground: Float32, row: int, column: int) -> float:
    """A depth before which the ray of a pixel does not meet the ground; see :func:`sound_ground`."""
    if relief is None:
        return 0.0
    row, column = row // BLOCK + 1, column // BLOCK
    return float(min(ground[row, column], ground[row, column + 1]))


@kernel
def hide_behind_ground(
    relief: Relief, view: View, samples: int, ground: Float32, nearness: Float32, ids: Integer32
) -> None:
    """Take out of a z-buffer what lies in the ground or behind it.

    See :func:`sound_ground` and :func:`.raster.draw_faces`.
    """
    stand = stand_of(relief, view.position)
    rows, columns = nearness.shape
    side = BLOCK * samples
    for block_row in range(ground.shape[0] - 1):
        for block in range(ground.shape[1] - 1):
            least = float(min(ground[block_row + 1, block], ground[block_row + 1, block + 1]))
            if least == np.inf:
                continue
            far = np.float32(1.0 / least)
            bottom, right = min(rows, (block_row + 1) * side), min(columns, (block + 1) * side)
            doubtful = 0
            for row in range(block_row * side, bottom):
                for column in range(block * side, right):
                    near = nearness[row, column]
                    doubtful += int(near > 0) & int(near < far)
            if doubtful == 0:
                continue
            for row in range(block_row * side, bottom):
                for column in range(block * side, right):
                    near = nearness[row, column]
                    if near >= far or near <= 0:
                        continue
                    ray = pixel_ray(view, (column + 0.5) / samples, (row + 0.5) / samples)
                    if _hidden(relief, view, stand, ray, 1.0 / near, least):
                        nearness[row, column] = 0.0
                        ids[row, column] = -1


@kernel
def meet_along(relief: Relief, start: Float, rays: Float, distance: Float) -> None:
    """Shorten ``distance (n,)``, lengths of ``rays (n, 3)`` from ``start (3,)``, to where each meets the ground."""
    stand = stand_of(relief, start)
    for index in range(len(rays)):
        ray = (rays[index, 0], rays[index, 1], rays[index, 2])
        distance[index] = min(distance[index], meet_ground(relief, start, stand, ray, 0.0, distance[index])[0])
