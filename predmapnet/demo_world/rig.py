"""The demo car: six cameras and a lidar, mounted like those of nuScenes but exactly mirror-symmetric."""

from __future__ import annotations

import numpy as np

from mapfusion.arrays import Float
from predmapnet.scenes import Camera, Rig

IMAGE_SIZE = (800, 450)
"""Width and height, pixels: half of the nuScenes cameras."""

_OPTICAL_TO_LEVEL = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
"""Columns: where a camera's x (right), y (down) and z (forward) point for a camera that looks along ego x."""


def _pose(rotation: Float, x: float, y: float, z: float) -> Float:
    pose = np.eye(4)
    pose[:3, :3] = rotation
    pose[:3, 3] = x, y, z
    return pose


def _camera(name: str, x: float, y: float, z: float, yaw_degrees: float, focal: float = 1260.0) -> Camera:
    """A level camera; ``focal`` in pixels of the 1600 x 900 sensor, its principal point at (800, 490)."""
    full_size = np.array([[focal, 0.0, 800.0], [0.0, focal, 490.0], [0.0, 0.0, 1.0]])
    intrinsics = np.diag([0.5, 0.5, 1.0]) @ full_size
    cos, sin = np.cos(np.radians(yaw_degrees)), np.sin(np.radians(yaw_degrees))
    turn = np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])
    return Camera(name, *IMAGE_SIZE, intrinsics, _pose(turn @ _OPTICAL_TO_LEVEL, x, y, z))


DEMO_RIG: Rig = (
    _camera("CAM_FRONT", 1.70, 0.0, 1.51, 0.0),
    _camera("CAM_FRONT_RIGHT", 1.52, -0.49, 1.51, -55.0),
    _camera("CAM_FRONT_LEFT", 1.52, 0.49, 1.51, 55.0),
    _camera("CAM_BACK", 0.03, 0.0, 1.58, 180.0, focal=800.0),
    _camera("CAM_BACK_LEFT", 1.03, 0.48, 1.57, 110.0),
    _camera("CAM_BACK_RIGHT", 1.03, -0.48, 1.57, -110.0),
)
"""The cameras in the order of the nuScenes benchmarks. The ego origin is on the ground under the rear axle."""

LIDAR_TO_EGO: Float = _pose(np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]), 0.94, 0.0, 1.84)
"""LIDAR_TOP, x right and y forward: turned by exactly -90 degrees, so that the official ground-truth frame (lidar yaw
plus 90 degrees) has the heading of the car."""
