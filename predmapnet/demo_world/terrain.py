"""Ground with slopes: a smooth height field above the plane of the map, and cars that stand on it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import cv2
import numpy as np
import shapely
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter, maximum_filter

from mapfusion.arrays import Float, Float32
from predmapnet.demo_world.world import Trajectory, World

CELL = 4.0
"""Metres between the coefficients of a terrain that is drawn by chance."""
CELLS = 256
"""Their number in each direction; the ground repeats itself after 1024 m, which no drive of the demo world reaches."""
STEEPEST = (0.025, 0.08)
"""Range from which the largest grade near the drive is drawn."""
SHARPEST = 1 / 400
"""Largest curvature of a hill or a dip, per metre."""
LONGEST_WAVE, SHORTEST_WAVE = 1024.0, 170.0
CAMBER = (0.010, 0.025)
"""Range from which the fall of streets from their middle to their kerbs is drawn."""
_ACROSS = 0.2
"""Steepness of waves across the drive, relative to those along it: roads tilt sideways less than they climb."""
_CROWN_REACH = 5.0
"""Metres from the kerb at which the ground no longer rises."""

WHEELBASE, TRACK = 2.8, 1.6
"""Metres between the axles, and between left and right wheels."""


@dataclass(frozen=True)
class Terrain:
    """Height of the ground above the plane z = 0: a surface of quadratic B-splines that repeats in x and y.

    Height and slope are continuous, and second derivatives nowhere exceed the second differences of the coefficients,
    which is what lets a ray stride towards the ground without ever stepping over a crest.

    Attributes:
        coefficients: ``(n, n) float32``, metres, n being a power of two; that of row i and column j has its middle at
            ``x = (j + 0.5) * cell``, ``y = (i + 0.5) * cell``.
        cell: metres.
    """

    coefficients: Float32
    cell: float = CELL

    def __post_init__(self) -> None:
        """Refuse a grid whose indices cannot be wrapped by a bit mask."""
        rows, columns = self.coefficients.shape
        if rows != columns or rows & (rows - 1):
            raise ValueError(f"a terrain has as many rows as columns, a power of two, not {rows} and {columns}")

    def heights(self, points: Float) -> Float:
        """Height ``(...)`` of the ground, metres, at positions ``(..., 2)`` of the global frame."""
        return self._combined(points, 0, 0)

    def gradients(self, points: Float) -> Float:
        """Slope ``(..., 2)`` of the ground towards x and y, metres per metre."""
        return np.stack([self._combined(points, 1, 0), self._combined(points, 0, 1)], axis=-1) / self.cell

    def lifted(self, points: Float) -> Float:
        """Positions ``(..., 3)`` on the ground above positions ``(..., 2)``."""
        return np.concatenate([points, self.heights(points)[..., None]], axis=-1)

    @cached_property
    def bend(self) -> float:
        """A bound of the second derivative of the height in any direction, per metre."""
        c = self.coefficients.astype(np.float64)
        # Second derivatives are weighted means of the second differences beside them.
        x, y = (np.abs(np.roll(c, -1, axis) - 2 * c + np.roll(c, 1, axis)) for axis in (1, 0))
        slope = np.roll(c, -1, 0) - c
        x, y, xy = (maximum_filter(a, 3, mode="wrap") for a in (x, y, np.abs(np.roll(slope, -1, 1) - slope)))
        return float((np.maximum(x, y) + xy).max() / self.cell**2)

    @cached_property
    def top(self) -> float:
        """A height that the ground nowhere exceeds, metres."""
        return float(self.coefficients.max())

    def _combined(self, points: Float, order_x: int, order_y: int) -> Float:
        place = np.floor(points / self.cell)
        share = points / self.cell - place
        cell = place.astype(np.int64)
        x, y = _weights(share[..., 0], order_x), _weights(share[..., 1], order_y)
        mask = len(self.coefficients) - 1
        total = np.zeros(points.shape[:-1])
        for i in range(3):
            for j in range(3):
                c = self.coefficients[(cell[..., 1] + i - 1) & mask, (cell[..., 0] + j - 1) & mask]
                total += y[i] * x[j] * c
        return total


def _weights(share: Float, order: int) -> tuple[Float, Float, Float]:
    """Weights of the coefficients before, in and after a cell (or their derivatives), ``share`` of the way into it."""
    if order:
        return share - 1, 1 - 2 * share, share
    return 0.5 * (1 - share) ** 2, 0.5 + share * (1 - share), 0.5 * share**2


def draw_terrain(seed: int, positions: Float, road: shapely.Geometry) -> Terrain:
    """Draw hills and dips, on which streets fall from their middle to their kerbs.

    Args:
        seed: of all that is drawn by chance.
        positions: ``(n, 2)`` of the car, metres; the steepest grade is that within 100 m of them.
        road: the drivable surface.
    """
    generator = np.random.default_rng([0x68696C6C, seed])
    steepest, camber = generator.uniform(*STEEPEST), generator.uniform(*CAMBER)
    hills = Terrain(_waves(generator, np.linalg.svd(positions - positions.mean(axis=0), full_matrices=False)[2][0]))
    near = shapely.get_coordinates(shapely.MultiPoint(positions).buffer(100.0).envelope)[:3]
    steps = [np.arange(near[:, axis].min(), near[:, axis].max(), CELL) for axis in range(2)]
    grades = np.linalg.norm(hills.gradients(np.stack(np.meshgrid(*steps), axis=-1)), axis=-1)
    scale = min(steepest / grades.max(), SHARPEST / hills.bend)
    crown = camber * _crown(road, positions.mean(axis=0))
    return Terrain((scale * hills.coefficients + crown).astype(np.float32))


def _waves(generator: np.random.Generator, axis: Float) -> Float32:
    """Coefficients of a few long waves, each of about the same grade; fewer across ``axis``: streets are built so."""
    period = CELL * CELLS
    most = int(period / SHORTEST_WAVE)
    numbers = np.array([(i, j) for i in range(most + 1) for j in range(-most, most + 1) if i > 0 or j > 0])
    lengths = period / np.hypot(*numbers.T)
    numbers = numbers[(lengths >= SHORTEST_WAVE) & (lengths <= LONGEST_WAVE)]
    chosen = generator.choice(len(numbers), 9, replace=False, p=(p := 1 / np.hypot(*numbers.T)) / p.sum())
    middle = (np.arange(CELLS) + 0.5) * 2 * np.pi / CELLS
    total = np.zeros((CELLS, CELLS))
    for i, j in numbers[chosen]:
        length = np.hypot(i, j)
        height = generator.normal() / length * (_ACROSS + (1 - _ACROSS) * ((i, j) @ axis / length) ** 2)
        total += height * np.cos(i * middle[None, :] + j * middle[:, None] + generator.uniform(0, 2 * np.pi))
    return total.astype(np.float32)


def _crown(road: shapely.Geometry, middle: Float) -> Float:
    """Metres from the kerb of the road at each coefficient, at most :data:`_CROWN_REACH`, smoothed; 0 off the road."""
    side = int(CELL * CELLS)
    corner = np.floor(middle / CELL) * CELL - side / 2
    picture = np.zeros((side, side), dtype=np.uint8)
    for polygon in shapely.get_parts(road):
        outlines = (polygon.exterior, *polygon.interiors)
        rings = [np.round(shapely.get_coordinates(ring) - corner - 0.5) for ring in outlines]
        cv2.fillPoly(picture, [ring.astype(np.int32) for ring in rings], 1)
    distance = np.minimum(cv2.distanceTransform(picture, cv2.DIST_L2, 3), _CROWN_REACH).astype(np.float64)
    # Further than half the period from the drive the ground repeats itself: no crown may end there like a step.
    distance[[0, -1]] = distance[:, [0, -1]] = 0.0
    distance = gaussian_filter(distance, 3.5, mode="wrap")
    cells = distance.reshape(CELLS, int(CELL), CELLS, int(CELL)).mean(axis=(1, 3))
    shift = np.round(corner / CELL).astype(int)
    return np.roll(cells, (shift[1], shift[0]), axis=(0, 1))


def on_terrain(trajectory: Trajectory, terrain: Terrain) -> Trajectory:
    """Put a car that drives on the plane z = 0 on the ground, with the pitch and roll that its wheels get there.

    Positions (x, y) and headings stay, and what a pose has of pitch and roll comes on top.
    """
    poses = trajectory.ego_to_global.copy()
    heading = np.arctan2(poses[:, 1, 0], poses[:, 0, 0])
    ahead = np.stack([np.cos(heading), np.sin(heading)], axis=1)
    left = np.stack([-ahead[:, 1], ahead[:, 0]], axis=1)
    rear = poses[:, :2, 3]
    wheels = np.array([
        [terrain.heights(rear + along * ahead + side * left) for side in (TRACK / 2, -TRACK / 2)]
        for along in (0.0, WHEELBASE)
    ])  # fmt: skip
    grade = (wheels[1] - wheels[0]).mean(axis=0) / WHEELBASE
    crossfall = (wheels[:, 0] - wheels[:, 1]).mean(axis=0) / TRACK
    level = np.zeros((len(poses), 3, 3))
    level[:, :2, 0], level[:, :2, 1], level[:, 2, 2] = ahead, left, 1.0
    poses[:, :3, :3] = _tilted(ahead, left, grade, crossfall) @ level.transpose(0, 2, 1) @ poses[:, :3, :3]
    poses[:, 2, 3] += terrain.heights(rear)
    return replace(trajectory, ego_to_global=poses)


def _tilted(ahead: Float, left: Float, grade: Float, crossfall: Float) -> NDArray[np.float64]:
    """Rotations ``(n, 3, 3)`` whose x axis rises by ``grade`` and whose xy plane rises by ``crossfall`` to the left."""
    forward = np.column_stack([ahead, grade])
    up = np.cross(forward, np.column_stack([left, crossfall]))
    forward /= np.linalg.norm(forward, axis=1, keepdims=True)
    up /= np.linalg.norm(up, axis=1, keepdims=True)
    return np.stack([forward, np.cross(up, forward), up], axis=2)


def put_on_terrain(world: World, terrain: Terrain) -> World:
    """Give a flat world ground with slopes; its map stays what it is, seen from above."""
    return replace(world, terrain=terrain, trajectory=on_terrain(world.trajectory, terrain))
