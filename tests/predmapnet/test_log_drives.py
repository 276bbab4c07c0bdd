"""Cars unlike the demo car are mapped from logs of their own: one front camera, seven fisheyes, many frames."""

from itertools import pairwise

import numpy as np
import pytest

from predmapnet.datasets.own_logs.scene import LogScene
from tests.benchmarks.log_drives import CARS, mapped, write_log

pytestmark = pytest.mark.slow  # Images are rendered first.


@pytest.mark.parametrize("car", CARS)
def test_a_log_of_another_car_becomes_a_map_that_is_right(tmp_path, car):
    folder = write_log(tmp_path / car, CARS[car], 24, 2.0)
    said: list[str] = []
    report = mapped(folder, 2.0, 12, said.append)
    assert [int(line.split()[0]) for line in said] == [12, 24]
    assert report.frames == 24 and report.written[0].is_file()
    assert sum(report.elements.values()) > 5
    # Cameras that are drawn or described wrongly find next to nothing.
    assert report.accuracy.precision > 0.5 and report.accuracy.recall > 0.4


def test_laps_of_a_long_log_follow_one_another_like_frames(tmp_path):
    folder = write_log(tmp_path / "long", CARS["front"], 50, 2.0)
    scene = LogScene(folder, 2.0)
    assert len(scene) == 50 and not (folder / "truth.json").exists()
    frames = [scene.instant(index) for index in range(50)]
    steps = [np.linalg.inv(before.ego_to_global) @ after.ego_to_global for before, after in pairwise(frames)]
    assert {after.timestamp - before.timestamp for before, after in pairwise(frames)} == {500_000_000}
    ahead = np.array([step[0, 3] for step in steps])
    assert (np.abs(np.diff(ahead)) < 2.0).all() and (ahead > 0.0).all()
    assert scene.frame(45).images["front"].samefile(scene.frame(45 - 39).images["front"])
