"""``predmapnet log`` as a user meets it: a recording becomes a log, and the log a map."""

import json

import pytest

from mapfusion.formats.by_suffix import read_map
from tests.predmapnet.datasets.bags.drawn_bag import bag_of
from tests.predmapnet.datasets.own_logs.drawn_log import bend, entry, write_log
from tests.predmapnet.datasets.test_py123d_logs import CAMERAS, write_py123d

TOPIC = "/sensing/front/image_raw/compressed"


@pytest.fixture
def drawn(tmp_path):
    return bag_of(write_log(tmp_path / "drawn", {"front": entry(0), "left": entry(80)}, bend(12)))


def test_a_bag_becomes_a_log_and_the_log_a_map(predmapnet, drawn, random_weights, tmp_path):
    drawn.write(tmp_path / "bag")
    result = predmapnet("log", "from-bag", "bag", "--out", "drive")
    assert result.code == 0, result.err
    assert f"front: 12 images of {TOPIC}\n" in result.out
    assert "poses: transforms from base_link to map, 12 poses, 10 Hz" in result.out
    assert "Note" not in result.err and result.err.count("MB written") == 1
    assert predmapnet("infer", "drive", "--out", "m.geojson", "--weights", random_weights, "--threads", 1).code == 0
    assert len(read_map(tmp_path / "m.geojson"))


def test_the_report_is_there_for_programs(predmapnet, drawn, tmp_path):
    drawn.change(TOPIC, lambda message: setattr(message, "data", message.data[:-50]))
    drawn.write(tmp_path / "bag")
    result = predmapnet("log", "from-bag", "bag", "--out", "drive", "--json")
    report = json.loads(result.out)
    assert report["images"] == {"left": 12} and report["written"] == "drive"
    assert any(TOPIC in note for note in report["notes"])


def test_a_bag_that_lacks_something_is_one_message(predmapnet, drawn, tmp_path):
    drawn.drop("/tf_static")
    drawn.write(tmp_path / "bag")
    result = predmapnet("log", "from-bag", "bag", "--out", "drive")
    assert result.code == 2
    assert "no transform leads from front_optical to base_link" in result.err
    assert "/sensing/left/camera_info (sensor_msgs/msg/CameraInfo)" in result.err
    assert not (tmp_path / "drive").exists()


def test_a_log_of_py123d_becomes_a_log(predmapnet, tmp_path):
    write_py123d(write_log(tmp_path / "drawn", CAMERAS, bend(12)), tmp_path / "py123d")
    result = predmapnet("log", "from-py123d", "py123d", "--out", "drive", "--camera", "pcam_f0")
    assert result.code == 0, result.err
    assert "pcam_f0: 12 images of camera.pcam_f0.arrow\n" in result.out and "pcam_l0" not in result.out
    assert "poses: ego_state_se3.arrow, 12 poses, 10 Hz" in result.out
    assert predmapnet("scenes", "--data-root", "drive").code == 0
    assert predmapnet("log", "from-py123d", "drawn", "--out", "other").code == 2
