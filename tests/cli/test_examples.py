"""The examples run as they are printed."""

import runpy
import subprocess
import sys
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import numpy as np

EXAMPLES = Path(__file__).parents[2] / "examples"


def test_mapping_a_scene_and_drawing_it(tiny_root, random_weights, tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("PREDMAPNET_DATA_ROOT", str(tiny_root))
    script = runpy.run_path(str(EXAMPLES / "map_one_scene.py"))
    script["main"]("scene-0001", tmp_path / "map.geojson", random_weights)
    assert "frame 2:" in capsys.readouterr().out
    command = [sys.executable, EXAMPLES / "draw_a_map.py", tmp_path / "map.geojson", tmp_path / "map.svg"]
    subprocess.run(command, check=True, timeout=300)
    drawn = ElementTree.parse(tmp_path / "map.svg").getroot()
    assert drawn.findall("{http://www.w3.org/2000/svg}polyline")


def test_integrating_own_polylines_averages_their_errors_out(capsys):
    global_map = runpy.run_path(str(EXAMPLES / "integrate_your_own_polylines.py"))["main"]()
    (divider,) = global_map
    assert divider.length > 150
    assert np.abs(divider.points[:, 1] - 1.8).max() < 0.25
    assert "confidence" in capsys.readouterr().out
