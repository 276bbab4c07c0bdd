"""Lidar sweeps as the data sets store them; only the training's auxiliary depth looks at them."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from mapfusion.arrays import Float
from predmapnet.datasets.argoverse2_files import read_table
from predmapnet.errors import UserError

NUSCENES_COLUMNS = 5
"""x, y, z, intensity, ring."""


def read_nuscenes_sweep(path: Path, lidar_to_ego: Float) -> Float:
    """Read a ``.pcd.bin`` file (of whole points, else UserError) as points ``(n, 3) float64``, metres, ego frame."""
    numbers = np.fromfile(path, dtype="<f4")
    if len(numbers) % NUSCENES_COLUMNS:
        raise UserError(f"{path} is not a nuScenes lidar sweep: {len(numbers)} numbers are no whole points.")
    points = numbers.reshape(-1, NUSCENES_COLUMNS)[:, :3].astype(np.float64)
    return points @ lidar_to_ego[:3, :3].T + lidar_to_ego[:3, 3]


def read_argoverse2_sweep(path: Path) -> Float:
    """Read a lidar ``.feather`` file: ``(n, 3) float64``, metres, ego frame. Raises UserError if it is no sweep."""
    axes = ("x", "y", "z")
    table = read_table(path, axes)
    return np.stack([table[axis].astype(np.float64) for axis in axes], axis=1)
