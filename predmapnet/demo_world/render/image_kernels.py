"""The loops over an image: shade every pixel, mirror the scene in wet ground, and turn light into bytes."""

from __future__ import annotations

import numpy as np

from mapfusion.arrays import Byte, Float, Float32, Integer
from predmapnet.demo_world.render.ground_light import (
    Surroundings,
    ground_colour,
    ground_met,
    hazy,
    kerb_colour,
    light_at,
    sort_ground,
)
from predmapnet.demo_world.render.jit import kernel, part
from predmapnet.demo_world.render.kerbs import FACE, Kerbs
from predmapnet.demo_world.render.mesh import Mesh
from predmapnet.demo_world.render.raster import Vector, View, ZBuffer, ball_depth, pixel_ray
from predmapnet.demo_world.render.relief import (
    Footing,
    Relief,
    facing_of,
    first_guess,
    footing,
    height_over_foot,
    least_depth,
    mirrored_ray,
    stand_of,
)
from predmapnet.demo_world.render.shading import Colour, facade, sky, smooth_noise


@part
def _sky_mirror(
    around: Surroundings, ray: Vector, length: float, nx: float, ny: float, nz: float
) -> tuple[float, float, float, float]:
    """Sky seen in a smooth surface, and Schlick's share of reflection."""
    x, y, z = ray[0] / length, ray[1] / length, ray[2] / length
    cosine = -(x * nx + y * ny + z * nz)
    mirrored_x, mirrored_y, mirrored_z = x + 2 * cosine * nx, y + 2 * cosine * ny, z + 2 * cosine * nz
    fresnel = 0.05 + 0.95 * max(0.0, 1 - cosine) ** 5
    dim = 1.0 if mirrored_z > 0.25 else max(0.15, 0.25 + 3.0 * mirrored_z)
    red, green, blue = sky(around.light, around.clouds, mirrored_x, mirrored_y, max(mirrored_z, 0.02))
    return min(red, 2.0) * dim, min(green, 2.0) * dim, min(blue, 2.0) * dim, fresnel


@part
def _face_colour(
    around: Surroundings, relief: Relief | None, mesh: Mesh, view: View, face: int, depth: float, ray: Vector
) -> Colour:
    light = around.light
    length = np.sqrt(ray[0] * ray[0] + ray[1] * ray[1] + ray[2] * ray[2])
    x, y, z = view.position[0] + depth * ray[0], view.position[1] + depth * ray[1], view.position[2] + depth * ray[2]
    nx, ny, nz = mesh.normals[face, 0], mesh.normals[face, 1], mesh.normals[face, 2]
    material, owner = mesh.materials[face], mesh.owners[face]
    height = height_over_foot(relief, owner, z)
    red, green, blue = mesh.colours[face, 0], mesh.colours[face, 1], mesh.colours[face, 2]
    glass = lit_window = 0.0
    if material == 1:
        along = (y - mesh.corners[face, 0, 1]) * nx - (x - mesh.corners[face, 0, 0]) * ny if abs(nz) < 0.5 else 0.0
        blur = depth / view.focal_x / max(0.15, -(ray[0] * nx + ray[1] * ny) / length)
        red, green, blue, glass, lit_window = facade(
            light, around.fractal, around.styles, owner, along, height, blur, red, green, blue
        )
    elif material == 3 or material == 10 or material == 0:
        dirt = 0.85 + 0.3 * smooth_noise(around.fractal, (x - y) * 9, (y + z) * 9)
        red, green, blue = red * dirt, green * dirt, blue * dirt
    sun = max(0.0, nx * light.sun_direction[0] + ny * light.sun_direction[1] + nz * light.sun_direction[2])
    shadow = around.sunlit[owner]
    sun *= shadow + (1 - shadow) * min(1.0, max(0.0, (height - 3.0) / 8.0))
    # Close to the ground less of the sky is seen, but light comes back from the road.
    ambient = (0.62 + 0.38 * nz) * (0.6 + 0.4 * min(1.0, height / 1.2))
    towards = -(nx * ray[0] + ny * ray[1] + nz * ray[2]) / length
    lit = light_at(around, x, y, z, height, sun, ambient, max(0.0, towards))
    colour = (red * lit[0], green * lit[1], blue * lit[2])
    if material == 4 or material == 5 or glass > 0.02:
        mirror = _sky_mirror(around, ray, length, nx, ny, nz)
        share = mirror[3] * (0.5 if material == 4 else 1.0)
        if material == 5:
            share = 0.12 + 0.88 * share
        elif material == 1:
            share = glass * (0.25 + 0.75 * share)
        colour = (
            colour[0] * (1 - share) + mirror[0] * share, colour[1] * (1 - share) + mirror[1] * share,
            colour[2] * (1 - share) + mirror[2] * share,
        )  # fmt: skip
    if lit_window > 0:
        colour = (colour[0] + 0.55 * lit_window, colour[1] + 0.42 * lit_window, colour[2] + 0.22 * lit_window)
    if light.lamps > 0:
        if material == 6:
            colour = (colour[0] + 3.0 * light.lamps, colour[1] + 2.8 * light.lamps, colour[2] + 2.4 * light.lamps)
        elif material == 7:
            colour = (colour[0] + 1.3 * light.lamps, colour[1] + 0.08 * light.lamps, colour[2] + 0.06 * light.lamps)
        elif material == 8 and nz < -0.5:
            colour = (colour[0] + 6.0 * light.lamps, colour[1] + 4.6 * light.lamps, colour[2] + 3.0 * light.lamps)
    return hazy(light, colour, depth * length)


@part
def _ball_colour(
    around: Surroundings, relief: Relief | None, mesh: Mesh, view: View, index: int, depth: float, ray: Vector
) -> Colour:
    light, balls = around.light, mesh.balls
    length = np.sqrt(ray[0] * ray[0] + ray[1] * ray[1] + ray[2] * ray[2])
    x, y, z = view.position[0] + depth * ray[0], view.position[1] + depth * ray[1], view.position[2] + depth * ray[2]
    nx, ny, nz = (
        (x - balls[index, 0]) / balls[index, 3] ** 2,
        (y - balls[index, 1]) / balls[index, 4] ** 2,
        (z - balls[index, 2]) / balls[index, 5] ** 2,
    )
    norm = np.sqrt(nx * nx + ny * ny + nz * nz)
    nx, ny, nz = nx / norm, ny / norm, nz / norm
    red, green, blue = mesh.ball_colours[index, 0], mesh.ball_colours[index, 1], mesh.ball_colours[index, 2]
    shine = nx * light.sun_direction[0] + ny * light.sun_direction[1] + nz * light.sun_direction[2]
    ambient = 0.6 + 0.4 * nz
    if mesh.ball_materials[index] == 2:
        # Three planes, weighted by how squarely the surface faces each: no direction is stretched.
        weight_x, weight_y, weight_z = nx * nx, ny * ny, nz * nz
        fine = weight_x * smooth_noise(around.white, y * 17, z * 17) + weight_y * smooth_noise(
            around.white, x * 17, z * 17
        )
        fine += weight_z * smooth_noise(around.white, x * 17, y * 17)
        clump = weight_x * smooth_noise(around.fractal, y * 22, z * 22)
        clump += weight_y * smooth_noise(around.fractal, x * 22, z * 22)
        clump += weight_z * smooth_noise(around.fractal, x * 22, y * 22)
        fade = min(1.0, max(0.0, 1.3 - depth / view.focal_x * 9))
        texture = 0.25 + 1.1 * clump + 0.8 * fade * (fine - 0.5)
        red, green, blue = red * texture, green * texture, blue * texture
        shine = 0.35 * shine + 0.35
        shine *= 0.5 + clump
        ambient *= 0.55 + 0.45 * min(1.0, max(0.0, (z - balls[index, 2]) / balls[index, 5] + 1.0))
    height = height_over_foot(relief, mesh.ball_owners[index], z)
    lit = light_at(around, x, y, z, height, max(0.0, shine), ambient, 0.7)
    return hazy(light, (red * lit[0], green * lit[1], blue * lit[2]), depth * length)


@kernel
def shade_image(
    around: Surroundings, relief: Relief | None, kerbs: Kerbs | None, mesh: Mesh, view: View, samples: int, most: int,
    solids: ZBuffer, dynamic: Byte, found: Integer, scratch: Float, image: Float32, depth: Float32,
    ground_share: Float32,
) -> None:  # fmt: skip
    """Shade all pixels; each face in a pixel is shaded once, weighted by the samples that it covers.

    Args:
        around, mesh, view: what is seen.
        relief, kerbs: slopes and steps of the ground; None compiles loops for ground without.
        samples: per pixel and direction.
        most: largest number of ground samples along a footprint.
        solids: z-buffer.
        dynamic: ``(height, width)``, 255 where no moving thing darkens the ground.
        found, scratch: ``(16,)`` and ``(8, 16)``, overwritten.
        image: ``(height, width, 3)`` receives linear radiance.
        depth: ``(height, width)`` receives metres along the optical axis, infinite for the sky.
        ground_share: ``(height, width)`` receives how much of a pixel is ground.
    """
    faces = len(mesh.counts)
    weight, sum_x, sum_y, close = scratch[0], scratch[1], scratch[2], scratch[3]
    kinds_of_ground = scratch[4:]
    each = 1.0 / (samples * samples)
    stand = stand_of(relief, view.position)
    foot = first_guess(view, stand)
    for row in range(view.height):
        for column in range(view.width):
            first = solids.ids[row * samples, column * samples]
            same, closest = True, 0.0
            for i in range(samples):
                for j in range(samples):
                    same &= solids.ids[row * samples + i, column * samples + j] == first
                    closest = max(closest, solids.nearness[row * samples + i, column * samples + j])
            kinds = 1
            found[0], weight[0], sum_x[0], sum_y[0], close[0] = first, 1.0, column + 0.5, row + 0.5, closest
            if not same:
                kinds = 0
            for i in range(0 if same else samples):
                for j in range(samples):
                    near = solids.nearness[row * samples + i, column * samples + j]
                    number = solids.ids[row * samples + i, column * samples + j]
                    x, y = column + (j + 0.5) / samples, row + (i + 0.5) / samples
                    slot = 0
                    while slot < kinds and found[slot] != number:
                        slot += 1
                    if slot == kinds:
                        kinds += 1
                        found[slot], weight[slot], sum_x[slot], sum_y[slot], close[slot] = number, 0.0, 0.0, 0.0, 0.0
                    weight[slot] += each
                    sum_x[slot] += each * x
                    sum_y[slot] += each * y
                    close[slot] = max(close[slot], near)
            red = green = blue = share_of_ground = 0.0
            best, best_depth = -1.0, np.inf
            for slot in range(kinds):
                number, part = found[slot], weight[slot]
                x, y = sum_x[slot] / part, sum_y[slot] / part
                if number < 0:
                    # Only solids need the centre of what they cover: ground and sky are evaluated at the pixel's.
                    x, y = column + 0.5, row + 0.5
                ray = pixel_ray(view, x, y)
                here = np.inf
                if number < 0:
                    foot = footing(relief, view, stand, ray, foot, least_depth(relief, solids.ground, row, column))
                    here = foot.depth
                    if here < np.inf and kerbs is not None:
                        light_left = dynamic[row, column] / 255.0
                        here -= sort_ground(kerbs, relief, view, x, y, foot, kinds_of_ground)
                        colour = (0.0, 0.0, 0.0)
                        for kind in range(3):
                            share = kinds_of_ground[kind, 0]
                            if share == 0:
                                continue
                            met = Footing(here, foot.east, foot.north, foot.base)
                            if share < 1:
                                met, ray = ground_met(relief, view, foot, kinds_of_ground[kind])
                            clear = kinds_of_ground[kind, 4]
                            seen = kerb_colour(around, relief, kerbs, view, ray, met, light_left, most, kind, clear)
                            colour = (
                                colour[0] + share * seen[0],
                                colour[1] + share * seen[1],
                                colour[2] + share * seen[2],
                            )
                        share_of_ground += part * (1 - kinds_of_ground[FACE, 0])
                    elif here < np.inf:
                        colour = ground_colour(around, relief, view, ray, foot, dynamic[row, column] / 255.0, most)
                        share_of_ground += part
                    else:
                        length = np.sqrt(ray[0] * ray[0] + ray[1] * ray[1] + ray[2] * ray[2])
                        colour = sky(around.light, around.clouds, ray[0] / length, ray[1] / length, ray[2] / length)
                elif number < faces:
                    plane = solids.planes[number]
                    shaded = 1 / max(plane[0] * x + plane[1] * y + plane[2], 1e-6)
                    colour = _face_colour(around, relief, mesh, view, number, shaded, ray)
                    here = plane[0] * (column + 0.5) + plane[1] * (row + 0.5) + plane[2]
                    here = 1 / here if here > 0.5 * close[slot] and here < 2 * close[slot] else 1 / close[slot]
                else:
                    shaded = ball_depth(mesh.balls, number - faces, view, x, y)
                    if shaded <= 0:
                        shaded = 1 / close[slot]
                    colour = _ball_colour(around, relief, mesh, view, number - faces, shaded, ray)
                    here = shaded if same else ball_depth(mesh.balls, number - faces, view, column + 0.5, row + 0.5)
                    if here <= 0:
                        here = 1 / close[slot]
                red, green, blue = red + part * colour[0], green + part * colour[1], blue + part * colour[2]
                if part > best + 1e-9 or (part > best - 1e-9 and here < best_depth):
                    best, best_depth = part, here
            image[row, column, 0], image[row, column, 1], image[row, column, 2] = red, green, blue
            depth[row, column] = best_depth
            ground_share[row, column] = share_of_ground


@kernel
def mirror_in_wet(
    around: Surroundings, relief: Relief | None, view: View, ground: Float32, ground_share: Float32, image: Float32
) -> None:
    """Add to wet ground what it mirrors, smeared vertically as rough water does; see :func:`shade_image`."""
    light, rotation = around.light, view.rotation
    stand = stand_of(relief, view.position)
    foot = first_guess(view, stand)
    for row in range(view.height):
        for column in range(view.width):
            if ground_share[row, column] < 0.01:
                continue
            ray = pixel_ray(view, column + 0.5, row + 0.5)
            foot = footing(relief, view, stand, ray, foot, least_depth(relief, ground, row, column))
            depth = foot.depth
            if depth == np.inf:
                continue
            along, _, _, upright = facing_of(relief, view, ray, foot)
            length = np.sqrt(ray[0] * ray[0] + ray[1] * ray[1] + ray[2] * ray[2])
            x, y = view.position[0] + depth * ray[0], view.position[1] + depth * ray[1]
            puddle = smooth_noise(around.fractal, x * 1.7, y * 1.7)
            smooth = light.wetness * (0.35 + 0.65 * min(1.0, max(0.0, (puddle - 0.45) * 4)))
            fresnel = 0.02 + 0.98 * max(0.0, 1 + along * upright / length) ** 5
            share = smooth * fresnel * ground_share[row, column]
            red = green = blue = 0.0
            for step in range(4):
                # The ripple tilts the mirrored ray up and down.
                mx, my, mz = mirrored_ray(relief, ray, along, foot, 0.55 + 0.45 * step)
                local_x = rotation[0, 0] * mx + rotation[1, 0] * my + rotation[2, 0] * mz
                local_y = rotation[0, 1] * mx + rotation[1, 1] * my + rotation[2, 1] * mz
                local_z = rotation[0, 2] * mx + rotation[1, 2] * my + rotation[2, 2] * mz
                seen = False
                if local_z > 0.05:
                    i = int(local_y / local_z * view.focal_y + view.centre_y)
                    j = int(local_x / local_z * view.focal_x + view.centre_x)
                    if 0 <= i < view.height and 0 <= j < view.width and ground_share[i, j] == 0:
                        red, green, blue = red + image[i, j, 0], green + image[i, j, 1], blue + image[i, j, 2]
                        seen = True
                if not seen:
                    norm = np.sqrt(mx * mx + my * my + mz * mz)
                    colour = sky(light, around.clouds, mx / norm, my / norm, mz / norm)
                    red, green, blue = red + colour[0], green + colour[1], blue + colour[2]
            image[row, column, 0] += share * (red / 4 - image[row, column, 0])
            image[row, column, 1] += share * (green / 4 - image[row, column, 1])
            image[row, column, 2] += share * (blue / 4 - image[row, column, 2])


@kernel
def develop(
    image: Float32, exposures: Float32, vignette: float, noise: float, seed: int, curve: Byte, out: Byte
) -> None:
    """Expose an image ``(height, width, 3)`` of linear radiance, add sensor noise and apply the tone curve: ``out``.

    Args:
        image: changed in place.
        exposures: ``(3,)``, factors of red, green and blue.
        vignette: share of light that the corners lose.
        noise, seed: standard deviation at middle grey, and of what it is drawn.
        curve: ``(4096,)``, from the square root of linear light (0 to 1.25) to sRGB bytes.
        out: ``(height, width, 3)``.
    """
    height, width = out.shape[0], out.shape[1]
    state = np.uint64(seed) * np.uint64(6364136223846793005) + np.uint64(1442695040888963407)
    spread = np.float32(1.0 / (1 << 8) / 0.408)
    # Single precision: a few bytes of a million come out one greyer or brighter than in double.
    grain, brightest = np.float32(noise), np.float32(4095.0)
    steps, shot, dark, zero = np.float32(4095 / 1.25), np.float32(0.18), np.float32(0.004), np.float32(0.0)
    for row in range(height):
        y = (row + 0.5) / height - 0.5
        for column in range(width):
            x = (column + 0.5) / width - 0.5
            gain = np.float32(1 - vignette * 2 * (x * x + y * y))
            state = state * np.uint64(6364136223846793005) + np.uint64(1442695040888963407)
            mixed = state ^ (state >> np.uint64(29))
            for channel in range(3):
                value = image[row, column, channel] * gain * exposures[channel]
                # The sum of two bytes is nearly normal, with standard deviation 0.408 of its reach.
                low = np.int32((mixed >> np.uint64(16 * channel)) & np.uint64(255))
                high = np.int32((mixed >> np.uint64(16 * channel + 8)) & np.uint64(255))
                random = np.float32(low + high - 255) * spread
                value += random * grain * np.sqrt(max(value, zero) * shot + dark)
                index = np.int32(min(np.sqrt(max(value, zero)) * steps, brightest))
                out[row, column, channel] = curve[index]
