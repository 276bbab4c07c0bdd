"""The lidar on the roof: a sweep of 32 beams over the same solids and ground that the cameras see."""

from __future__ import annotations

from functools import cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from mapfusion.arrays import Float
from predmapnet.demo_world.render.kerbs import step_along
from predmapnet.demo_world.render.mesh import Mesh
from predmapnet.demo_world.render.relief import Relief, meet_along
from predmapnet.demo_world.render.renderer import Renderer
from predmapnet.demo_world.rig import LIDAR_TO_EGO
from predmapnet.scenes import Camera

BEAMS = 32
AZIMUTHS = 1080
LOWEST, HIGHEST = np.radians(-30.67), np.radians(10.67)
"""Elevation of the outer beams, as on the Velodyne HDL-32E of nuScenes."""
RANGE = 70.0
"""Metres."""
_SIDE = 640
"""Pixels of each of the four square images in which rays look up what they meet (about 0.16 degrees)."""


def _hit_distance(mesh: Mesh, relief: Relief | None, ids: NDArray[np.int32], origin: Float, rays: Float) -> Float:
    """Exact distance from ``origin`` along unit ``rays`` (n, 3) to the face or ellipsoid of each id; -1 is ground."""
    distance = np.full(len(rays), np.inf)
    if relief is None:
        down = (ids < 0) & (rays[:, 2] < 0)
        distance[down] = -origin[2] / rays[down, 2]
    flat = (ids >= 0) & (ids < len(mesh.counts))
    normals, corners = mesh.normals[ids[flat]], mesh.corners[ids[flat], 0]
    facing = np.einsum("ni,ni->n", normals, rays[flat])
    with np.errstate(divide="ignore"):
        distance[flat] = np.einsum("ni,ni->n", normals, corners - origin) / facing
    round_ones = ids >= len(mesh.counts)
    balls = mesh.balls[ids[round_ones] - len(mesh.counts)]
    if len(balls):
        cosine, sine = balls[:, 6], balls[:, 7]
        turn = np.zeros((len(balls), 3, 3))
        turn[:, 0, 0], turn[:, 0, 1], turn[:, 1, 0], turn[:, 1, 1], turn[:, 2, 2] = cosine, sine, -sine, cosine, 1
        turn /= balls[:, 3:6, None]
        start = np.einsum("nij,nj->ni", turn, origin - balls[:, :3])
        ray = np.einsum("nij,nj->ni", turn, rays[round_ones])
        square, half = (ray * ray).sum(axis=1), (ray * start).sum(axis=1)
        inside = half**2 - square * ((start * start).sum(axis=1) - 1)
        distance[round_ones] = np.where(inside >= 0, (-half - np.sqrt(np.maximum(inside, 0))) / square, np.inf)
    if relief is not None:
        meet_along(relief, origin, rays, distance)
    return distance


class _Sector(NamedTuple):
    """A quarter of the sweep: the image it is looked up in, its rays, and the rows and columns of their pixels."""

    camera_to_lidar: Float
    chosen: NDArray[np.int64]
    rows: NDArray[np.int64]
    columns: NDArray[np.int64]


@cache
def _sweep() -> tuple[Float, NDArray[np.int64], tuple[_Sector, ...]]:
    """Unit rays ``(n, 3)`` of a sweep, lidar frame, their rings, and its quarters."""
    elevation = np.repeat(np.linspace(LOWEST, HIGHEST, BEAMS), AZIMUTHS)
    azimuth = np.tile(np.arange(AZIMUTHS) * 2 * np.pi / AZIMUTHS, BEAMS)
    rays = np.stack(
        [np.sin(azimuth) * np.cos(elevation), np.cos(azimuth) * np.cos(elevation), np.sin(elevation)], axis=1
    )
    quarter = np.floor((azimuth + np.pi / 4) / (np.pi / 2)).astype(int) % 4
    sectors = []
    for number in range(4):
        turn = number * np.pi / 2
        right = np.array([np.cos(turn), -np.sin(turn), 0.0])
        forward = np.array([np.sin(turn), np.cos(turn), 0.0])
        camera_to_lidar = np.eye(4)
        camera_to_lidar[:3, :3] = np.stack([right, [0.0, 0.0, -1.0], forward], axis=1)
        chosen = np.flatnonzero(quarter == number)
        local = rays[chosen] @ camera_to_lidar[:3, :3]
        columns, rows = np.clip((local[:, :2] / local[:, 2:] + 1) * (_SIDE / 2), 0, _SIDE - 1).astype(int).T
        sectors.append(_Sector(camera_to_lidar, chosen, rows, columns))
    return rays, np.repeat(np.arange(BEAMS), AZIMUTHS), tuple(sectors)


def scan(renderer: Renderer, frame_index: int, lidar_to_ego: Float = LIDAR_TO_EGO) -> NDArray[np.float32]:
    """Sweep the scene once at a key frame; lidar axes are those of nuScenes: x right, y forward, z up.

    Returns:
        ``(n, 5) float32``: x, y, z in metres, lidar frame; intensity in [0, 255]; ring in [0, 31]. Rays that meet
        nothing within 70 m are left out.
    """
    mesh, _, _ = renderer.mesh_at(frame_index)
    lidar_to_global = renderer.world.trajectory.ego_to_global[frame_index] @ lidar_to_ego
    origin = lidar_to_global[:3, 3]
    rays, ring, sectors = _sweep()
    rays_global = rays @ lidar_to_global[:3, :3].T
    distance, ids = np.full(len(rays), np.inf), np.full(len(rays), -1, dtype=np.int32)
    half = _SIDE / 2
    intrinsics = np.array([[half, 0.0, half], [0.0, half, half], [0.0, 0.0, 1.0]])
    for sector in sectors:
        eye = Camera("lidar", _SIDE, _SIDE, intrinsics, lidar_to_ego @ sector.camera_to_lidar)
        buffer = renderer.rasterise(mesh, renderer.view(eye, frame_index), 1).ids
        chosen = sector.chosen
        ids[chosen] = buffer[sector.rows, sector.columns]
        met = _hit_distance(mesh, renderer.relief, ids[chosen], origin, rays_global[chosen])
        if renderer.kerbs is not None:
            step_along(renderer.kerbs, renderer.relief, origin, rays_global[chosen], ids[chosen], met)
        distance[chosen] = met
    generator = np.random.default_rng([renderer.world.seed, 53, frame_index])
    noisy = distance + generator.normal(0, 0.015, len(distance))
    kept = (distance > 1.0) & (distance < RANGE)
    bright = np.where(ids < 0, 12.0, 28.0) * np.exp(-np.where(kept, distance, 0.0) / 60)
    intensity = np.clip(bright * np.exp(generator.normal(0, 0.4, len(bright))), 0, 255).round()
    points = rays * np.where(kept, noisy, 0.0)[:, None]
    return np.column_stack([points, intensity, ring])[kept].astype(np.float32)
