"""The devkits of nuScenes and Argoverse 2, py123d and readers of OpenDRIVE open our maps and see what is in them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import shapely

from mapfusion import ElementKind, GlobalMap, MapElement
from mapfusion.formats.by_suffix import write_map
from mapfusion.formats.local_plane import LocalPlane
from tests.environments import PY123D, printed_json, python_with

pytestmark = pytest.mark.devkit

PLANE = LocalPlane(-71.05, 42.34, "harbour")
HERE = Path(__file__).parent
DEVKIT = "nuscenes-devkit==1.2.0 numpy<2"
LINE = [[0, -5], [10, -4], [20, -5]]


def element(points, kind=ElementKind.DIVIDER, **more) -> MapElement:
    return MapElement(kind, np.array(points, dtype=np.float64), 0.9, 7, 5, 6, (3,), **more)


EXAMPLE = GlobalMap(
    (
        element([[0, 0], [4, 0], [4, 10], [2, 10.5], [0, 10], [0, 0]], ElementKind.PED_CROSSING),
        element(LINE, heights=np.array([50.0, 51, 53]), name="lane line", paint="dashed"),
        element([[0, 15], [20, 15]], ElementKind.BOUNDARY, name="kerb"),
    ),
    {"scene": "scene-0103"},
)


def test_the_nuscenes_devkit_opens_the_map(tmp_path):
    python = python_with("nuscenes-devkit", tmp_path, DEVKIT)
    folder = tmp_path / "maps" / "expansion"
    folder.mkdir(parents=True)
    write_map(EXAMPLE, folder / "mine.nuscenes.json", PLANE)
    (folder / "mine.nuscenes.json").rename(folder / "boston-seaport.json")
    seen = printed_json(python, HERE / "open_with_nuscenes.py", tmp_path)
    assert (seen["crossings"], seen["dividers"]) == (1, 1)
    assert seen["area"] == pytest.approx(41.0)
    np.testing.assert_allclose(seen["divider"], LINE)
    assert seen["pixels"][0] == pytest.approx(4100, rel=0.1)
    assert seen["pixels"][1] > 150


def test_the_av2_package_opens_the_map(tmp_path):
    needed = "numpy pandas scipy pyarrow pillow matplotlib tqdm universal-pathlib opencv-python-headless pyproj rich"
    python = python_with("av2", tmp_path, "--no-deps av2==0.3.6", needed)
    (tmp_path / "map").mkdir()
    write_map(EXAMPLE, tmp_path / "map" / "log_map_archive_mine.argoverse2.json", PLANE)
    seen = printed_json(python, HERE / "open_with_av2.py", tmp_path / "map")
    assert seen["marks"] == ["NONE", "UNKNOWN"]
    np.testing.assert_allclose(sorted(seen["segments"], key=len)[1], [[0, -5, 50], [10, -4, 51], [20, -5, 53]])
    crossing = shapely.Polygon(np.array(seen["crossing"])[:, :2])
    assert crossing.is_valid
    assert crossing.intersection(shapely.Polygon(EXAMPLE.elements[0].points)).area > 0.7 * 41.0


def test_py123d_opens_the_map(tmp_path):
    python = python_with("py123d", tmp_path, *PY123D)
    write_map(EXAMPLE, tmp_path / "map.arrow", PLANE)
    seen = printed_json(python, HERE / "open_with_py123d.py", tmp_path / "map.arrow")
    assert seen["layers"] == ["CROSSWALK", "ROAD_EDGE", "ROAD_LINE"]
    assert (seen["location"], seen["has_z"]) == ("scene-0103", False)
    np.testing.assert_allclose(seen["ROAD_LINE"], [np.column_stack([LINE, [50.0, 51.0, 53.0]])])
    np.testing.assert_allclose(seen["ROAD_EDGE"], [[[0, 15, 0], [20, 15, 0]]])
    np.testing.assert_allclose(np.array(seen["outline"])[:, :2], EXAMPLE.elements[0].points)
    assert seen["area"] == pytest.approx(41.0)


def test_readers_and_the_checker_of_opendrive_accept_the_map(tmp_path):
    python = python_with("opendrive", tmp_path, "pyxodr==0.1.3", "asam-qc-opendrive==1.0.0")
    write_map(EXAMPLE, tmp_path / "map.xodr", PLANE)
    seen = printed_json(python, HERE / "open_with_opendrive.py", tmp_path / "map.xodr")
    assert seen["issues"] == []
    assert "completed" in seen["checks"].values()
    np.testing.assert_allclose(seen["lines"]["lane line"], [[0, -5], [20, -5]], atol=0.02)
    np.testing.assert_allclose(seen["heights"]["lane line"], [50.0, 53.0], atol=0.1)
    assert set(seen["lines"]) >= {"lane line", "kerb"}
