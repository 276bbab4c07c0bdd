"""The ground of a world as a picture from above: surfaces, kerbs, cracks, paint, wear and standing shadows."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import cv2
import numpy as np
import shapely
from numpy.typing import NDArray
from shapely import Polygon

from mapfusion.arrays import Byte, Float
from predmapnet.demo_world.render.ground_kernels import compose, edge_lines, fill_materials, fill_paint, halve
from predmapnet.demo_world.render.noise import fractal_tile
from predmapnet.demo_world.render.paint import paint_quads, ribbon
from predmapnet.demo_world.render.shadows import contact_polygons, shadow_polygons
from predmapnet.demo_world.street.looks import Light
from predmapnet.demo_world.world import World

FINE_MARGIN = 50.0
"""Metres around the trajectory that are painted finely."""
COARSE_MARGIN = 260.0
FINE_TEXEL, COARSE_TEXEL = 0.05, 0.3
MOST_TEXELS = 40e6
LEVELS = 7

MATERIALS: dict[str, tuple[float, float, float, float, float, float, float]] = {
    # red, green, blue albedo; grain, blotches, drift; pattern: 1 slabs, 2 growth, 3 brick
    "grass": (0.075, 0.110, 0.035, 0.55, 0.45, 0.30, 2.0),
    "soil": (0.170, 0.130, 0.090, 0.30, 0.30, 0.25, 0.0),
    "gravel": (0.210, 0.195, 0.170, 0.50, 0.20, 0.20, 0.0),
    "concrete": (0.300, 0.290, 0.265, 0.08, 0.14, 0.15, 1.0),
    "sidewalk": (0.330, 0.320, 0.295, 0.09, 0.16, 0.18, 1.0),
    "paving": (0.260, 0.235, 0.215, 0.12, 0.15, 0.15, 3.0),
    "brick": (0.230, 0.130, 0.095, 0.15, 0.18, 0.15, 3.0),
    "asphalt": (0.100, 0.099, 0.098, 0.22, 0.13, 0.16, 0.0),
    "asphalt_old": (0.165, 0.160, 0.152, 0.24, 0.18, 0.20, 0.0),
    "asphalt_new": (0.055, 0.055, 0.057, 0.20, 0.09, 0.10, 0.0),
    "tar": (0.040, 0.040, 0.042, 0.12, 0.06, 0.05, 0.0),
    "iron": (0.075, 0.070, 0.066, 0.35, 0.10, 0.00, 0.0),
    "kerb_light": (0.420, 0.410, 0.385, 0.10, 0.14, 0.12, 0.0),
    "kerb_grey": (0.240, 0.235, 0.225, 0.12, 0.18, 0.15, 0.0),
    "kerb_dark": (0.135, 0.130, 0.122, 0.15, 0.20, 0.15, 0.0),
    "slab": (0.235, 0.230, 0.215, 0.10, 0.12, 0.15, 0.0),
    "rail": (0.270, 0.262, 0.250, 0.20, 0.10, 0.05, 0.0),
    "leaves": (0.150, 0.085, 0.035, 0.60, 0.40, 0.20, 0.0),
    "red_asphalt": (0.180, 0.075, 0.060, 0.20, 0.14, 0.15, 0.0),
    "green_asphalt": (0.065, 0.130, 0.080, 0.20, 0.14, 0.15, 0.0),
    "gutter": (0.215, 0.210, 0.200, 0.12, 0.18, 0.18, 0.0),
}
_INDEX = {name: index for index, name in enumerate(MATERIALS)}


class Pyramid(NamedTuple):
    """A texture with all its halvings, as arrays for compiled loops.

    Attributes:
        texels: ``(n, 4) uint8``: square roots of albedo and the light that shadows leave, level after level.
        levels: ``(3, levels) int64``, where each level begins, its rows and its columns.
        base, paint: ``(rows, columns, 4)`` and ``(rows, columns, 3) uint8``: the finest level before painting, and
            the paint (coverage, albedo, yellow), with which near edges are drawn sharply.
        placement: origin x, y (metres), cosine and sine of the texture's turn, texels per metre.
    """

    texels: Byte
    levels: NDArray[np.int64]
    base: Byte
    paint: Byte
    placement: tuple[float, float, float, float, float]


@dataclass(frozen=True)
class _Sheet:
    """A texture in the making: a turned rectangle of the ground."""

    origin: Float
    turn: Float
    texel: float
    rows: int
    columns: int

    def to_texels(self, points: Float) -> Float:
        """Map ``(..., 2)`` metres, global frame, to texels (column, row)."""
        moved: Float = (points - self.origin) @ self.turn.T / self.texel
        return moved


def _sheet(positions: Float, margin: float, texel: float, turn: Float, anchor: Float) -> _Sheet:
    local = (positions - anchor) @ turn.T
    low, high = local.min(axis=0) - margin, local.max(axis=0) + margin
    texel = max(texel, float(np.sqrt(np.prod(high - low) / MOST_TEXELS)))
    step = 2**LEVELS
    columns, rows = (np.ceil((high - low) / texel / step) * step).astype(int)
    # Whole metres, so that patterns of the fine and the coarse sheet fall on each other.
    return _Sheet(anchor + np.floor(low) @ turn, turn, texel, int(rows), int(columns))


def _fill(image: Byte, sheet: _Sheet, polygon: Polygon, value: int) -> None:
    """Set all texels of a polygon, holes left out."""
    if polygon.is_empty:
        return
    low, high = sheet.to_texels(np.asarray(polygon.bounds).reshape(2, 2)), np.array([sheet.columns, sheet.rows])
    corners = sheet.to_texels(np.asarray(shapely.box(*polygon.bounds).exterior.coords))
    if (corners.max(axis=0) < 0).any() or (corners.min(axis=0) > high).any() or not np.isfinite(low).all():
        return
    rings = [polygon.exterior, *polygon.interiors]
    # fillPoly takes integer positions of texel centres; 4 fractional bits.
    contours = [
        np.round((sheet.to_texels(np.asarray(ring.coords)[:, :2]) - 0.5) * 16).astype(np.int32) for ring in rings
    ]
    cv2.fillPoly(image, contours, value, cv2.LINE_8, 4)


def _fill_quads(image: Byte, sheet: _Sheet, quads: Float, value: int) -> None:
    points = sheet.to_texels(quads.reshape(-1, 2)).reshape(-1, 4, 2)
    inside = (points.max(axis=1) > 0).all(axis=1) & (points.min(axis=1) < [sheet.columns, sheet.rows]).all(axis=1)
    for corners in np.round((points[inside] - 0.5) * 16).astype(np.int32):
        cv2.fillConvexPoly(image, corners, value, cv2.LINE_8, 4)


def road_of(world: World) -> shapely.Geometry:
    """The whole drivable surface as one geometry, hairline seams between segments closed."""
    united = shapely.union_all([segment.buffer(0.02, join_style="mitre") for segment in world.map.road_segments])
    return united.buffer(-0.02, join_style="mitre")


def _rings(geometry: shapely.Geometry) -> list[Float]:
    """Closed rings with the surface on their left, ``(n, 2)`` each."""
    rings: list[Float] = []
    for polygon in shapely.get_parts(geometry):
        oriented = shapely.geometry.polygon.orient(polygon)
        rings += [np.asarray(ring.coords)[:, :2] for ring in [oriented.exterior, *oriented.interiors]]
    return rings


def _draw_kerbs(
    material: Byte,
    sheet: _Sheet,
    road: shapely.Geometry,
    shares: tuple[float, float, float, float],
    generator: np.random.Generator,
) -> None:
    """A strip outside the road's edge whose material changes along the way; its inner side is the boundary."""
    for ring in _rings(road):
        ring = shapely.get_coordinates(shapely.segmentize(shapely.LineString(ring), 4.0))
        width, gutter = generator.uniform(0.14, 0.24), generator.uniform() < 0.35
        outside, inside = ribbon(ring, width, -width / 2), ribbon(ring, 0.32, 0.16)
        kinds = ["kerb_light", "kerb_grey", "kerb_dark", ""]
        start = 0
        while start < len(outside):
            stop = start + int(generator.integers(4, 20))
            kind = kinds[int(generator.choice(4, p=shares))]
            if kind:
                _fill_quads(material, sheet, outside[start:stop], _INDEX[kind])
            if gutter and kind:
                _fill_quads(material, sheet, inside[start:stop], _INDEX["gutter"])
            start = stop


def _draw_damage(material: Byte, sheet: _Sheet, road: shapely.Geometry, near: Float, seed: int) -> None:
    """Tar patches, sealed cracks and manhole covers on the road near the trajectory."""
    generator = np.random.default_rng([seed, 23])
    shapely.prepare(road)
    for position, heading in zip(near[:, :2], near[:, 2], strict=True):
        for _ in range(3):
            spot = position + generator.uniform(-14, 14, 2)
            direction = np.array([np.cos(heading), np.sin(heading)])
            kind = generator.uniform()
            if not road.contains(shapely.Point(spot).buffer(1.2)):
                continue
            if kind < 0.16:
                length, width = generator.uniform(0.8, 7.0), generator.uniform(0.4, 1.6)
                tone = ["tar", "asphalt_new", "asphalt_old"][int(generator.integers(3))]
                line = np.array([spot - direction * length / 2, spot + direction * length / 2])
                _fill_quads(material, sheet, ribbon(line, width), _INDEX[tone])
            elif kind < 0.62:
                angle = heading + generator.choice([0.0, np.pi / 2]) + generator.normal(0, 0.2)
                turns = angle + np.cumsum(generator.normal(0, 0.22, int(generator.integers(6, 26))))
                walk = spot + 0.4 * np.cumsum(np.stack([np.cos(turns), np.sin(turns)], axis=1), axis=0)
                _fill_quads(material, sheet, ribbon(walk, generator.uniform(0.02, 0.07)), _INDEX["tar"])
            elif kind < 0.72:
                _fill(material, sheet, shapely.Point(spot).buffer(0.33), _INDEX["iron"])


def _fill_convex(image: Byte, sheet: _Sheet, polygons: list[tuple[Float, int]]) -> None:
    """Darken convex polygons to a value each; of overlapping ones the darkest wins."""
    if not polygons:
        return
    polygons = sorted(polygons, key=lambda pair: -pair[1])
    lengths = np.array([len(polygon) for polygon, _ in polygons])
    starts = np.concatenate([[0], np.cumsum(lengths)[:-1]])
    points = sheet.to_texels(np.concatenate([polygon for polygon, _ in polygons]))
    low, high = np.minimum.reduceat(points, starts), np.maximum.reduceat(points, starts)
    inside = (high > 0).all(axis=1) & (low < [sheet.columns, sheet.rows]).all(axis=1)
    fixed = np.round((points - 0.5) * 16).astype(np.int32)
    for row in np.flatnonzero(inside):
        cv2.fillConvexPoly(image, fixed[starts[row] : starts[row] + lengths[row]], polygons[row][1], cv2.LINE_8, 4)


class _Darkness(NamedTuple):
    """Outlines that darken the ground: below things that stand, and in their cast shadows."""

    contacts: list[tuple[Float, int]]
    shadows: list[tuple[Float, int]]


def _darkness(world: World, light: Light) -> _Darkness:
    standing = ~world.solids.velocity.any(axis=1) & world.solids.always
    shadows = shadow_polygons(world.solids, standing, light.sun_direction, world.terrain) if light.sun.any() else []
    if light.sun.any():
        shadows = [*shadows, *world.clutter.shadows]
    return _Darkness([*contact_polygons(world.solids, standing), *world.clutter.stains], shadows)


def _shade(sheet: _Sheet, dark: _Darkness) -> tuple[Byte, Byte]:
    """Ambient occlusion and sunlight on the ground, ``(rows, columns)`` each; 255 is fully lit."""
    occlusion = np.full((sheet.rows, sheet.columns), 255, dtype=np.uint8)
    shadow = np.full_like(occlusion, 255)
    _fill_convex(occlusion, sheet, dark.contacts)
    blur = max(1, round(0.5 / sheet.texel)) | 1
    occlusion = np.asarray(cv2.blur(occlusion, (blur, blur)), dtype=np.uint8)
    if dark.shadows:
        _fill_convex(shadow, sheet, dark.shadows)
        soft = max(1, round(0.12 / sheet.texel)) | 1
        shadow = np.asarray(cv2.blur(shadow, (soft, soft)), dtype=np.uint8)
    return occlusion, shadow


def _pyramid(
    sheet: _Sheet,
    world: World,
    light: Light,
    road: shapely.Geometry,
    dark: _Darkness,
    painted: tuple[Float, Float],
    near: Float | None,
) -> Pyramid:
    material = np.full((sheet.rows, sheet.columns), _INDEX["grass"], dtype=np.uint8)
    for surface in world.surfaces:
        for part in shapely.get_parts(surface.polygon):
            _fill(material, sheet, part, _INDEX[surface.material])
    generator = np.random.default_rng([world.seed, 29])
    if near is not None:
        _draw_damage(material, sheet, road, near, world.seed)
        for name, quads in world.clutter.patches:
            _fill_quads(material, sheet, quads, _INDEX[name])
    for crossing in world.map.crossings:
        if crossing.surface:
            for part in shapely.get_parts(crossing.polygon.intersection(road)):
                _fill(material, sheet, part, _INDEX[crossing.surface])
    _draw_kerbs(material, sheet, road, world.clutter.kerbs, generator)
    occlusion, shadow = _shade(sheet, dark)

    table = np.array(list(MATERIALS.values()), dtype=np.float32)
    if light.wetness > 0:
        table[:, :3] *= 1 - 0.5 * light.wetness
    base = np.empty((sheet.rows, sheet.columns, 4), dtype=np.uint8)
    local = sheet.turn @ sheet.origin
    fractal, white = fractal_tile(1.0), fractal_tile(0.0, seed=8)
    fill_materials(material, local[0], local[1], sheet.texel, table, fractal, white, occlusion, shadow, base)

    paint = np.zeros((sheet.rows, sheet.columns, 3), dtype=np.uint8)
    corners, attributes = painted
    attributes = attributes * [1.0, 1 - 0.35 * light.wetness, 1.0]
    quads = sheet.to_texels(corners.reshape(-1, 2)).reshape(-1, 4, 2)
    fill_paint(quads, edge_lines(quads), attributes, fractal_tile(0.75, seed=9), np.empty(4), paint)

    sizes = [(sheet.rows >> level, sheet.columns >> level) for level in range(LEVELS + 1)]
    counts = np.array([rows * columns for rows, columns in sizes])
    starts = np.concatenate([[0], np.cumsum(counts)])
    texels = np.empty((starts[-1], 4), dtype=np.uint8)
    levels = [texels[starts[i] : starts[i + 1]].reshape(*sizes[i], 4) for i in range(LEVELS + 1)]
    compose(base, paint, levels[0])
    for fine, coarse in pairwise(levels):
        halve(fine, coarse)
    x, y, cosine, sine = map(float, (*sheet.origin, *sheet.turn[0]))
    table_of_levels = np.column_stack([starts[:-1], sizes]).T.astype(np.int64, order="C")
    return Pyramid(texels, table_of_levels, base, paint, (x, y, cosine, sine, 1 / sheet.texel))


def paint_ground(world: World, light: Light, texel: float = FINE_TEXEL) -> tuple[Pyramid, Pyramid]:
    """Paint the ground: the fine texture near the trajectory (``texel`` metres), the coarse one of all in sight.

    The light decides the shadows of solids and how wet surfaces darken.
    """
    poses = world.trajectory.ego_to_global
    positions = poses[:, :2, 3]
    anchor = np.round(positions.mean(axis=0))
    # The texture lies along the drive, which keeps the rectangle around it small.
    axis = np.linalg.svd(positions - positions.mean(axis=0), full_matrices=False)[2][0]
    if np.ptp((positions - anchor) @ axis) < 1.0:
        axis = poses[0, :2, 0] / np.linalg.norm(poses[0, :2, 0])
    turn = np.array([[axis[0], axis[1]], [-axis[1], axis[0]]])
    near = np.column_stack([positions, np.arctan2(poses[:, 1, 0], poses[:, 0, 0])])
    road = road_of(world)
    dark = _darkness(world, light)
    corners, attributes = paint_quads(world.map, world.seed)
    clutter = world.clutter
    paint = np.concatenate([corners, clutter.paint]), np.concatenate([attributes, clutter.coats])
    fine = _pyramid(_sheet(positions, FINE_MARGIN, texel, turn, anchor), world, light, road, dark, paint, near)
    wide = _sheet(positions, COARSE_MARGIN, COARSE_TEXEL, turn, anchor)
    coarse = _pyramid(wide, world, light, road, dark, paint, None)
    return fine, coarse
