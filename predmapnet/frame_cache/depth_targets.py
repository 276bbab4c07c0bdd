"""Targets of the auxiliary depth head: the lidar's points as each camera sees them, in bins (MapTRv2, Sec. 3.4).

As in BEVDepth (Li et al. 2023), the nearest point of a feature cell counts, and cells without a point say nothing.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mapfusion.arrays import Float
from predmapnet.config import BevFormerConfig, DepthConfig, PredMapNetConfig
from predmapnet.network.image_input import input_size, window_camera
from predmapnet.network.maptracker.reference_points import LEVEL_STRIDES
from predmapnet.network.small.backbone import STRIDE
from predmapnet.scenes import Camera, Rig

UNKNOWN = -1
"""Target of a cell without a point."""


def depth_targets(points: Float, cameras: Rig, stride: int, config: DepthConfig) -> NDArray[np.int64]:
    """Project a sweep into all cameras.

    Args:
        points: ``(n, 3)``, metres, ego frame.
        cameras: as the network sees them: their size and intrinsics are those of its input.
        stride: pixels of the input per cell of the features.
        config: the bins.

    Returns:
        ``(N, ceil(h / stride), ceil(w / stride)) int64``: bin of each cell, or :data:`UNKNOWN`.
    """
    return np.stack([_of_camera(points, camera, stride, config) for camera in cameras])


def depth_of_frame(points: Float | None, rig: Rig, config: PredMapNetConfig) -> NDArray[np.signedinteger]:
    """Return the targets ``(N, h', w')`` of all cells of a network's features; without a sweep all are unknown.

    Args:
        points: ``(n, 3)``, metres, ego frame, or None.
        rig: the cameras before preprocessing.
        config: of the network.

    Returns:
        As small an integer type as holds the bins.
    """
    stride = LEVEL_STRIDES[0] if isinstance(config.bev, BevFormerConfig) else STRIDE
    cameras = tuple(window_camera(camera, config.image) for camera in rig)
    seen = depth_targets(np.zeros((0, 3)) if points is None else points, cameras, stride, config.depth)
    missing = [-(-size // stride) - cells for size, cells in zip(input_size(config.image), seen.shape[1:], strict=True)]
    whole = np.pad(seen, ((0, 0), (0, missing[0]), (0, missing[1])), constant_values=UNKNOWN)
    return whole.astype(np.min_scalar_type(-config.depth.bins))


def _of_camera(points: Float, camera: Camera, stride: int, config: DepthConfig) -> NDArray[np.int64]:
    rotation, position = camera.camera_to_ego[:3, :3], camera.camera_to_ego[:3, 3]
    seen = (points - position) @ rotation
    depth = seen[:, 2]
    within = (depth >= config.near) & (depth < config.far)
    seen, depth = seen[within], depth[within]
    pixels = (seen @ camera.intrinsics.T)[:, :2] / depth[:, None]
    inside = (pixels >= 0).all(axis=1) & (pixels < [camera.width, camera.height]).all(axis=1)
    cells, depth = (pixels[inside] // stride).astype(np.int64), depth[inside]
    far_to_near = np.argsort(-depth, kind="stable")
    bins = ((depth - config.near) / (config.far - config.near) * config.bins).astype(np.int64)
    targets = np.full((-(-camera.height // stride), -(-camera.width // stride)), UNKNOWN)
    targets[cells[far_to_near, 1], cells[far_to_near, 0]] = bins[far_to_near]
    return targets
