"""The examples and the Python of the README run as they are printed."""

import json
import re
import runpy
import subprocess
import sys
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import numpy as np
import pytest

from tests.cli.tiny_nuscenes import write_tiny_nuscenes

ROOT = Path(__file__).parents[2]
EXAMPLES = ROOT / "examples"


def readme_code() -> list[str]:
    return re.findall(r"```python\n(.*?)```", (ROOT / "README.md").read_text(), flags=re.DOTALL)


@pytest.mark.parametrize("name", ["02_map_one_scene.py", "04_map_frame_by_frame.py"])
def test_mapping_a_scene_and_drawing_it(tiny_root, random_weights, tmp_path, monkeypatch, capsys, name):
    monkeypatch.setenv("PREDMAPNET_DATA_ROOT", str(tiny_root))
    script = runpy.run_path(str(EXAMPLES / name))
    script["main"]("scene-0001", tmp_path / "map.geojson", random_weights)
    assert "Using nuscenes" in capsys.readouterr().out
    assert json.loads((tmp_path / "map.geojson").read_text())["predmapnet"]["observed"]
    command = [sys.executable, EXAMPLES / "03_draw_a_map.py", tmp_path / "map.geojson", tmp_path / "map.svg"]
    subprocess.run(command, check=True, timeout=300)
    drawn = ElementTree.parse(tmp_path / "map.svg").getroot()
    assert drawn.findall("{http://www.w3.org/2000/svg}polyline")


def test_images_in_memory_become_a_map(random_weights, tmp_path, capsys):
    script = runpy.run_path(str(EXAMPLES / "05_map_your_own_images.py"))
    script["main"](tmp_path / "map.geojson", random_weights)
    assert capsys.readouterr().out.count("tracks") == 8
    assert json.loads((tmp_path / "map.geojson").read_text())["features"]


def test_fusing_own_polylines_averages_their_errors_out(capsys):
    global_map = runpy.run_path(str(EXAMPLES / "01_fuse_polylines.py"))["main"]()
    (divider,) = global_map
    assert divider.length > 150
    assert np.abs(divider.points[:, 1] - 1.8).max() < 0.25
    assert "confidence" in capsys.readouterr().out


def test_the_readme_maps_a_scene(tmp_path, monkeypatch):
    """A data set of three frames stands in for the scene that the README renders."""
    monkeypatch.chdir(tmp_path)
    root = write_tiny_nuscenes(tmp_path / "data", ("scene-0103",))
    monkeypatch.setenv("PREDMAPNET_DATA_ROOT", str(root))
    (code,) = (code for code in readme_code() if "map_scene" in code)
    exec(code, {})
    written = json.loads((tmp_path / "map.geojson").read_text())
    assert written["type"] == "FeatureCollection" and written["predmapnet"]["observed"]


def test_the_readme_fuses_polylines(capsys):
    (code,) = (code for code in readme_code() if "MapIntegrator" in code)
    exec(code, {})
    label, metres, *_ = capsys.readouterr().out.split()
    assert label == "divider" and float(metres) == pytest.approx(136.0, abs=10.0)
