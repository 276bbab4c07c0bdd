"""A growing list of solids, with the common street furniture as one-line calls."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from mapfusion.arrays import Float
from predmapnet.demo_world.world import Solids

Colour = tuple[float, float, float]
Vector = Sequence[float] | Float

STEEL: Colour = (0.22, 0.23, 0.24)
BARK: Colour = (0.10, 0.075, 0.055)


class SolidList:
    """Collects solids one by one and hands them out as arrays."""

    def __init__(self) -> None:
        self._rows: list[tuple[str, Vector, Vector, float, Colour, str, Vector, Vector]] = []

    def add(
        self, shape: str, centre: Vector, size: Vector, yaw: float, colour: Colour, texture: str = "plain",
        velocity: Vector = (0.0, 0.0), lifetime: Vector = (-np.inf, np.inf),
    ) -> None:  # fmt: skip
        """Append one solid; arguments as in :class:`predmapnet.demo_world.world.Solids`."""
        self._rows.append((shape, centre, size, yaw, colour, texture, velocity, lifetime))

    def stand(self, shape: str, foot: Float, size: Vector, yaw: float, colour: Colour, texture: str = "plain") -> None:
        """Append a solid that stands with its foot on the ground at ``(x, y)``."""
        self.add(shape, (foot[0], foot[1], size[2] / 2), size, yaw, colour, texture)

    def solids(self) -> Solids:
        """Return everything collected as arrays."""
        columns = list(zip(*self._rows, strict=True)) if self._rows else [()] * 8
        count = len(self._rows)
        return Solids(
            np.array(columns[0], dtype=np.str_),
            np.array(columns[1], dtype=np.float64).reshape(count, 3),
            np.array(columns[2], dtype=np.float64).reshape(count, 3),
            np.array(columns[3], dtype=np.float64),
            np.array(columns[4], dtype=np.float64).reshape(count, 3),
            np.array(columns[5], dtype=np.str_),
            np.array(columns[6], dtype=np.float64).reshape(count, 2),
            np.array(columns[7], dtype=np.float64).reshape(count, 2),
        )

    def tree(self, foot: Float, generator: np.random.Generator) -> None:
        """A trunk and a crown of a few leafy balls."""
        height = generator.uniform(4.5, 10.0)
        crown = generator.uniform(0.28, 0.42) * height
        trunk = height - 1.5 * crown
        thickness = generator.uniform(0.16, 0.38)
        self.stand("cylinder", foot, (thickness, thickness, trunk + 0.6 * crown), 0.0, BARK, "bark")
        green = _vary((0.065, 0.10, 0.03), generator, 0.35)
        if generator.uniform() < 0.15:
            green = _vary((0.17, 0.10, 0.03), generator, 0.25)
        for index in range(5):
            angle = 2.4 * index + generator.uniform(0, 1)
            reach = 0.0 if index == 0 else crown * generator.uniform(0.35, 0.6)
            size = crown * (1.7 if index == 0 else generator.uniform(0.8, 1.3))
            middle = trunk + crown * (0.75 if index == 0 else generator.uniform(0.45, 1.15))
            centre = (foot[0] + reach * np.cos(angle), foot[1] + reach * np.sin(angle), middle)
            self.add("ellipsoid", centre, (size, size, 0.85 * size), 0.0, green, "foliage")

    def bush(self, foot: Float, generator: np.random.Generator) -> None:
        """A low leafy ball."""
        size = generator.uniform(0.7, 1.8)
        green = _vary((0.055, 0.085, 0.03), generator, 0.3)
        self.add("ellipsoid", (foot[0], foot[1], 0.32 * size), (size, 0.9 * size, 0.8 * size), 0.0, green, "foliage")

    def street_lamp(self, foot: Float, towards: Float) -> None:
        """A mast with an arm over the road; ``towards`` is a unit vector to the road."""
        self.stand("cylinder", foot, (0.16, 0.16, 7.6), 0.0, STEEL)
        yaw = float(np.arctan2(towards[1], towards[0]))
        middle, head = foot + 0.9 * towards, foot + 1.9 * towards
        self.add("box", (middle[0], middle[1], 7.6), (1.9, 0.08, 0.08), yaw, STEEL)
        self.add("box", (head[0], head[1], 7.58), (0.7, 0.28, 0.12), yaw, (0.35, 0.36, 0.37), "lamp")

    def sign(self, foot: Float, facing: float, generator: np.random.Generator) -> None:
        """A traffic sign on a pole, its face towards ``facing`` (radians)."""
        self.stand("cylinder", foot, (0.07, 0.07, 2.7), 0.0, STEEL)
        colour: Colour = [(0.55, 0.03, 0.03), (0.03, 0.10, 0.40), (0.75, 0.75, 0.72), (0.65, 0.45, 0.03)][
            int(generator.integers(4))
        ]
        centre = (foot[0] + 0.05 * np.cos(facing), foot[1] + 0.05 * np.sin(facing), 2.4)
        self.add("box", centre, (0.03, 0.62, 0.62), facing, colour, "sign")

    def pedestrian(self, foot: Float, generator: np.random.Generator) -> None:
        """Legs, coat and head."""
        yaw, height = generator.uniform(0, 2 * np.pi), generator.uniform(1.55, 1.9)
        trousers, coat = _vary((0.05, 0.055, 0.08), generator, 0.6), _vary((0.15, 0.12, 0.12), generator, 0.9)
        for side in (-0.1, 0.1):
            leg = foot + side * np.array([-np.sin(yaw), np.cos(yaw)])
            self.stand("cylinder", leg, (0.17, 0.17, 0.5 * height), yaw, trousers)
        self.add("ellipsoid", (foot[0], foot[1], 0.66 * height), (0.34, 0.52, 0.46 * height), yaw, coat)
        self.add("ellipsoid", (foot[0], foot[1], 0.93 * height), (0.2, 0.18, 0.25), yaw, (0.35, 0.22, 0.16))

    def building(self, centre: Float, size: Vector, yaw: float, generator: np.random.Generator) -> None:
        """A block with windows, often with something on its roof."""
        palette: list[Colour] = [
            (0.42, 0.36, 0.28), (0.30, 0.14, 0.10), (0.50, 0.47, 0.42), (0.24, 0.23, 0.22), (0.38, 0.24, 0.16),
            (0.55, 0.50, 0.36), (0.20, 0.22, 0.26), (0.46, 0.30, 0.22),
        ]  # fmt: skip
        colour = _vary(palette[int(generator.integers(len(palette)))], generator, 0.2)
        self.stand("box", centre, size, yaw, colour, "facade")
        top = float(size[2])
        self.add(
            "box", (centre[0], centre[1], top + 0.2), (size[0] + 0.5, size[1] + 0.5, 0.4), yaw, _scale(colour, 0.8)
        )
        if generator.uniform() < 0.5:
            share = generator.uniform(0.2, 0.5, 2)
            roof = (size[0] * share[0], size[1] * share[1], 2.4)
            self.add("box", (centre[0], centre[1], top + 1.6), roof, yaw, _scale(colour, 0.9))


def _vary(colour: Colour, generator: np.random.Generator, amount: float) -> Colour:
    factor = np.exp(generator.normal(0, amount)) * np.exp(generator.normal(0, amount / 4, 3))
    red, green, blue = np.clip(np.array(colour) * factor, 0.005, 0.9)
    return float(red), float(green), float(blue)


def _scale(colour: Colour, factor: float) -> Colour:
    return colour[0] * factor, colour[1] * factor, colour[2] * factor
