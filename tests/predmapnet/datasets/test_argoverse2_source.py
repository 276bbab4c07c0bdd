"""The Argoverse 2 reader, on a log made from nothing."""

import json

import numpy as np
import pyarrow
import pytest
from pyarrow import feather

from mapfusion.elements import RegionOfInterest
from predmapnet.datasets.argoverse2 import Argoverse2Source
from predmapnet.datasets.argoverse2_files import ARGOVERSE2_CAMERAS as CAMERAS
from predmapnet.errors import UserError
from tests.predmapnet.datasets.small_argoverse2 import START, SWEEP, point, write_log


@pytest.fixture
def log(tmp_path):
    return write_log(tmp_path / "data" / "val" / "0aaa-log")


def test_key_frames_are_every_fourth_sweep_with_the_nearest_images(log):
    source = Argoverse2Source(log.parents[1])
    (info,) = source.scenes()
    assert (info.name, info.split, info.frames, info.location, info.ready) == ("0aaa-log", "val", 3, "MIA", True)
    scene = source.open("0aaa-log")
    frame = scene.frame(1)
    assert frame.timestamp == START + 4 * SWEEP
    assert frame.token == f"0aaa-log_{START + 4 * SWEEP}"
    assert {path.stem for path in frame.images.values()} == {str(START + 4 * SWEEP + 20_000_000)}
    assert tuple(camera.name for camera in frame.rig) == CAMERAS
    np.testing.assert_allclose(frame.rig[0].intrinsics, [[10, 0, 8], [0, 11, 4], [0, 0, 1]])
    np.testing.assert_allclose(frame.rig[0].camera_to_ego[:3, 3], [1.5, 0, 1.4])


@pytest.mark.parametrize("depth", [0, 1, 2])
def test_a_root_may_be_a_log_or_hold_logs(log, depth):
    root = [log, *log.parents][depth]
    assert [info.name for info in Argoverse2Source(root).scenes()] == ["0aaa-log"]


def test_without_lidar_the_front_camera_gives_the_frames(log):
    for sweep in (log / "sensors" / "lidar").iterdir():
        sweep.unlink()
    scene = Argoverse2Source(log).open("0aaa-log")
    assert scene.timestamps.tolist() == [START + 20_000_000, START + 8 * SWEEP + 20_000_000]


def test_an_image_more_than_25_ms_away_does_not_count(log):
    folder = log / "sensors" / "cameras" / CAMERAS[3]
    (folder / f"{START + 20_000_000}.jpg").rename(folder / f"{START + 26_000_000}.jpg")
    frame = Argoverse2Source(log).open("0aaa-log").frame(0)
    assert CAMERAS[3] not in frame.images
    assert len(frame.images) == 6


def test_truth_of_a_straight_road(log):
    truth = Argoverse2Source(log).open("0aaa-log").truth(0, RegionOfInterest())
    assert truth.kinds.tolist() == [0, 1, 2, 2]
    np.testing.assert_allclose(np.ptp(truth.polylines[0], axis=0), [3, 8], atol=1e-9)
    np.testing.assert_allclose(truth.polylines[1], [[-30, 0], [30, 0]], atol=1e-9)
    assert truth.element_ids.tolist()[:2] == [0, 0]


def test_the_maps_of_several_logs_are_one(log, tmp_path):
    """The second log's map knows one more crossing and another part of the road; the same records count once."""
    other = write_log(log.parent / "0bbb-log")
    (file,) = (other / "map").glob("*.json")
    content = json.loads(file.read_text())
    more = {"edge1": [point(70, 0), point(70, 8)], "edge2": [point(73, 0), point(73, 8)]}
    content["pedestrian_crossings"]["another"] = more
    content["drivable_areas"] = {"1": {"area_boundary": [point(40, 0), point(140, 0), point(140, 8), point(40, 8)]}}
    file.write_text(json.dumps(content))
    source, roi = Argoverse2Source(tmp_path / "data"), RegionOfInterest()
    names = ["0aaa-log", "0bbb-log"]
    alone, both = source.open(names[0]).truth_map(), source.truth_map(names, roi)
    assert len(both.of_kind(0)) == len(alone.of_kind(0)) + 1
    for kind in (1, 2):
        assert len(both.of_kind(kind)) == len(alone.of_kind(kind))
        assert both.length(kind) == pytest.approx(alone.length(kind))
    file.unlink()
    assert source.truth_map(names, roi) is None


def test_a_log_without_images_or_calibration_still_serves_truth(log):
    (log / "sensors" / "cameras").rename(log / "elsewhere")
    scene = Argoverse2Source(log).open("0aaa-log")
    assert scene.truth(0, RegionOfInterest()) is not None
    assert len(scene.truth_map()) == 4
    with pytest.raises(UserError, match=r"has no images .*cannot be mapped"):
        scene.frame(0)
    (log / "elsewhere").rename(log / "sensors" / "cameras")
    (log / "calibration").rename(log / "elsewhere")
    with pytest.raises(UserError, match="no calibration folder"):
        Argoverse2Source(log).open("0aaa-log").frame(0)


def test_a_pose_that_is_not_finite_names_the_row(log):
    path = log / "city_SE3_egovehicle.feather"
    table = feather.read_table(path).to_pydict()
    table["tx_m"][4] = float("nan")
    feather.write_feather(pyarrow.table(table), path)
    scene = Argoverse2Source(log).open("0aaa-log")
    scene.frame(0)
    with pytest.raises(UserError, match=r"0aaa-log, frame 1, .*egovehicle\.feather, row 4: .*nan"):
        scene.frame(1)


def test_damaged_files_and_wrong_names_are_named(log):
    with pytest.raises(UserError, match=r"no log '0bbb-log'.*Did you mean 0aaa-log"):
        Argoverse2Source(log).open("0bbb-log")
    (log / "city_SE3_egovehicle.feather").write_bytes(b"ARROW1 but cut")
    with pytest.raises(UserError, match=r"egovehicle\.feather cannot be read as feather"):
        Argoverse2Source(log).open("0aaa-log")


def test_a_folder_without_logs(tmp_path):
    with pytest.raises(UserError, match="holds no Argoverse 2 sensor logs"):
        Argoverse2Source(tmp_path)
