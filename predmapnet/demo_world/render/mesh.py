"""From solids to flat faces: boxes, prisms for cylinders, and cars with cabin, windows, wheels and lights."""

from __future__ import annotations

from enum import IntEnum
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from mapfusion.arrays import Float, Integer
from predmapnet.demo_world.terrain import Terrain
from predmapnet.demo_world.world import Solids

Corners = list[tuple[float, float, float]]

MOST_CORNERS = 8


class Material(IntEnum):
    """Shading of a face."""

    PLAIN = 0
    FACADE = 1
    FOLIAGE = 2
    BARK = 3
    LACQUER = 4
    GLASS = 5
    HEADLIGHT = 6
    TAILLIGHT = 7
    LAMP = 8
    SIGN = 9
    ROOF = 10


class Mesh(NamedTuple):
    """Flat convex faces and ellipsoids, as arrays for compiled loops.

    Attributes:
        corners: ``(f, 8, 3) float64``, metres, global frame, counter-clockwise seen from outside.
        counts: ``(f,) int64``, corners used.
        normals: ``(f, 3) float64``, outward.
        materials, owners: ``(f,) int64``: :class:`Material` and the solid's row.
        colours: ``(f, 3) float64``, linear albedo.
        balls: ``(b, 8) float64``: centre, half axes, cosine and sine of the yaw.
        ball_materials, ball_owners: ``(b,) int64``.
        ball_colours: ``(b, 3) float64``.
    """

    corners: Float
    counts: Integer
    normals: Float
    materials: Integer
    owners: Integer
    colours: Float
    balls: Float
    ball_materials: Integer
    ball_owners: Integer
    ball_colours: Float


class _Template(NamedTuple):
    """Faces of a unit solid (x, y in [-0.5, 0.5], z in [0, 1]); a negative tint means the solid's own colour."""

    corners: Float
    counts: Integer
    materials: Integer
    tints: Float


Part = tuple[Corners, Material, tuple[float, float, float] | None]


def _template(parts: list[Part]) -> _Template:
    corners = np.zeros((len(parts), MOST_CORNERS, 3))
    for row, (face, _, _) in enumerate(parts):
        corners[row, : len(face)] = face
        corners[row, len(face) :] = face[-1]
    counts = np.array([len(face) for face, _, _ in parts])
    materials = np.array([int(material) for _, material, _ in parts])
    tints = np.array([(-1.0, -1.0, -1.0) if tint is None else tint for _, _, tint in parts])
    return _Template(corners, counts, materials, tints)


def _hull(
    low: tuple[float, float, float, float, float], high: tuple[float, float, float, float, float]
) -> list[Corners]:
    """Sides front, left, rear, right and the top of a frustum; an end is (rear x, front x, half widths, z)."""
    x0, x1, w0, w1, z0 = low
    u0, u1, v0, v1, z1 = high
    return [
        [(x1, -w1, z0), (x1, w1, z0), (u1, v1, z1), (u1, -v1, z1)],
        [(x1, w1, z0), (x0, w0, z0), (u0, v0, z1), (u1, v1, z1)],
        [(x0, w0, z0), (x0, -w0, z0), (u0, -v0, z1), (u0, v0, z1)],
        [(x0, -w0, z0), (x1, -w1, z0), (u1, -v1, z1), (u0, -v0, z1)],
        [(u1, -v1, z1), (u1, v1, z1), (u0, v0, z1), (u0, -v0, z1)],
    ]


def _inset(face: Corners, share: float, lift: float = 0.004) -> Corners:
    """The same face shrunk towards its middle and lifted outwards a little: a pane in its frame."""
    points = np.array(face)
    middle = points.mean(axis=0)
    normal = np.cross(points[1] - points[0], points[2] - points[0])
    normal /= np.linalg.norm(normal)
    return [tuple(point) for point in middle + (points - middle) * (1 - share) + lift * normal]


def _disc(x: float, side: float, radius_x: float, radius_z: float, lift: float) -> Corners:
    """A wheel's face on the left (side 1) or right (-1)."""
    angles = np.arange(8) * np.pi / 4 + np.pi / 8
    order = angles[::-1] if side > 0 else angles
    return [(x + radius_x * np.cos(a), side * (0.5 + lift), radius_z * (1 + np.sin(a))) for a in order]


_RUBBER, _RIM, _TRIM = (0.02, 0.02, 0.022), (0.30, 0.30, 0.31), (0.035, 0.035, 0.038)


def _wheels(length: float, height: float, stations: tuple[float, ...]) -> list[Part]:
    parts: list[Part] = []
    for x in stations:
        for side in (1.0, -1.0):
            radius_x, radius_z = 0.34 / length, 0.34 / height
            parts.append(
                (_disc(x, side, 1.18 * radius_x, 1.12 * radius_z, 0.002), Material.PLAIN, (0.008, 0.008, 0.008))
            )
            parts.append((_disc(x, side, radius_x, radius_z, 0.006), Material.PLAIN, _RUBBER))
            rim = [
                (a, b + side * 0.004, radius_z + 0.6 * (c - radius_z))
                for a, b, c in _disc(x, side, 0.6 * radius_x, radius_z, 0.006)
            ]
            parts.append((rim, Material.PLAIN, _RIM))
    return parts


def _lights(front: float, rear: float, low: float, high: float) -> list[Part]:
    parts: list[Part] = []
    for side in (1.0, -1.0):
        inner, outer = sorted((side * 0.28, side * 0.46))
        face: Corners = [(front, inner, low), (front, outer, low), (front, outer, high), (front, inner, high)]
        parts.append((face, Material.HEADLIGHT, (0.75, 0.75, 0.75)))
        back: Corners = [(rear, outer, low), (rear, inner, low), (rear, inner, high + 0.04), (rear, outer, high + 0.04)]
        parts.append((back, Material.TAILLIGHT, (0.35, 0.02, 0.02)))
    plate: Corners = [(rear, 0.13, 0.36), (rear, -0.13, 0.36), (rear, -0.13, 0.43), (rear, 0.13, 0.43)]
    parts.append((plate, Material.PLAIN, (0.6, 0.6, 0.55)))
    return parts


@lru_cache(maxsize=64)
def _car(variant: int) -> _Template:
    """A saloon, hatchback or estate (by variant); the wheels assume about 4.5 m by 1.5 m."""
    rear_roof, rear_belt, hood = [(-0.20, -0.36, 0.60), (-0.40, -0.49, 0.62), (-0.44, -0.49, 0.64)][variant]
    shoulder = [0.62, 0.60, 0.58][variant]
    body = _hull((-0.5, 0.5, 0.49, 0.49, 0.14), (-0.5, 0.5, 0.5, 0.5, 0.46))
    upper = _hull((-0.5, 0.5, 0.5, 0.5, 0.46), (-0.49, 0.47, 0.47, 0.46, hood))
    cabin = _hull((rear_belt, 0.24, 0.47, 0.46, shoulder), (rear_roof, 0.06, 0.40, 0.39, 1.0))
    parts: list[Part] = [(face, Material.LACQUER, None) for face in [*body[:4], *upper]]
    parts += [(_inset(body[side], 0.0, 0.003)[:2] + [
        (x, y * 1.005, 0.20) for x, y, _ in _inset(body[side], 0.0, 0.003)[1::-1]
    ], Material.PLAIN, _TRIM) for side in range(4)]  # fmt: skip
    parts += [(face, Material.LACQUER, None) for face in cabin[1:2] + cabin[3:]]
    parts += [(cabin[end], Material.LACQUER, None) for end in (0, 2)]
    parts += [(_inset(cabin[end], 0.10), Material.GLASS, (0.02, 0.022, 0.025)) for end in (0, 2)]
    for side in (1, 3):
        (a, b, c, d) = (np.array(corner) for corner in cabin[side])
        for start, stop in ((0.05, 0.46), (0.51, 0.95)):
            pane = [a + start * (b - a), a + stop * (b - a), d + stop * (c - d), d + start * (c - d)]
            parts.append((_inset([tuple(p) for p in pane], 0.12), Material.GLASS, (0.02, 0.022, 0.025)))
    grille: Corners = [(0.503, -0.24, 0.24), (0.503, 0.24, 0.24), (0.503, 0.24, 0.42), (0.503, -0.24, 0.42)]
    parts.append((grille, Material.PLAIN, _TRIM))
    parts += _lights(0.502, -0.502, 0.42, 0.50)
    return _template(parts + _wheels(4.5, 1.5, (-0.30, 0.31)))


@lru_cache(maxsize=8)
def _van(variant: int) -> _Template:
    """A van (0), a lorry's box (1) or a bus (2)."""
    body = _hull((-0.5, 0.5, 0.5, 0.5, 0.10), (-0.5, 0.44 if variant < 2 else 0.49, 0.49, 0.48, 1.0))
    parts: list[Part] = [(face, Material.LACQUER, None) for face in body]
    front: Corners = [(0.49, -0.43, 0.52), (0.49, 0.43, 0.52), (0.455, 0.42, 0.86), (0.455, -0.42, 0.86)]
    if variant == 2:
        front = [(0.50, -0.45, 0.36), (0.50, 0.45, 0.36), (0.495, 0.45, 0.86), (0.495, -0.45, 0.86)]
    parts.append((_inset(front, 0.0, 0.012), Material.GLASS, (0.02, 0.022, 0.025)))
    spans = [(0.26, 0.42)] if variant < 2 else [(-0.47 + 0.13 * k, -0.36 + 0.13 * k) for k in range(7)]
    low, high = (0.55, 0.84) if variant < 2 else (0.42, 0.84)
    for start, stop in spans:
        for side in (1.0, -1.0):
            y0, y1 = side * 0.503, side * 0.497
            pane: Corners = [(stop, y0, low), (start, y0, low), (start, y1, high), (stop, y1, high)]
            parts.append((pane if side > 0 else pane[::-1], Material.GLASS, (0.02, 0.022, 0.025)))
    rear: Corners = [(-0.503, 0.4, 0.55), (-0.503, -0.4, 0.55), (-0.503, -0.4, 0.85), (-0.503, 0.4, 0.85)]
    if variant != 1:
        parts.append((rear, Material.GLASS, (0.02, 0.022, 0.025)))
    parts += _lights(0.502, -0.502, 0.26, 0.32)
    length, height = [(5.6, 2.3), (7.5, 3.0), (11.5, 3.1)][variant]
    return _template(parts + _wheels(length, height, (-0.30, 0.32)))


@lru_cache(maxsize=8)
def _prism(sides: int) -> _Template:
    angles = np.arange(sides + 1) * 2 * np.pi / sides
    ring = [(0.5 * np.cos(a), 0.5 * np.sin(a)) for a in angles]
    parts: list[Part] = [
        ([(*ring[k], 0.0), (*ring[k + 1], 0.0), (*ring[k + 1], 1.0), (*ring[k], 1.0)], Material.PLAIN, None)
        for k in range(sides)
    ]
    parts.append(([(*ring[k], 1.0) for k in range(sides)], Material.PLAIN, None))
    return _template(parts)


@lru_cache(maxsize=1)
def _box() -> _Template:
    half = (-0.5, 0.5, 0.5, 0.5)
    floor: Corners = [(-0.5, -0.5, 0.0), (-0.5, 0.5, 0.0), (0.5, 0.5, 0.0), (0.5, -0.5, 0.0)]
    faces = [*_hull((*half, 0.0), (*half, 1.0)), floor]
    return _template([(face, Material.PLAIN, None) for face in faces])


_TEXTURES = ("plain", "facade", "foliage", "bark", "lamp", "sign")
"""Textures of solids that are called like their material."""


def _select(solids: Solids, row: int) -> _Template:
    if solids.texture[row] == "vehicle":
        length, height = solids.size[row, 0], solids.size[row, 2]
        choice = int(abs(solids.colour[row]).sum() * 1e4)
        if height > 1.95:
            return _van(2 if length > 9.5 else (1 if length > 6.6 else 0))
        return _car(choice % 3)
    return _prism(8) if solids.shape[row] == "cylinder" else _box()


_FOUNDATION = 0.15
"""Metres that what stands on a slope reaches below the lowest ground along its outline."""


def _raise(corners: Float, owners: Integer, solids: Solids, terrain: Terrain) -> None:
    """Put corners ``(f, 8, 3)`` of solids on the ground: vehicles lie along it, the rest stands upright on its foot."""
    kept, owner = np.unique(owners, return_inverse=True)
    foot, size = solids.centre[kept, :2], solids.size[kept]
    height, slope = terrain.heights(foot), terrain.gradients(foot)
    low = (solids.centre[kept, 2] - size[:, 2] / 2)[owner][:, None]
    vehicle = solids.texture[owners] == "vehicle"
    lying = ((corners[..., :2] - foot[owner][:, None]) * slope[owner][:, None]).sum(axis=-1)
    turned = np.stack([np.cos(solids.yaw[kept]), np.sin(solids.yaw[kept])], axis=1)
    along, across = turned * size[:, :1] / 2, np.stack([-turned[:, 1], turned[:, 0]], axis=1) * size[:, 1:2] / 2
    outline = [foot + i * along + j * across for i in (-1, 0, 1) for j in (-1, 0, 1)]
    lowest = (np.min([terrain.heights(point) for point in outline], axis=0) - height - _FOUNDATION)[owner][:, None]
    founded = (low < 0.05) & (corners[..., 2] < low + 1e-6)
    corners[..., 2] += height[owner][:, None] + np.where(vehicle[:, None], lying, np.where(founded, lowest, 0.0))


def build_mesh(solids: Solids, rows: Integer, terrain: Terrain | None = None) -> Mesh:
    """Turn rows ``(k,)`` of solids into faces; ``owners`` of the mesh refer to rows of ``solids``.

    A terrain raises them by the height of the ground at their middles.
    """
    flat = [int(row) for row in rows if solids.shape[row] != "ellipsoid"]
    templates = [_select(solids, row) for row in flat]
    repeats = np.array([len(template.counts) for template in templates], dtype=np.int64)
    owners = np.repeat(np.array(flat, dtype=np.int64), repeats)
    if flat:
        local = np.concatenate([template.corners for template in templates])
        counts = np.concatenate([template.counts for template in templates]).astype(np.int64)
        materials = np.concatenate([template.materials for template in templates]).astype(np.int64)
        tints = np.concatenate([template.tints for template in templates])
    else:
        local, counts = np.zeros((0, MOST_CORNERS, 3)), np.zeros(0, dtype=np.int64)
        materials, tints = np.zeros(0, dtype=np.int64), np.zeros((0, 3))
    local = (local - [0.0, 0.0, 0.5]) * solids.size[owners][:, None, :]
    cosine, sine = np.cos(solids.yaw[owners])[:, None], np.sin(solids.yaw[owners])[:, None]
    corners = np.empty_like(local)
    corners[..., 0] = cosine * local[..., 0] - sine * local[..., 1]
    corners[..., 1] = sine * local[..., 0] + cosine * local[..., 1]
    corners[..., 2] = local[..., 2]
    corners += solids.centre[owners][:, None, :]
    if terrain is not None and flat:
        _raise(corners, owners, solids, terrain)
    # Newell's rule: also right for faces whose first corners lie on one line.
    following = np.where(
        np.arange(MOST_CORNERS)[None, :] + 1 < counts[:, None], (np.arange(MOST_CORNERS)[None, :] + 1) % MOST_CORNERS, 0
    )
    after = np.take_along_axis(corners, following[..., None].repeat(3, axis=2), axis=1)
    used = (np.arange(MOST_CORNERS)[None, :] < counts[:, None])[..., None]
    origin = corners[:, :1]
    normals = np.where(used, np.cross(corners - origin, after - origin), 0.0).sum(axis=1)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    plain = (materials == Material.PLAIN) & (tints[:, 0] < 0)
    own = np.full(len(solids.texture), int(Material.PLAIN), dtype=np.int64)
    for texture in _TEXTURES:
        own[solids.texture == texture] = Material[texture.upper()]
    materials[plain] = own[owners[plain]]
    materials[(materials == Material.FACADE) & (normals[:, 2] > 0.5)] = Material.ROOF
    colours = np.where(tints < 0, solids.colour[owners], tints)

    round_ones = np.array([int(row) for row in rows if solids.shape[row] == "ellipsoid"], dtype=np.int64)
    yaw = solids.yaw[round_ones]
    centre = solids.centre[round_ones]
    if terrain is not None:
        centre[:, 2] += terrain.heights(centre[:, :2])
    balls = np.column_stack([centre, solids.size[round_ones] / 2, np.cos(yaw), np.sin(yaw)])
    return Mesh(
        corners, counts, normals, materials, owners, colours,
        balls, own[round_ones], round_ones, solids.colour[round_ones],
    )  # fmt: skip


def join(first: Mesh, second: Mesh) -> Mesh:
    """Put two meshes of the same solids into one."""
    return Mesh(*(np.concatenate(pair) for pair in zip(first, second, strict=True)))
