"""Light on the ground: what is the same for all pixels of an image, and the colour of the ground that one sees."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from mapfusion.arrays import Float, Float32
from predmapnet.demo_world.render.ground_texture import Pyramid
from predmapnet.demo_world.render.jit import part
from predmapnet.demo_world.render.kerbs import (
    FACE,
    REACH,
    ROAD,
    Kerbs,
    clearance,
    in_kerb_shadow,
    meet_step,
    out_of_face,
)
from predmapnet.demo_world.render.raster import Vector, View, pixel_ray
from predmapnet.demo_world.render.relief import Footing, Relief, facing_of
from predmapnet.demo_world.render.shading import Colour, headlight, lamp_light, read_ground
from predmapnet.demo_world.street.looks import Light

_NEAR_KERB = 1.5
"""Metres from a kerb within which it darkens the road."""
_FRINGE = 0.075
"""Metres from a kerb within which the texture is read further away from it."""


class Surroundings(NamedTuple):
    """All that is the same for every pixel of an image.

    Attributes:
        fine, coarse: the ground.
        light: light of the scene.
        white, fractal, clouds: noise tiles.
        lamps: ``(rows, columns) float32``, light of street lamps on the ground, one cell per metre.
        lamps_origin: of the lamps' cell (0, 0), metres.
        global_to_ego: ``(4, 4) float64``.
        sunlit: ``(solids,) float32``, share of the sun that reaches the foot of each solid.
        styles: ``(solids, 6) float64``, of facades.
    """

    fine: Pyramid
    coarse: Pyramid
    light: Light
    white: Float32
    fractal: Float32
    clouds: Float32
    lamps: Float32
    lamps_origin: tuple[float, float]
    global_to_ego: Float
    sunlit: Float32
    styles: Float


@part
def hazy(light: Light, colour: Colour, distance: float) -> Colour:
    """Radiance that is left of a colour after metres of haze."""
    clear = np.exp(-light.haze * distance)
    return (
        colour[0] * clear + (1 - clear) * light.horizon[0],
        colour[1] * clear + (1 - clear) * light.horizon[1],
        colour[2] * clear + (1 - clear) * light.horizon[2],
    )


@part
def light_at(
    around: Surroundings, x: float, y: float, z: float, height: float, sun: float, ambient: float, facing: float
) -> Colour:
    """Irradiance from the sun, the sky, headlights (``facing``: cosine towards the car) and lamps.

    ``height`` is that above the ground.
    """
    light = around.light
    lamps = 0.0
    if light.lamps > 0:
        lamps = light.lamps * lamp_light(around.lamps, around.lamps_origin, x, y)
    beam = 0.0
    if light.headlights > 0:
        beam = headlight(light, around.global_to_ego, x, y, z, height) * facing
    return (
        light.sun[0] * sun + light.ambient[0] * ambient + beam + 1.0 * lamps,
        light.sun[1] * sun + light.ambient[1] * ambient + 0.96 * beam + 0.72 * lamps,
        light.sun[2] * sun + light.ambient[2] * ambient + 0.88 * beam + 0.42 * lamps,
    )


@part
def ground_colour(
    around: Surroundings, relief: Relief | None, view: View, ray: Vector, foot: Footing, dynamic: float, most: int
) -> Colour:
    """Radiance of the ground that a pixel sees along ``ray`` (camera depth 1) at ``foot``."""
    rotation, light, depth = view.rotation, around.light, foot.depth
    x, y = view.position[0] + depth * ray[0], view.position[1] + depth * ray[1]
    along, right, down, upright = facing_of(relief, view, ray, foot)
    tilt_u, tilt_v = right / view.focal_x / along, down / view.focal_y / along
    ux = depth * (rotation[0, 0] / view.focal_x - ray[0] * tilt_u)
    uy = depth * (rotation[1, 0] / view.focal_x - ray[1] * tilt_u)
    vx = depth * (rotation[0, 1] / view.focal_y - ray[0] * tilt_v)
    vy = depth * (rotation[1, 1] / view.focal_y - ray[1] * tilt_v)
    red, green, blue, shade = read_ground(around.fine, around.coarse, around.white, x, y, ux, uy, vx, vy, most)
    distance = depth * np.sqrt(ray[0] * ray[0] + ray[1] * ray[1] + ray[2] * ray[2])
    sun, z, eye = light.sun_direction[2], 0.0, view.position[2]
    if relief is not None:
        sun = max(0.0, sun - foot.east * light.sun_direction[0] - foot.north * light.sun_direction[1]) * upright
        z, eye = view.position[2] + depth * ray[2], -depth * along * upright
    sun *= shade * (1.0 if dynamic > 0.99 else dynamic)
    facing = min(1.0, 0.25 + 3.0 * eye / distance)
    lit = light_at(around, x, y, z, 0.0, sun, (0.75 + 0.25 * shade) * (0.25 + 0.75 * dynamic), facing)
    return hazy(light, (red * lit[0], green * lit[1], blue * lit[2]), distance)


@part
def sort_ground(
    kerbs: Kerbs, relief: Relief | None, view: View, x: float, y: float, foot: Footing, kinds: Float
) -> float:
    """Sort what a pixel, whose middle is (x, y), sees of the ground by its kinds: road, raised ground, faces of kerbs.

    ``foot`` is where its ray meets the plane of the road. ``kinds (3, 5+)`` receives for each kind the share of the
    pixel, the mean position (x, y), how far before the plane of the road the ray met it, as a depth, and a distance
    within which no edge lies. The depth of the pixel's middle is returned.
    """
    for kind in range(3):
        for column in range(5):
            kinds[kind, column] = 0.0
    ray = pixel_ray(view, x, y)
    along, _, down, _ = facing_of(relief, view, ray, foot)
    along = min(along, -1e-3)
    ahead = np.sqrt(ray[0] * ray[0] + ray[1] * ray[1])
    reach = 0.5 * foot.depth * (abs(ahead * down / view.focal_y / along) + 1 / view.focal_x)
    least = max(0.01, 0.2 * reach)
    place_x, place_y = view.position[0] + foot.depth * ray[0], view.position[1] + foot.depth * ray[1]
    middle, kind, clear = meet_step(kerbs, place_x, place_y, ray[0], ray[1], -along, 0.5 * foot.depth, least)
    if clear > reach:
        kinds[kind, 0], kinds[kind, 1], kinds[kind, 2], kinds[kind, 3], kinds[kind, 4] = 1.0, x, y, middle, clear
        return middle
    for index in range(4):
        # A turned grid: no two of its places share a row or a column.
        here_x = x + (index - 1.5) / 4
        here_y = y + (2 * (index & 1) - 1 + (0.5 if index < 2 else -0.5)) / 4
        ray = pixel_ray(view, here_x, here_y)
        depth, fall = plane_depth(relief, view, foot, ray)
        place_x, place_y = view.position[0] + depth * ray[0], view.position[1] + depth * ray[1]
        back, kind, _ = meet_step(kerbs, place_x, place_y, ray[0], ray[1], fall, 0.5 * depth, least)
        kinds[kind, 0] += 0.25
        kinds[kind, 1] += 0.25 * here_x
        kinds[kind, 2] += 0.25 * here_y
        kinds[kind, 3] += 0.25 * back
    for kind in range(3):
        if kinds[kind, 0] > 0:
            for column in range(1, 4):
                kinds[kind, column] /= kinds[kind, 0]
    return middle


@part
def plane_depth(relief: Relief | None, view: View, foot: Footing, ray: Vector) -> tuple[float, float]:
    """Depth at which a ray meets the plane that touches the ground at ``foot``, and how fast it approaches it."""
    position = view.position
    if relief is None:
        fall = max(-ray[2], 1e-3)
        return position[2] / fall, fall
    fall = max(foot.east * ray[0] + foot.north * ray[1] - ray[2], 1e-3)
    height = position[2] - foot.base - foot.east * position[0] - foot.north * position[1]
    return max(height, 0.0) / fall, fall


@part
def ground_met(relief: Relief | None, view: View, foot: Footing, kind: Float) -> tuple[Footing, Vector]:
    """Footing of a pixel on one kind of the ground that :func:`sort_ground` found, and the ray that leads there."""
    ray = pixel_ray(view, kind[1], kind[2])
    depth = plane_depth(relief, view, foot, ray)[0] - kind[3]
    return Footing(depth, foot.east, foot.north, foot.base), ray


@part
def kerb_colour(
    around: Surroundings, relief: Relief | None, kerbs: Kerbs, view: View, ray: Vector, foot: Footing, dynamic: float,
    most: int, kind: int, clear: float,
) -> Colour:  # fmt: skip
    """Radiance of ground with kerbs, as :func:`ground_colour` has it: of the road, raised ground, or a kerb's face.

    It is known that no edge lies within ``clear`` metres.
    """
    rotation, light, depth = view.rotation, around.light, foot.depth
    x, y, z = view.position[0] + depth * ray[0], view.position[1] + depth * ray[1], view.position[2] + depth * ray[2]
    along, right, down, upright = facing_of(relief, view, ray, foot)
    length = np.sqrt(ray[0] * ray[0] + ray[1] * ray[1] + ray[2] * ray[2])
    direction = light.sun_direction
    facing = min(1.0, 0.25 - 3.0 * along * upright / length)
    sun, ambient = direction[2], 1.0
    if relief is not None:
        sun = max(0.0, sun - foot.east * direction[0] - foot.north * direction[1]) * upright
    if kind == FACE:
        out_x, out_y = out_of_face(kerbs, x, y)
        sun = max(0.0, direction[0] * out_x + direction[1] * out_y)
        facing = max(0.0, -(ray[0] * out_x + ray[1] * out_y) / length)
        # Half of the sky, and light that comes back from the road. The stone of a face is that of its top.
        ambient, x, y = 0.55, x - 0.07 * out_x, y - 0.07 * out_y
        ux = vy = depth / view.focal_x
        uy = vx = 0.0
    else:
        tilt_u, tilt_v = right / view.focal_x / along, down / view.focal_y / along
        ux = depth * (rotation[0, 0] / view.focal_x - ray[0] * tilt_u)
        uy = depth * (rotation[1, 0] / view.focal_x - ray[1] * tilt_u)
        vx = depth * (rotation[0, 1] / view.focal_y - ray[0] * tilt_v)
        vy = depth * (rotation[1, 1] / view.focal_y - ray[1] * tilt_v)
        gap = clearance(kerbs, x, y) if clear < _NEAR_KERB else REACH
        if kind == ROAD and 0 < gap < _NEAR_KERB:
            # A step hides some of the sky from its foot, and the sun where it stands behind the step.
            ambient = 1 - 0.4 * max(0.0, 1 - gap / kerbs.height) ** 2
            sun = 0.0 if in_kerb_shadow(kerbs, x, y, direction, gap) else sun
        if abs(gap) < _FRINGE:
            # The texture's texels mix what lies on both sides of an edge.
            out_x, out_y = out_of_face(kerbs, x, y)
            away = (_FRINGE if kind == ROAD else -_FRINGE) - gap
            x, y = x + away * out_x, y + away * out_y
    red, green, blue, shade = read_ground(around.fine, around.coarse, around.white, x, y, ux, uy, vx, vy, most)
    if kind == FACE:
        red, green, blue = 0.5 * (red + kerbs.tone), 0.5 * (green + 0.98 * kerbs.tone), 0.5 * (blue + 0.93 * kerbs.tone)
    sun *= shade * (1.0 if dynamic > 0.99 else dynamic)
    lit = light_at(around, x, y, z, 0.0, sun, ambient * (0.75 + 0.25 * shade) * (0.25 + 0.75 * dynamic), facing)
    return hazy(light, (red * lit[0], green * lit[1], blue * lit[2]), depth * length)
