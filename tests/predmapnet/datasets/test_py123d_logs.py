"""A log of py123d becomes the log that it was made from; what it lacks is told."""

import json
from pathlib import Path

import cv2
import msgpack
import numpy as np
import pyarrow as pa
import pytest

from predmapnet.datasets.own_logs.scene import LogScene
from predmapnet.datasets.py123d_logs import log_from_py123d
from predmapnet.errors import UserError
from tests.environments import PY123D, printed_json, python_with
from tests.predmapnet.datasets.drawn_recordings import numbers_of, write_py123d
from tests.predmapnet.datasets.own_logs.drawn_log import bend, entry, write_log

CAMERAS = {
    "pcam_f0": entry(0, 160, 96, 90.0),
    "pcam_l0": entry(80, 160, 96, 90.0, model="plumb_bob", distortion=[-0.1, 0.01, 1e-3, 0.0, 0.0]),
}


@pytest.fixture(scope="module")
def log(tmp_path_factory):
    return write_log(tmp_path_factory.mktemp("logs") / "drive", CAMERAS, bend(12), late=20_000_000)


@pytest.fixture
def folder(log, tmp_path):
    return write_py123d(log, tmp_path / "py123d")


def assert_same(found: Path, log: Path, images: bool = True) -> None:
    one, other = LogScene(found, 1000.0), LogScene(log, 1000.0)
    assert len(one) == len(other) == 12
    for a, b in zip(one.rig, other.rig, strict=True):
        assert (a.name, a.width, a.height, a.ground_height) == (
            b.name,
            b.width,
            b.height,
            pytest.approx(b.ground_height),
        )
        np.testing.assert_allclose(a.intrinsics, b.intrinsics)
        np.testing.assert_allclose(a.camera_to_ego, b.camera_to_ego, atol=1e-9)
        assert (a.lens is None) == (b.lens is None)
        assert a.lens is None or np.allclose(a.lens.distortion, b.lens.distortion)
    for index in range(len(one)):
        here, there = one.frame(index), other.frame(index)
        assert here.timestamp == there.timestamp
        np.testing.assert_allclose(here.ego_to_global, there.ego_to_global, atol=1e-6)
        for name, path in there.images.items():
            assert here.images[name].stem == path.stem
            assert not images or here.images[name].read_bytes() == path.read_bytes()


def test_a_log_of_py123d_becomes_the_log_that_it_was_made_from(folder, log, tmp_path):
    made = log_from_py123d(folder, tmp_path / "out")
    assert_same(tmp_path / "out", log)
    assert made.images == {"pcam_f0": 12, "pcam_l0": 12} and made.notes == []


def path_with_null(log: Path, folder: Path) -> Path:
    write_py123d(log, folder, "path")
    table = pa.ipc.open_file((folder / "camera.pcam_f0.arrow").read_bytes()).read_all()
    with pa.ipc.new_file(str(folder / "camera.pcam_f0.arrow"), table.schema) as file:
        file.write_table(table.set_column(1, table.schema.field(1), pa.array(["a\0b"] * len(table))))
    return folder


def test_images_may_be_files_elsewhere(log, tmp_path):
    folder = write_py123d(log, tmp_path / "py123d", "path")
    with pytest.raises(UserError, match="--sensor-root"):
        log_from_py123d(folder, tmp_path / "out")
    log_from_py123d(folder, tmp_path / "front", ["pcam_f0"], log / "images" / "pcam_f0")
    assert [path.name for path in (tmp_path / "front" / "images").iterdir()] == ["pcam_f0"]
    with pytest.raises(UserError, match="no image"):
        log_from_py123d(path_with_null(log, tmp_path / "null"), tmp_path / "out", ["pcam_f0"], log / "images")
    with pytest.raises(UserError, match="outside"):
        outside = write_py123d(log, tmp_path / "again", "path")
        table = pa.ipc.open_file((outside / "camera.pcam_f0.arrow").read_bytes()).read_all()
        rows = pa.array(["../poses.csv"] * len(table))
        with pa.ipc.new_file(str(outside / "camera.pcam_f0.arrow"), table.schema) as file:
            file.write_table(table.set_column(1, table.schema.field(1), rows))
        log_from_py123d(outside, tmp_path / "out", ["pcam_f0"], log / "images")


def test_images_may_be_a_video(log, tmp_path):
    folder = write_py123d(log, tmp_path / "py123d", "mp4")
    log_from_py123d(folder, tmp_path / "out")
    assert_same(tmp_path / "out", log, images=False)
    for row in (0, 11):
        found = sorted((tmp_path / "out" / "images" / "pcam_f0").iterdir())[row]
        same = cv2.imread(str(log / "images" / "pcam_f0" / found.name)).astype(int)
        other = cv2.imread(str(sorted((log / "images" / "pcam_f0").iterdir())[11 - row])).astype(int)
        image = cv2.imread(str(found)).astype(int)
        assert np.abs(image - same).mean() < 0.6 * np.abs(image - other).mean()
    (folder / "camera.pcam_f0.mp4").unlink()
    with pytest.raises(UserError, match=r"pcam_f0\.mp4 cannot be read"):
        log_from_py123d(folder, tmp_path / "none")


def rewrite(folder: Path, key: str, change) -> None:
    """Change the metadata of a file."""
    table = pa.ipc.open_file((folder / f"{key}.arrow").read_bytes()).read_all()
    if not isinstance(change, bytes):
        metadata = msgpack.unpackb(table.schema.metadata[b"metadata"])
        change(metadata)
        change = msgpack.packb(metadata)
    with pa.ipc.new_file(str(folder / f"{key}.arrow"), table.schema.with_metadata({"metadata": change})) as file:
        file.write_table(table)


def columns(folder: Path, change) -> None:
    """Change the table of a camera."""
    path = folder / "camera.pcam_f0.arrow"
    table = change(pa.ipc.open_file(path.read_bytes()).read_all())
    with pa.ipc.new_file(str(path), table.schema) as file:
        file.write_table(table)


def times(column):
    return column.cast(pa.timestamp("us"))


def later(column):
    return pa.array([2**62 + row for row in range(len(column))])


def test_cameras_of_other_models_are_left_out_and_told(folder, tmp_path):
    rewrite(folder, "camera.pcam_l0", lambda metadata: metadata.update(camera_model="ftheta"))
    made = log_from_py123d(folder, tmp_path / "out")
    assert made.cameras == {"pcam_f0": "camera.pcam_f0.arrow"}
    assert made.notes == ["left out: pcam_l0: the camera model 'ftheta' is not read here"]
    with pytest.raises(UserError, match="ftheta"):
        log_from_py123d(folder, tmp_path / "named", ["pcam_l0"])


def test_undistorted_images_have_no_lens(folder, tmp_path):
    rewrite(folder, "camera.pcam_l0", lambda metadata: metadata.update(is_undistorted=True))
    log_from_py123d(folder, tmp_path / "out")
    assert all(camera.lens is None for camera in LogScene(tmp_path / "out").rig)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda folder: (folder / "ego_state_se3.arrow").unlink(), r"no .*ego_state_se3\.arrow"),
        (lambda folder: (folder / "ego_state_se3.arrow").write_bytes(b"ARROW1"), "no file of py123d, or damaged"),
        (lambda folder: rewrite(folder, "ego_state_se3", lambda m: m.pop("height")), "height of the car"),
        (lambda folder: rewrite(folder, "camera.pcam_f0", lambda m: m.update(intrinsics=[1.0])), "'intrinsics'"),
        (lambda folder: rewrite(folder, "camera.pcam_f0", lambda m: m.update(camera_to_imu_se3=None)), "a pose needs"),
        (lambda folder: rewrite(folder, "camera.pcam_f0", lambda m: m.update(width=64)), "principal point"),
        (lambda folder: columns(folder, lambda table: table.append_column(table.schema[0], table[0])), "column twice"),
        (lambda folder: columns(folder, lambda table: table.set_column(0, table.schema[0].name, times(table[0]))),
         "not numbers"),
        (lambda folder: columns(folder, lambda table: table.set_column(1, table.schema[1].name, times(table[0]))),
         "no images and no names"),
        (lambda folder: rewrite(folder, "camera.pcam_f0", b"\x81\x91\x01\x02"), "no file of py123d, or damaged"),
        (lambda folder: columns(folder, lambda table: table.set_column(0, table.schema[0].name, later(table[0]))),
         "whole number of microseconds"),
        (lambda folder: columns(folder, lambda table: table.set_column(1, table.schema[1].name, [[True] * 12])),
         "no images and no names"),
    ],
)  # fmt: skip
def test_what_is_missing_or_wrong_is_told(folder, tmp_path, change, message):
    change(folder)
    with pytest.raises(UserError, match=message):
        log_from_py123d(folder, tmp_path / "out")
    assert not (tmp_path / "out").exists()
    assert not [path for path in tmp_path.iterdir() if ".part" in path.name]


def test_a_camera_that_is_not_there_is_told(folder, tmp_path):
    with pytest.raises(UserError, match="no camera pcam_r0; there are: pcam_f0, pcam_l0"):
        log_from_py123d(folder, tmp_path / "out", ["pcam_r0"])


@pytest.mark.devkit
@pytest.mark.parametrize("codec", ["jpeg_binary", "path"])
def test_what_py123d_itself_wrote_is_read(log, tmp_path, codec):
    (tmp_path / "numbers.json").write_text(json.dumps(numbers_of(log)))
    python = python_with("py123d", tmp_path, *PY123D)
    script = Path(__file__).parent / "write_py123d_log.py"
    files = printed_json(python, script, tmp_path / "py123d", codec, tmp_path / "numbers.json")
    assert files == ["camera.pcam_f0.arrow", "camera.pcam_l0.arrow", "ego_state_se3.arrow"]
    if codec == "path":
        made = log_from_py123d(tmp_path / "py123d", tmp_path / "out", ["pcam_f0"], log / "images" / "pcam_f0")
        assert made.images == {"pcam_f0": 12}
        return
    log_from_py123d(tmp_path / "py123d", tmp_path / "out")
    assert_same(tmp_path / "out", log)
