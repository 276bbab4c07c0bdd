"""Painted symbols in the frame of a lane: metres, x along the lane, y to its left, ``(n, 4, 2)`` quadrilaterals."""

from __future__ import annotations

import numpy as np
from numpy.random import Generator
from shapely import Polygon

from mapfusion.arrays import Float
from predmapnet.demo_world.render.paint import ribbon, stripes_over

TIP = 0.04
"""Width of what is a point in paint, metres."""

_STROKES = np.array(
    [
        [[0.0, 0.0], [0.0, 1.0]], [[0.5, 0.0], [0.5, 1.0]], [[1.0, 0.0], [1.0, 1.0]], [[0.0, 0.0], [0.5, 0.0]],
        [[0.5, 0.0], [1.0, 0.0]], [[0.0, 1.0], [0.5, 1.0]], [[0.5, 1.0], [1.0, 1.0]], [[0.0, 0.0], [1.0, 1.0]],
    ]
)  # fmt: skip
"""Strokes that letters are made of, as a seven-segment display has them and a diagonal; (along, leftward) shares."""


def _quad(*corners: tuple[float, float]) -> Float:
    return np.array([corners])


def _box(start: float, end: float, low: float, high: float) -> Float:
    return _quad((start, low), (end, low), (end, high), (start, high))


def arrow(random: Generator) -> Float:
    """An arrow straight on, to a side, or both; 3 to 6 m long."""
    kind, side, width = int(random.integers(3)), float(random.choice([-1.0, 1.0])), float(random.uniform(0.12, 0.2))
    parts = [_box(0.0, 3.0, -width / 2, width / 2)]
    if kind != 1:
        parts.append(_quad((3.0, -0.4), (4.8, -TIP / 2), (4.8, TIP / 2), (3.0, 0.4)))
    if kind != 0:
        parts.append(_box(1.9, 1.9 + 2 * width, 0.0, 0.6) * [1.0, side])
        parts.append(_quad((1.2, 0.6), (2.1, 1.1), (2.1 + TIP, 1.1), (3.0, 0.6)) * [1.0, side])
    return np.concatenate(parts) * [random.uniform(0.8, 1.25), 1.0]


def cycle(random: Generator) -> Float:
    """A bicycle, sometimes with two angles before it; 1.5 to 3 m long."""
    turns = np.linspace(0.0, 2 * np.pi, 9)
    wheel = 0.42 * np.stack([np.cos(turns), np.sin(turns)], axis=1)
    frame = np.array([[0.0, 0.55], [0.45, 0.2], [0.9, 0.35], [0.45, -0.25], [0.0, 0.55]])
    parts = [ribbon(wheel + np.array([0.0, 0.55]), 0.08), ribbon(wheel - np.array([0.0, 0.55]), 0.08)]
    parts += [ribbon(frame, 0.08), ribbon(np.array([[0.0, -0.55], [0.9, -0.35]]), 0.08)]
    if random.random() < 0.5:
        for ahead in (1.3, 1.9):
            parts.append(ribbon(np.array([[ahead, -0.5], [ahead + 0.6, 0.0], [ahead, 0.5]]), 0.15))
    return np.concatenate(parts) * [random.uniform(1.0, 1.6), random.uniform(0.8, 1.1)]


def writing(random: Generator) -> Float:
    """A word of two to five letters across the lane, 1.2 to 2.8 m high; sometimes two words one after the other."""
    count, height = int(random.integers(2, 6)), float(random.uniform(1.2, 2.8))
    width = float(random.uniform(0.7, 1.0)) * 2.4 / count
    parts = []
    for row in range(int(random.choice([1, 2], p=[0.75, 0.25]))):
        for place in range(count):
            drawn = _STROKES[random.choice(len(_STROKES), int(random.integers(3, 7)), replace=False)]
            size, corner = (height, 0.7 * width), (1.5 * height * row, (place - count / 2) * width)
            parts += [ribbon(stroke * size + corner, 0.16 if stroke[0, 0] != stroke[1, 0] else 0.3) for stroke in drawn]
    return np.concatenate([part for part in parts if len(part)])


def teeth(random: Generator) -> Float:
    """A row of triangles across the lane, as where one has to give way."""
    base, height, gap = random.uniform(0.4, 0.7), random.uniform(0.5, 0.9), random.uniform(0.15, 0.5)
    places = np.arange(-1.6, 1.6 - base, base + gap)
    return np.concatenate(
        [
            _quad((0.0, at), (height, at + base / 2 - TIP / 2), (height, at + base / 2 + TIP / 2), (0.0, at + base))
            for at in places
        ]
    )


def bars(random: Generator) -> Float:
    """Three to nine bars across the lane that warn of a junction, closer and closer, or evenly as on a hump."""
    width, gap = float(random.uniform(0.2, 0.6)), float(random.uniform(0.4, 2.2))
    shrink = float(random.choice([1.0, 0.85]))
    starts = np.cumsum(width + gap * shrink ** np.arange(int(random.integers(3, 10))))
    return np.concatenate([_box(start, start + width, -1.45, 1.45) for start in starts])


def hump(random: Generator) -> Float:
    """Two rows of rectangles beside each other, or one of long ones: the paint of a hump, much like a crossing's."""
    length = float(random.uniform(0.5, 1.8))
    places = np.arange(-1.5, 1.3, 2 * (width := float(random.uniform(0.3, 0.5))))
    rows = [(0.0, 0.0), (length, width)] if random.random() < 0.6 else [(0.0, 0.0)]
    return np.concatenate(
        [_box(ahead, ahead + length, at + aside, at + aside + width) for ahead, aside in rows for at in places]
    )


def keep_clear(random: Generator) -> Float:
    """A box with a cross or a net of lines in it, which nobody may stop in."""
    length, width = float(random.uniform(4.0, 9.0)), 2.7
    corners = np.array([[0.0, -width / 2], [length, -width / 2], [length, width / 2], [0.0, width / 2]])
    parts = [ribbon(np.vstack([corners, corners[:1]]), 0.15)]
    for across in np.arange(0.0, length - width + 0.1, float(random.choice([1.2, 2.0, 9.0]))):
        parts.append(ribbon(np.array([[across, -width / 2], [across + width, width / 2]]), 0.12))
        parts.append(ribbon(np.array([[across + width, -width / 2], [across, width / 2]]), 0.12))
    return np.concatenate(parts)


def hatched(random: Generator) -> Float:
    """An area of stripes, aslant or along the lane as those of a zebra crossing, often with a line around it."""
    length, width = float(random.uniform(1.5, 9.0)), float(random.uniform(0.8, 2.9))
    corners = np.array([[0.0, 0.0], [length, 0.0], [length, width], [0.0, width]])
    heading = np.radians(float(random.choice([0.0, 35.0, 45.0, 135.0, 90.0])))
    stripe = float(random.uniform(0.2, 0.5))
    stripes = stripes_over(Polygon(corners), heading, stripe, float(random.uniform(1.8, 3.0)) * stripe)
    rim = ribbon(np.vstack([corners, corners[:1]]), 0.12) if random.random() < 0.6 else np.zeros((0, 4, 2))
    shape: Float = np.concatenate([stripes, rim]) - np.array([0.0, float(random.uniform(0.0, width))])
    return shape


def zigzag(random: Generator) -> Float:
    """Zigzag lines along both sides of a lane, as before some crossings."""
    count, pitch = int(random.integers(4, 9)), float(random.uniform(1.0, 2.0))
    points = np.stack([pitch * np.arange(count), 0.25 * (-1.0) ** np.arange(count)], axis=1)
    return np.concatenate([ribbon(points + np.array([0.0, aside]), 0.12) for aside in (-1.35, 1.35)])
