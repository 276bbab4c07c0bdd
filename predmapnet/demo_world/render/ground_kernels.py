"""Inner loops that fill the ground texture: material grain, paint with wear, and the pyramid above it.

Coordinates are texels of the finest level; texel ``(row, column)`` covers ``[column, column + 1) x [row, row + 1)``.
Colours are stored as square roots of linear albedo, eight bits each: the eye's precision, cheap to decode.
"""

from __future__ import annotations

import numpy as np

from mapfusion.arrays import Byte, Float, Float32
from predmapnet.demo_world.render.jit import kernel


@kernel
def fill_materials(
    material: Byte, origin_x: float, origin_y: float, texel: float, table: Float32, fractal: Float32, white: Float32,
    occlusion: Byte, shadow: Byte, out: Byte,
) -> None:  # fmt: skip
    """Colour each texel by its material.

    Args:
        material: ``(rows, columns)`` index into ``table``.
        origin_x, origin_y: corner of texel (0, 0), metres.
        texel: metres per texel.
        table: ``(materials, 7)``: red, green, blue albedo, grain, blotches, drift, pattern
            (1 slabs, 2 growth, 3 brick).
        fractal, white: noise tiles in [0, 1].
        occlusion, shadow: 255 where nothing darkens the ground.
        out: ``(rows, columns, 4)`` receives the colour and, last, the shadow.
    """
    rows, columns = material.shape
    grain_scale = min(1.0, 0.05 / texel)
    for row in range(rows):
        y = origin_y + (row + 0.5) * texel
        fine_row = int(np.floor(y / 0.05)) & 1023
        blotch_row = int(np.floor(y / 0.035)) & 1023
        wide = y / 0.6
        wide_row = int(np.floor(wide))
        share_y = wide - wide_row
        for column in range(columns):
            x = origin_x + (column + 0.5) * texel
            kind = material[row, column]
            grain = (white[fine_row, int(np.floor(x / 0.05)) & 1023] - 0.5) * 2 * table[kind, 3] * grain_scale
            blotch = (fractal[blotch_row, int(np.floor(x / 0.035)) & 1023] - 0.5) * 2
            wide = x / 0.6
            wide_column = int(np.floor(wide))
            share_x = wide - wide_column
            top = fractal[wide_row & 1023, wide_column & 1023] * (1 - share_x)
            top += fractal[wide_row & 1023, (wide_column + 1) & 1023] * share_x
            low = fractal[(wide_row + 1) & 1023, wide_column & 1023] * (1 - share_x)
            low += fractal[(wide_row + 1) & 1023, (wide_column + 1) & 1023] * share_x
            drift = (top * (1 - share_y) + low * share_y - 0.5) * 2
            factor = 1 + grain + table[kind, 4] * blotch + table[kind, 5] * drift
            red, green, blue = table[kind, 0], table[kind, 1], table[kind, 2]
            pattern = table[kind, 6]
            if pattern == 1.0:
                joint_x, joint_y = x / 1.5, y / 1.5
                joint_x -= np.floor(joint_x)
                joint_y -= np.floor(joint_y)
                if joint_x < 0.03 or joint_y < 0.03:
                    factor *= 0.72
            elif pattern == 2.0:
                dry = max(0.0, min(1.0, 0.5 + 0.9 * drift + 0.5 * blotch))
                red *= 0.75 + 0.6 * dry
                blue *= 0.8 + 0.2 * dry
            elif pattern == 3.0:
                brick_y = y / 0.2
                brick_x = x / 0.4 + 0.5 * (int(np.floor(brick_y)) & 1)
                if brick_x - np.floor(brick_x) < 0.12 or brick_y - np.floor(brick_y) < 0.2:
                    factor *= 0.8
            factor = max(0.15, factor) * occlusion[row, column] / 255.0
            out[row, column, 0] = min(255.0, np.sqrt(max(0.0, red * factor)) * 255 + 0.5)
            out[row, column, 1] = min(255.0, np.sqrt(max(0.0, green * factor)) * 255 + 0.5)
            out[row, column, 2] = min(255.0, np.sqrt(max(0.0, blue * factor)) * 255 + 0.5)
            shade = float(shadow[row, column])
            if 0 < shade < 255:
                # Flecks of sun between leaves.
                shade = min(255.0, max(0.0, shade + blotch * 1.6 * min(shade, 255 - shade)))
            out[row, column, 3] = shade


def edge_lines(quads: Float) -> Float:
    """Return factors ``(n, 4, 3)`` of x, y and 1: the distance to the left of each edge of ``(n, 4, 2)`` quads."""
    step = np.roll(quads, -1, axis=1) - quads
    step /= np.linalg.norm(step, axis=2, keepdims=True) + 1e-12
    across, along = -step[..., 1], step[..., 0]
    return np.stack([across, along, -across * quads[..., 0] - along * quads[..., 1]], axis=2)


@kernel
def fill_paint(quads: Float, lines: Float, attributes: Float, wear_tile: Float32, cover: Float, paint: Byte) -> None:
    """Paint quadrilaterals with the exact share of each texel that they cover.

    Args:
        quads: ``(n, 4, 2)`` corners, texels, counter-clockwise (x to y).
        lines: of their edges; see :func:`edge_lines`.
        attributes: ``(n, 3)``: wear, albedo, yellow.
        wear_tile: noise in [0, 1], evenly spread: the share ``wear`` of it chips off.
        cover: ``(4,)``, overwritten.
        paint: ``(rows, columns, 3)``: coverage, square root of albedo, yellow.
    """
    rows, columns = paint.shape[0], paint.shape[1]
    for index in range(len(quads)):
        wear = attributes[index, 0]
        low_x = low_y = 1e30
        high_x = high_y = -1e30
        for corner in range(4):
            low_x, high_x = min(low_x, quads[index, corner, 0]), max(high_x, quads[index, corner, 0])
            low_y, high_y = min(low_y, quads[index, corner, 1]), max(high_y, quads[index, corner, 1])
        margin = 6
        for row in range(max(0, int(low_y) - margin), min(rows, int(high_y) + margin + 1)):
            for column in range(max(0, int(low_x) - margin), min(columns, int(high_x) + margin + 1)):
                x, y = column + 0.5, row + 0.5
                for edge in range(4):
                    distance = lines[index, edge, 0] * x + lines[index, edge, 1] * y + lines[index, edge, 2]
                    cover[edge] = min(1.0, max(0.0, 0.5 + distance))
                coverage = max(0.0, cover[0] + cover[2] - 1) * max(0.0, cover[1] + cover[3] - 1)
                if coverage > 0 and wear > 0:
                    chip = 0.65 * wear_tile[row & 1023, column & 1023]
                    chip += 0.35 * wear_tile[(5 * row + 311) & 1023, (5 * column + 97) & 1023]
                    coverage *= min(1.0, max(0.06, 0.5 + (chip - wear) / 0.12))
                if coverage * 255 > paint[row, column, 0]:
                    paint[row, column, 0] = coverage * 255 + 0.5
                if coverage > 0 or paint[row, column, 0] == 0:
                    # The colour spreads past the edge, so that interpolation never mixes in another one.
                    paint[row, column, 1] = np.sqrt(attributes[index, 1]) * 255
                    paint[row, column, 2] = attributes[index, 2] * 255


@kernel
def compose(base: Byte, paint: Byte, out: Byte) -> None:
    """Lay the paint over the base; all ``(rows, columns, channels)``, ``out`` being colour and shadow."""
    rows, columns = base.shape[0], base.shape[1]
    for row in range(rows):
        for column in range(columns):
            coverage = paint[row, column, 0]
            for channel in range(4):
                out[row, column, channel] = base[row, column, channel]
            if coverage > 0:
                share = coverage / 255.0
                albedo = (paint[row, column, 1] / 255.0) ** 2
                yellow = paint[row, column, 2] / 255.0
                for channel in range(3):
                    tint = 1.0 - yellow * (0.12 if channel == 0 else (0.42 if channel == 1 else 0.92))
                    below = (base[row, column, channel] / 255.0) ** 2
                    mixed = below * (1 - share) + albedo * tint * share
                    out[row, column, channel] = np.sqrt(mixed) * 255 + 0.5


@kernel
def halve(fine: Byte, coarse: Byte) -> None:
    """Average two by two texels in linear light; ``fine`` has twice the rows and columns of ``coarse``."""
    for row in range(coarse.shape[0]):
        for column in range(coarse.shape[1]):
            for channel in range(4):
                first, second = float(fine[2 * row, 2 * column, channel]), float(fine[2 * row, 2 * column + 1, channel])
                third = float(fine[2 * row + 1, 2 * column, channel])
                fourth = float(fine[2 * row + 1, 2 * column + 1, channel])
                if channel == 3:
                    mean = (first + second + third + fourth) / 4
                else:
                    mean = np.sqrt((first * first + second * second + third * third + fourth * fourth) / 4)
                coarse[row, column, channel] = mean + 0.5
