"""Kerbs: ground beside the road that lies a step higher, and rays that meet the step.

A ray is followed back from where it meets the ground of the road to where it passed the height of the step, and from
there forward again. Along the way, the distance to the road's edge says how far nothing changes.
"""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np
import shapely
from numpy.typing import NDArray

from mapfusion.arrays import Byte, Float, Float32, Integer32
from predmapnet.demo_world.render.jit import kernel, part
from predmapnet.demo_world.render.relief import Relief, ground_height
from predmapnet.demo_world.world import World

ROAD, TOP, FACE = 0, 1, 2
"""Kinds of ground that a ray may meet."""
TEXEL, COARSE = 0.1, 2
"""Metres between known distances to the road's edge, and how many of them lie between known heights."""
MARGIN = 90.0
"""Metres around the trajectory within which kerbs have height: beyond, the step is a pixel or two."""
REACH = 30.0
"""Metres from the road's edge up to which distances are known."""
_EXACT = 0.6
"""Metres from the road's edge up to which they are measured from the edges themselves, not from a picture of them."""
DROPPED, RAMP = 1.0, 1.0
"""Metres around crossings and driveways without a step, and metres of the ramp that leads up from there."""
DRIVEWAY = 4.8
"""Metres of width below which a dead end of the road is a driveway."""
_STEPS = 24
_MILLIMETRES = 1000.0
_SURE_SIGN = 0.15
"""Metres from the road's edge beyond which the filled picture of the road tells sides apart."""


class Kerbs(NamedTuple):
    """Ground beside the road that lies higher, as plain numbers.

    Attributes:
        clear: ``(rows, columns) int16``, millimetres from the texel's middle to the road's edge, negative beside the
            road, at most :data:`REACH` from zero.
        rise: ``(rows / 2, columns / 2) uint8``, share of the height, 255 being all of it.
        x, y: corner of texel (0, 0), metres.
        height: metres.
        tone: albedo of the faces that is mixed with that of the kerb's top.
    """

    clear: NDArray[np.int16]
    rise: Byte
    x: float
    y: float
    height: float
    tone: float


def kerbs_of(world: World, road: shapely.Geometry) -> Kerbs | None:
    """Measure the kerbs of a world along its drivable surface; None where they lie in the road's plane."""
    if world.kerb_height == 0:
        return None
    positions = world.trajectory.ego_to_global[:, :2, 3]
    low, high = np.floor(positions.min(axis=0) - MARGIN), np.ceil(positions.max(axis=0) + MARGIN)
    columns, rows = np.round((high - low) / TEXEL).astype(int)
    near = road.intersection(shapely.box(*low, *high).buffer(REACH))
    inside = np.zeros((rows, columns), dtype=np.uint8)
    _fill(inside, near, low, TEXEL)
    # The picture is good to half a texel, and OpenCV's distances to 2 %.
    away = [cv2.distanceTransform(side, cv2.DIST_L2, 5) * (0.97 * TEXEL) for side in (inside, 1 - inside)]
    distance = np.clip(away[0] + away[1] - TEXEL, _EXACT, REACH)
    clear = (np.where(inside > 0, distance, -distance) * _MILLIMETRES).astype(np.int16)
    measure_edges((_edges(near) - np.tile(low, 2)) / TEXEL, inside, clear)
    tone = float(np.random.default_rng([world.seed, 73]).uniform(0.10, 0.36))
    rise = _rise(world, near, low, (rows // COARSE, columns // COARSE))
    return Kerbs(clear, rise, float(low[0]), float(low[1]), world.kerb_height, tone)


def _fill(picture: Byte, geometry: shapely.Geometry, low: Float, texel: float) -> None:
    for polygon in shapely.get_parts(geometry):
        if isinstance(polygon, shapely.Polygon):
            rings = [shapely.get_coordinates(ring) for ring in (polygon.exterior, *polygon.interiors)]
            corners = [np.round(((ring - low) / texel - 0.5) * 16).astype(np.int32) for ring in rings]
            cv2.fillPoly(picture, corners, 1, cv2.LINE_8, 4)


def _edges(road: shapely.Geometry) -> Float:
    """Both ends ``(n, 4)`` of all edges, the road on their left."""
    edges: list[Float] = []
    for polygon in shapely.get_parts(road):
        if isinstance(polygon, shapely.Polygon):
            oriented = shapely.geometry.polygon.orient(polygon)
            rings = [shapely.get_coordinates(ring) for ring in (oriented.exterior, *oriented.interiors)]
            edges += [np.hstack([ring[:-1], ring[1:]]) for ring in rings]
    return np.concatenate(edges) if edges else np.zeros((0, 4))


def _rise(world: World, road: shapely.Geometry, low: Float, size: tuple[int, int]) -> Byte:
    """Share of the height at each place: none around crossings and driveways, then a ramp."""
    wide = road.buffer(-DRIVEWAY / 2, join_style="mitre").buffer(DRIVEWAY / 2 + 0.2, join_style="mitre")
    narrow = [piece for piece in shapely.get_parts(road.difference(wide)) if piece.area > 3.0]
    # What goes on at its other end, like a lane beside a median, is no driveway.
    driveways = [piece for piece in narrow if len(shapely.get_parts(piece.buffer(0.05).intersection(wide))) < 2]
    level = np.zeros(size, dtype=np.uint8)
    for polygon in [*(crossing.polygon for crossing in world.map.crossings), *driveways]:
        _fill(level, polygon, low, TEXEL * COARSE)
    away = cv2.distanceTransform(1 - level, cv2.DIST_L2, 5) * (TEXEL * COARSE)
    return np.asarray(np.clip((away - DROPPED) / RAMP, 0, 1) * 255, dtype=np.uint8)


@kernel
def measure_edges(edges: Float, inside: Byte, clear: NDArray[np.int16]) -> None:
    """Lower ``clear`` to the distance from each texel's middle to ``edges (n, 4)``, texels, the road on their left.

    ``inside`` is the road as a picture, good to half a texel: next to an edge, the edge itself says which side it is.
    """
    reach = _EXACT / TEXEL
    for index in range(len(edges)):
        x, y = edges[index, 0], edges[index, 1]
        along_x, along_y = edges[index, 2] - x, edges[index, 3] - y
        square = along_x * along_x + along_y * along_y
        if square < 1e-12:
            continue
        first, last = int(min(y, y + along_y) - reach), int(max(y, y + along_y) + reach)
        left, right = int(min(x, x + along_x) - reach), int(max(x, x + along_x) + reach)
        for row in range(max(first, 0), min(last + 1, clear.shape[0])):
            for column in range(max(left, 0), min(right + 1, clear.shape[1])):
                dx, dy = column + 0.5 - x, row + 0.5 - y
                share = (dx * along_x + dy * along_y) / square
                ends = share < 0 or share > 1
                share = min(1.0, max(0.0, share))
                dx, dy = dx - share * along_x, dy - share * along_y
                away = np.sqrt(dx * dx + dy * dy) * TEXEL
                if away * _MILLIMETRES >= abs(clear[row, column]):
                    continue
                on_road = inside[row, column] > 0
                if away < _SURE_SIGN and not ends:
                    on_road = along_x * dy - along_y * dx > 0
                clear[row, column] = (away if on_road else -away) * _MILLIMETRES


@part
def clearance(kerbs: Kerbs, x: float, y: float) -> float:
    """Metres from a place to the road's edge, negative beside the road; :data:`REACH` where nothing is known."""
    u, v = (x - kerbs.x) / TEXEL - 0.5, (y - kerbs.y) / TEXEL - 0.5
    if not (u >= 0 and v >= 0 and u < kerbs.clear.shape[1] - 1 and v < kerbs.clear.shape[0] - 1):
        return REACH
    column, row = int(u), int(v)
    u, v = u - column, v - row
    top = kerbs.clear[row, column] * (1 - u) + kerbs.clear[row, column + 1] * u
    low = kerbs.clear[row + 1, column] * (1 - u) + kerbs.clear[row + 1, column + 1] * u
    return float((top * (1 - v) + low * v) / _MILLIMETRES)


@part
def rise_at(kerbs: Kerbs, x: float, y: float) -> float:
    """Height of the ground beside the road above the plane of the road, at a place that is known."""
    u, v = (x - kerbs.x) / (TEXEL * COARSE) - 0.5, (y - kerbs.y) / (TEXEL * COARSE) - 0.5
    column = min(max(int(u), 0), kerbs.rise.shape[1] - 2)
    row = min(max(int(v), 0), kerbs.rise.shape[0] - 2)
    u, v = min(max(u - column, 0.0), 1.0), min(max(v - row, 0.0), 1.0)
    top = kerbs.rise[row, column] * (1 - u) + kerbs.rise[row, column + 1] * u
    low = kerbs.rise[row + 1, column] * (1 - u) + kerbs.rise[row + 1, column + 1] * u
    return float(kerbs.height * (top * (1 - v) + low * v) / 255.0)


@part
def meet_step(
    kerbs: Kerbs, x: float, y: float, ray_x: float, ray_y: float, fall: float, most: float, least: float
) -> tuple[float, int, float]:
    """Follow a ray that meets the plane of the road at a place, from where it passed the height of the step.

    Args:
        kerbs: the steps.
        x, y: the place.
        ray_x, ray_y: the ray, seen from above.
        fall: how fast it approaches that plane, positive.
        most: how many times the ray may be followed back.
        least: metres of the shortest step.

    Returns:
        How many times the ray before the place it meets the ground, which kind of it, and a distance from there
        within which no edge lies.
    """
    level = np.sqrt(ray_x * ray_x + ray_y * ray_y) + 1e-9
    back = min(kerbs.height / fall, most)
    nearest = REACH
    over_road, before, behind = False, 0.0, 0.0
    for _ in range(_STEPS):
        here_x, here_y = x - back * ray_x, y - back * ray_y
        gap = clearance(kerbs, here_x, here_y)
        nearest = min(nearest, abs(gap))
        if gap > 0:
            if gap >= back * level:
                return 0.0, ROAD, min(nearest, gap - back * level)
            over_road, before, behind = True, gap, back
            back = max(0.0, back - max(gap, least) / level)
            continue
        above = back * fall - rise_at(kerbs, here_x, here_y)
        if over_road and above < 0:
            # A ray that comes from over the road and is already below the top has met the face: between the two steps.
            return back + (behind - back) * gap / (gap - before), FACE, 0.0
        if above <= 1e-4 or back <= 0:
            return back, TOP, nearest
        over_road = False
        back = max(0.0, back - max(above / fall, least / level))
    return 0.0, ROAD, 0.0


@part
def out_of_face(kerbs: Kerbs, x: float, y: float) -> tuple[float, float]:
    """The horizontal direction from a kerb towards the road."""
    east = clearance(kerbs, x + TEXEL, y) - clearance(kerbs, x - TEXEL, y)
    north = clearance(kerbs, x, y + TEXEL) - clearance(kerbs, x, y - TEXEL)
    length = np.sqrt(east * east + north * north) + 1e-9
    return east / length, north / length


@part
def in_kerb_shadow(kerbs: Kerbs, x: float, y: float, sun: Float32, gap: float) -> bool:
    """Whether a kerb keeps the sun from a place on the road, ``gap`` metres from its edge."""
    level = np.sqrt(sun[0] * sun[0] + sun[1] * sun[1])
    if sun[2] <= 0 or gap * sun[2] > kerbs.height * level:
        return False
    travelled = 0.0
    for _ in range(6):
        travelled += max(gap, 0.02)
        here_x, here_y = x + travelled * sun[0] / level, y + travelled * sun[1] / level
        if travelled * sun[2] > kerbs.height * level:
            return False
        gap = clearance(kerbs, here_x, here_y)
        if gap < 0:
            return bool(rise_at(kerbs, here_x, here_y) * level > travelled * sun[2])
    return False


@kernel
def step_along(kerbs: Kerbs, relief: Relief | None, start: Float, rays: Float, ids: Integer32, distance: Float) -> None:
    """Shorten ``distance (n,)`` of unit ``rays (n, 3)`` whose ``ids`` say ground, -1, to where each meets a kerb."""
    for index in range(len(rays)):
        ray_x, ray_y, far = rays[index, 0], rays[index, 1], distance[index]
        if ids[index] >= 0 or not far < np.inf:
            continue
        x, y, fall = start[0] + far * ray_x, start[1] + far * ray_y, -rays[index, 2]
        if relief is not None:
            _, east, north = ground_height(relief, x, y)
            fall += east * ray_x + north * ray_y
        back = meet_step(kerbs, x, y, ray_x, ray_y, max(fall, 1e-3), 0.5 * far, 0.01)[0]
        distance[index] = far - back


@kernel
def heights_at(kerbs: Kerbs, points: Float, heights: Float) -> None:
    """Write to ``heights (n,)`` how far above the plane of the road the ground lies at ``points (n, 2+)``."""
    for index in range(len(points)):
        beside = clearance(kerbs, points[index, 0], points[index, 1]) < 0
        heights[index] = rise_at(kerbs, points[index, 0], points[index, 1]) if beside else 0.0
