import json
import os
import subprocess
from pathlib import Path

import pytest

from predmapnet.demo_world.catalogue import ensure_scene, trajectory, vector_map
from tests.environments import python_with

pytestmark = pytest.mark.devkit

DEVKIT = "nuscenes-devkit==1.2.0 numpy<2"


def test_devkit_opens_tables_images_lidar_and_map_without_complaint(tmp_path):
    """In an environment of its own: the devkit pins numpy below 2, Rerun needs numpy 2."""
    devkit_python = python_with("nuscenes-devkit", tmp_path, DEVKIT)
    folder = ensure_scene("scene-0103", tmp_path)
    script = Path(__file__).with_name("open_with_devkit.py")
    run = subprocess.run(
        [devkit_python, "-W", "error::UserWarning", script, folder],
        capture_output=True,
        text=True,
        env={**os.environ, "MPLBACKEND": "agg"},
        check=False,
    )
    assert run.returncode == 0, run.stderr
    assert run.stderr == ""
    seen = json.loads(run.stdout)
    assert seen["samples"] == len(trajectory("scene-0103").timestamps)
    assert seen["images"] == 6 * seen["samples"]
    assert seen["points"] > 5000 * seen["samples"]
    assert seen["near road_segment"] > 0
    assert seen["near lane"] > 0
    assert seen["near ped_crossing"] > 0
    assert seen["mask drivable_area"] > 5000
    assert 0 < seen["mask lane_divider"] < seen["mask drivable_area"]
    assert len(vector_map("scene-0103").crossings) >= seen["near ped_crossing"]
