"""Share of the painted road in view that is hidden behind things: how hard a scene is to see."""

from __future__ import annotations

import numpy as np
import shapely

from mapfusion.arrays import Float
from mapfusion.elements import RegionOfInterest
from mapfusion.geometry import inverse_pose
from predmapnet.demo_world.render.renderer import Renderer
from predmapnet.scenes import Rig


def painted_points(renderer: Renderer, spacing: float = 0.5) -> Float:
    """Points along all dividers and around all crossings of a world, ``(n, 2)`` metres, global frame."""
    lines = [shapely.LineString(divider.points) for divider in renderer.world.map.dividers]
    lines += [crossing.polygon.exterior for crossing in renderer.world.map.crossings]
    points: Float = shapely.get_coordinates([shapely.segmentize(line, spacing) for line in lines])
    return points


def hidden_share(renderer: Renderer, rig: Rig, frame_index: int, roi: RegionOfInterest) -> tuple[int, int]:
    """Count painted points in the region that the cameras look at, and how many of them no camera sees.

    Args:
        renderer: of the world.
        rig: cameras; the images' size sets how precisely edges count.
        frame_index: key frame.
        roi: the region around the ego car.

    Returns:
        Number of points hidden by solids, number of points in some camera's image.
    """
    ego_to_global = renderer.world.trajectory.ego_to_global[frame_index]
    points = painted_points(renderer)
    terrain = renderer.world.terrain
    height = np.zeros(len(points)) if terrain is None else terrain.heights(points)
    points = np.column_stack([points, height, np.ones(len(points))])
    ego = points @ inverse_pose(ego_to_global).T
    inside = (np.abs(ego[:, 0]) <= roi.length / 2) & (np.abs(ego[:, 1]) <= roi.width / 2)
    ego = ego[inside]
    in_view, seen = np.zeros(len(ego), dtype=bool), np.zeros(len(ego), dtype=bool)
    mesh, _, _ = renderer.mesh_at(frame_index)
    for camera in rig:
        local = (ego @ inverse_pose(camera.camera_to_ego).T)[:, :3]
        depth = local[:, 2]
        ahead = depth > 0.5
        pixel = (local @ camera.intrinsics.T)[:, :2] / np.where(ahead, depth, 1.0)[:, None]
        framed = ahead & (pixel >= 0).all(axis=1) & (pixel < [camera.width, camera.height]).all(axis=1)
        nearness = renderer.rasterise(mesh, renderer.view(camera, frame_index), 1).nearness
        column, row = np.floor(pixel[framed]).astype(int).T
        in_view |= framed
        seen[np.flatnonzero(framed)[nearness[row, column] * depth[framed] < 1.0]] = True
    return int((in_view & ~seen).sum()), int(in_view.sum())
