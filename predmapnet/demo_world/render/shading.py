"""Shading of a sample: the ground's texture, the sky, walls, cars and leaves, in linear light."""

from __future__ import annotations

from typing import Any, cast

import numpy as np

from mapfusion.arrays import Float, Float32
from predmapnet.demo_world.render.ground_texture import Pyramid
from predmapnet.demo_world.render.jit import part
from predmapnet.demo_world.street.looks import Light

Colour = tuple[float, float, float]
Texel = tuple[float, float, float, float]


@part
def smooth_noise(tile: Float32, x: float, y: float) -> float:
    """Read a noise tile between its texels (bilinear), periodically."""
    column, row = int(np.floor(x)), int(np.floor(y))
    u, v = x - column, y - row
    top = tile[row & 1023, column & 1023] * (1 - u) + tile[row & 1023, (column + 1) & 1023] * u
    low = tile[(row + 1) & 1023, column & 1023] * (1 - u) + tile[(row + 1) & 1023, (column + 1) & 1023] * u
    return float(top * (1 - v) + low * v)


@part
def _read_level(pyramid: Pyramid, level: int, x: float, y: float) -> Texel:
    """Albedo (linear) and shadow at texel position (x, y) of level 0, read bilinearly from ``level``."""
    scale = 1.0 / (1 << level)
    x, y = x * scale - 0.5, y * scale - 0.5
    rows, columns = pyramid.levels[1, level], pyramid.levels[2, level]
    column = min(max(int(np.floor(x)), 0), columns - 2)
    row = min(max(int(np.floor(y)), 0), rows - 2)
    u, v = np.float32(min(max(x - column, 0.0), 1.0)), np.float32(min(max(y - row, 0.0), 1.0))
    one = np.float32(1.0)
    first = pyramid.levels[0, level] + row * columns + column
    below = first + columns
    texels = pyramid.texels
    w00, w01, w10, w11 = (one - u) * (one - v), u * (one - v), (one - u) * v, u * v
    red = green = blue = shade = np.float32(0.0)
    for corner in range(4):
        index = first + corner if corner < 2 else below + corner - 2
        weight = w00 if corner == 0 else (w01 if corner == 1 else (w10 if corner == 2 else w11))
        r, g, b = np.float32(texels[index, 0]), np.float32(texels[index, 1]), np.float32(texels[index, 2])
        red += weight * r * r
        green += weight * g * g
        blue += weight * b * b
        shade += weight * np.float32(texels[index, 3])
    norm = np.float32(1 / 65025.0)
    return float(red * norm), float(green * norm), float(blue * norm), float(shade * np.float32(1 / 255.0))


@part
def _read_sharp(pyramid: Pyramid, x: float, y: float, sharpness: float) -> Texel:
    """As above at level 0, with the edges of paint as crisp as a pixel: coverage is a distance in disguise."""
    rows, columns = pyramid.levels[1, 0], pyramid.levels[2, 0]
    x, y = x - 0.5, y - 0.5
    column = min(max(int(np.floor(x)), 0), columns - 2)
    row = min(max(int(np.floor(y)), 0), rows - 2)
    u, v = min(max(x - column, 0.0), 1.0), min(max(y - row, 0.0), 1.0)
    red = green = blue = shade = coverage = albedo = yellow = 0.0
    for i in range(2):
        for j in range(2):
            weight = (v if i else 1 - v) * (u if j else 1 - u)
            r, g, b = pyramid.base[row + i, column + j, 0], pyramid.base[row + i, column + j, 1], 0.0
            b = pyramid.base[row + i, column + j, 2]
            red += weight * r * float(r)
            green += weight * g * float(g)
            blue += weight * b * float(b)
            shade += weight * pyramid.base[row + i, column + j, 3]
            coverage += weight * pyramid.paint[row + i, column + j, 0]
            albedo += weight * pyramid.paint[row + i, column + j, 1]
            yellow += weight * pyramid.paint[row + i, column + j, 2]
    norm = 1 / 65025.0
    red, green, blue = red * norm, green * norm, blue * norm
    coverage = min(1.0, max(0.0, 0.5 + (coverage / 255.0 - 0.5) * sharpness))
    albedo, yellow = albedo * albedo * norm, yellow / 255.0
    red += coverage * (albedo * (1 - 0.12 * yellow) - red)
    green += coverage * (albedo * (1 - 0.42 * yellow) - green)
    blue += coverage * (albedo * (1 - 0.92 * yellow) - blue)
    return red, green, blue, shade / 255.0


@part
def read_ground(
    fine: Pyramid, coarse: Pyramid, white: Float32, x: float, y: float, ux: float, uy: float, vx: float, vy: float,
    most: int,
) -> Texel:  # fmt: skip
    """Filter the ground over a pixel's footprint: linear albedo and the share of sunlight that arrives.

    Args:
        fine, coarse: textures.
        white: noise tile for grain below the texture's resolution.
        x, y: where the pixel's centre meets the ground, metres.
        ux, uy, vx, vy: how that point moves per pixel to the right and down, metres.
        most: largest number of samples along the footprint's long axis.
    """
    # Axes of the ellipse that the pixel covers: eigenvectors of J J^T (EWA filtering, Heckbert 1989).
    a, b, c = ux * ux + vx * vx, uy * uy + vy * vy, ux * uy + vx * vy
    mean, spread = (a + b) / 2, np.sqrt((a - b) * (a - b) / 4 + c * c)
    major, minor = np.sqrt(mean + spread), np.sqrt(max(mean - spread, 1e-12))
    axis_x, axis_y = c, mean + spread - a
    if abs(a - mean - spread) < 1e-9 * mean or axis_x * axis_x + axis_y * axis_y < 1e-20:
        axis_x, axis_y = (1.0, 0.0) if a >= b else (0.0, 1.0)
    else:
        length = np.sqrt(axis_x * axis_x + axis_y * axis_y)
        axis_x, axis_y = axis_x / length, axis_y / length
    place = fine.placement
    dx, dy = x - place[0], y - place[1]
    u, v = (place[2] * dx + place[3] * dy) * place[4], (place[2] * dy - place[3] * dx) * place[4]
    in_fine = u > 2 and v > 2 and u < fine.levels[2, 0] - 2 and v < fine.levels[1, 0] - 2
    if not in_fine:
        place = coarse.placement
        dx, dy = x - place[0], y - place[1]
        u, v = (place[2] * dx + place[3] * dy) * place[4], (place[2] * dy - place[3] * dx) * place[4]
    per_metre = place[4]
    major *= per_metre
    minor *= per_metre
    if in_fine and major < 1.0:
        sharpness = 1 / max(major, 0.12)
        red, green, blue, shade = _read_sharp(fine, u, v, sharpness)
        grain = white[int(np.floor(y * 110)) & 1023, int(np.floor(x * 110)) & 1023] - 0.5
        grain *= 0.30 * (1 - major)
        return red * (1 + grain), green * (1 + grain), blue * (1 + grain), shade
    count = int(min(float(most), np.ceil(major / max(minor, 1.0))))
    step = major / count
    level = np.log2(max(1.0, max(minor, step)))
    top = fine.levels.shape[1] - 1
    lower = min(int(level), top)
    share = level - lower
    if count < 2:
        count = 2
        step = major / count
    du = (place[2] * axis_x + place[3] * axis_y) * step
    dv = (place[2] * axis_y - place[3] * axis_x) * step
    red = green = blue = shade = 0.0
    for index in range(count):
        # Between two levels, a growing share of the samples reads the upper one.
        chosen = lower + (1 if ((index * 5 + 2) % count + 0.5) / count < share else 0)
        offset = index - (count - 1) / 2
        if in_fine:
            r, g, b, s = _read_level(fine, min(chosen, top), u + offset * du, v + offset * dv)
        else:
            r, g, b, s = _read_level(coarse, min(chosen, top), u + offset * du, v + offset * dv)
        red, green, blue, shade = red + r, green + g, blue + b, shade + s
    return red / count, green / count, blue / count, shade / count


@part
def sky(light: Light, clouds: Float32, x: float, y: float, z: float) -> Colour:
    """Radiance of the sky in a direction (unit vector, global frame)."""
    height = max(z, 0.0)
    blend = np.sqrt(height) * (1.35 - 0.35 * height)
    red = light.horizon[0] + (light.zenith[0] - light.horizon[0]) * blend
    green = light.horizon[1] + (light.zenith[1] - light.horizon[1]) * blend
    blue = light.horizon[2] + (light.zenith[2] - light.horizon[2]) * blend
    scale = 60.0 / (height + 0.12)
    density = 0.65 * smooth_noise(clouds, x * scale, y * scale)
    density += 0.35 * smooth_noise(clouds, x * scale * 3.1 + 91, y * scale * 3.1 + 37)
    cover = min(1.0, max(0.0, (density - (1 - light.cloud_cover)) * 3.0)) * min(1.0, height * 7)
    shaded = 0.8 + 0.25 * density
    red += cover * (light.cloud[0] * shaded - red)
    green += cover * (light.cloud[1] * shaded - green)
    blue += cover * (light.cloud[2] * shaded - blue)
    if light.sun[0] > 0:
        towards = x * light.sun_direction[0] + y * light.sun_direction[1] + z * light.sun_direction[2]
        if towards > 0:
            glow = 0.25 * towards**8 + 1.2 * towards**64 + (30.0 if towards > 0.9996 else 0.0)
            red, green, blue = red + glow * light.sun[0], green + glow * light.sun[1], blue + glow * light.sun[2]
    return red, green, blue


@part
def _window_share(position: float, pitch: float, open_share: float, blur: float) -> float:
    """Share of a window along one axis, filtered over ``blur`` metres."""
    phase = position / pitch
    offset = abs(phase - np.floor(phase) - 0.5) * pitch
    edge = open_share * pitch / 2 - offset
    sharp = min(1.0, max(0.0, 0.5 + edge / max(blur, 0.02)))
    fade = min(1.0, max(0.0, blur / pitch * 2 - 1))
    return float(sharp + fade * (open_share - sharp))


@part
def _hash(a: int, b: int, c: int) -> float:
    """A number in [0, 1) that looks random."""
    value = (a * 73856093) ^ (b * 19349663) ^ (c * 83492791)
    value = (value ^ (value >> 13)) * 1274126177
    value = (value ^ (value >> 16)) & 0xFFFF
    return value / 65536.0


def facade_styles(solids: int) -> Float:
    """Return the style of each solid's facade, ``(solids, 6)``.

    Trim, distances of windows and of floors, open shares of both, and whether there is a shop.
    """
    owner, choose = np.arange(solids), cast(Any, _hash).py_func
    trim, wide = choose(owner, 3, 7), 0.32 + 0.38 * choose(owner, 17, 4)
    pitch, floor = 1.9 + 2.2 * choose(owner, 5, 11), 2.9 + 0.8 * choose(owner, 13, 2)
    high, shop = 0.42 + 0.22 * choose(owner, 19, 6), choose(owner, 23, 1) > 0.45
    return np.column_stack([trim, pitch, floor, np.where(trim > 0.75, 0.9, wide), high, shop])


@part
def facade(
    light: Light, fractal: Float32, styles: Float, owner: int, along: float, height: float, blur: float, red: float,
    green: float, blue: float,
) -> tuple[float, float, float, float, float]:  # fmt: skip
    """A wall with rows of windows: its albedo, share of glass and light from inside.

    Args:
        light: for the share of lit windows.
        fractal: noise tile, for dirt.
        styles: of all solids; see :func:`facade_styles`.
        owner: number of the building.
        along, height: metres along the wall and above the ground.
        blur: size of a pixel on the wall, metres.
        red, green, blue: albedo of the wall.
    """
    style, pitch, floor = styles[owner, 0], styles[owner, 1], styles[owner, 2]
    open_x, open_y = styles[owner, 3], styles[owner, 4]
    shop = height < 3.6 and styles[owner, 5] > 0
    if shop:
        pitch, open_x, floor, open_y = 3.4, 0.82, 3.6, 0.72
        row = 0
        level = height
    else:
        level = height - 3.6
        row = int(np.floor(level / floor)) + 1
    column = int(np.floor(along / pitch))
    glass = _window_share(along, pitch, open_x, blur) * _window_share(level, floor, open_y, blur)
    frame = _window_share(along, pitch, open_x + 0.12, blur) * _window_share(level, floor, open_y + 0.1, blur) - glass
    dirt = 0.82 + 0.28 * smooth_noise(fractal, along * 7, height * 3.5)
    ledge = level / floor - np.floor(level / floor)
    if ledge < 0.05 and style < 0.5:
        dirt *= 1.18
    if height < 0.7:
        dirt *= 0.72
    if frame > 0:
        trim = 1.35 if style < 0.6 else 0.6
        dirt *= 1 + frame * (trim - 1)
    lit = 0.0
    if _hash(owner + 31, row, column) < light.lit_windows * (2.0 if shop else 1.0):
        lit = glass * (0.25 + 0.75 * _hash(owner, column, row))
    dark = 0.03 + 0.07 * _hash(owner, row * 3, column * 7) if glass > 0 else 0.0
    return (
        red * dirt * (1 - glass) + dark * glass, green * dirt * (1 - glass) + dark * glass,
        blue * dirt * (1 - glass) + 1.15 * dark * glass, glass, lit,
    )  # fmt: skip


@part
def headlight(light: Light, view_car: Float, x: float, y: float, z: float, height: float) -> float:
    """Irradiance of the ego car's lamps at a point of the global frame, ``height`` metres above the ground.

    ``view_car`` is global to ego (4, 4).
    """
    forward = view_car[0, 0] * x + view_car[0, 1] * y + view_car[0, 2] * z + view_car[0, 3] - 3.6
    side = view_car[1, 0] * x + view_car[1, 1] * y + view_car[1, 2] * z + view_car[1, 3]
    if forward < 0.3:
        return 0.0
    angle = side / (forward + 1.0)
    square = forward * forward + side * side
    # Dipped beam: wide and short, brightest some way ahead, cut off above.
    beam = np.exp(-4.5 * angle * angle) * 90.0 / (square + 60.0) * min(1.0, forward / 3)
    if height > 0.8:
        beam *= np.exp(-(height - 0.8) * 1.6)
    return float(light.headlights * beam)


@part
def lamp_light(lamps: Float32, origin: tuple[float, float], x: float, y: float) -> float:
    """Light of street lamps on the ground, read between the cells ``(rows, columns)`` of a metre each."""
    column, row = int(np.floor(x - origin[0])), int(np.floor(y - origin[1]))
    rows, columns = lamps.shape
    if row < 0 or column < 0 or row >= rows - 1 or column >= columns - 1:
        return 0.0
    u, v = x - origin[0] - column, y - origin[1] - row
    top = lamps[row, column] * (1 - u) + lamps[row, column + 1] * u
    low = lamps[row + 1, column] * (1 - u) + lamps[row + 1, column + 1] * u
    return float(top * (1 - v) + low * v)
