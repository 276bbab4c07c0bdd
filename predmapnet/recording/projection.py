"""Lines in pictures: project into a camera, cut where they leave it; dashes; BEV pixels."""

from __future__ import annotations

import numpy as np
import shapely

from mapfusion.arrays import Bool, Float
from mapfusion.elements import RegionOfInterest
from mapfusion.geometry import arc_length
from predmapnet.scenes import Camera

NEAR_METRES = 1.0
"""Points nearer to the camera plane than this are cut off: their projection runs away."""


def true_runs(mask: Bool) -> list[slice]:
    """Return the stretches of at least two consecutive true values."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], mask, [False]]).astype(np.int8)))
    return [slice(start, stop) for start, stop in edges.reshape(-1, 2).tolist() if stop - start >= 2]


def project_line(points: Float, camera: Camera, spacing: float = 0.5) -> list[Float]:
    """Project a line ``(n, 2)`` on the road, ego frame, every ``spacing`` metres, into a picture.

    Returns the parts that are seen, ``(k, 2)`` pixels each.
    """
    dense = shapely.get_coordinates(shapely.segmentize(shapely.LineString(points), spacing))
    lifted = np.column_stack([dense, np.full(len(dense), camera.ground_height)])
    rotation, position = camera.camera_to_ego[:3, :3], camera.camera_to_ego[:3, 3]
    rays = (lifted - position) @ rotation @ camera.intrinsics.T
    ahead = rays[:, 2] > NEAR_METRES
    pixels = rays[:, :2] / np.where(ahead, rays[:, 2], 1.0)[:, None]
    border = shapely.box(0, 0, camera.width, camera.height)
    lines = [shapely.LineString(pixels[run]) for run in true_runs(ahead)]
    parts = shapely.get_parts(shapely.intersection(lines, border))
    return [shapely.get_coordinates(part) for part in parts if part.geom_type == "LineString" and not part.is_empty]


def dashes(points: Float, dash: float = 0.7, gap: float = 0.5) -> list[Float]:
    """Cut a line ``(n, 2)`` into dashes, lengths in metres."""
    distance = arc_length(points)
    starts = np.arange(0.0, distance[-1], dash + gap)
    stations = np.stack([starts, np.minimum(starts + dash, distance[-1])], axis=1)
    ends = np.stack([np.interp(stations, distance, points[:, axis]) for axis in range(2)], axis=-1)
    return list(ends)


def bev_pixels(points: Float, roi: RegionOfInterest, shape: tuple[int, int]) -> Float:
    """Map points ``(n, 2)`` of the ego frame to pixels of a BEV raster (row 0: largest y, column 0: smallest x).

    Returns column and row, pixel centres at ``+0.5``.
    """
    rows, columns = shape
    column = (points[:, 0] / roi.length + 0.5) * columns
    row = (0.5 - points[:, 1] / roi.width) * rows
    return np.stack([column, row], axis=1)
