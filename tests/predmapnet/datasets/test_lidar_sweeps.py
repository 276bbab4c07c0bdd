"""Lidar files are read as points in the ego frame; files that hold something else are refused."""

import numpy as np
import pyarrow as pa
import pytest
from pyarrow import feather

from predmapnet.datasets.lidar import read_argoverse2_sweep, read_nuscenes_sweep
from predmapnet.errors import UserError


def test_a_nuscenes_sweep_is_moved_from_the_lidar_to_the_car(tmp_path):
    path = tmp_path / "sweep.pcd.bin"
    np.array([[1.0, 2.0, 3.0, 17.0, 4.0], [0.0, -1.0, 0.5, 3.0, 31.0]], dtype="<f4").tofile(path)
    # x right and y forward, 1 m ahead and 2 m up.
    lidar_to_ego = np.array([[0.0, 1, 0, 1], [-1, 0, 0, 0], [0, 0, 1, 2], [0, 0, 0, 1]])
    assert np.array_equal(read_nuscenes_sweep(path, lidar_to_ego), [[3.0, -1.0, 5.0], [0.0, 0.0, 2.5]])


def test_half_a_point_is_no_sweep(tmp_path):
    path = tmp_path / "sweep.pcd.bin"
    np.zeros(7, dtype="<f4").tofile(path)
    with pytest.raises(UserError, match=r"sweep.pcd.bin is not a nuScenes lidar sweep: 7 numbers"):
        read_nuscenes_sweep(path, np.eye(4))


def test_an_argoverse_sweep_is_in_the_ego_frame_already(tmp_path):
    path = tmp_path / "1.feather"
    columns = {"x": [1.5, -2.0], "y": [0.25, 8.0], "z": [-0.5, 1.0], "intensity": [3, 4]}
    table = {
        name: np.array(values, dtype=np.float16 if name in "xyz" else np.uint8) for name, values in columns.items()
    }
    feather.write_feather(pa.table(table), path)
    assert np.array_equal(read_argoverse2_sweep(path), [[1.5, 0.25, -0.5], [-2.0, 8.0, 1.0]])


def test_a_table_without_coordinates_is_no_sweep(tmp_path):
    path = tmp_path / "1.feather"
    feather.write_feather(pa.table({"x": np.zeros(2), "intensity": np.zeros(2)}), path)
    with pytest.raises(UserError, match="lacks the columns y, z"):
        read_argoverse2_sweep(path)
