"""Drives in the layouts of KITTI raw and PandaSet become the log that they were made from; what is wrong is told."""

import json

import cv2
import numpy as np
import pytest

from predmapnet.datasets.kitti_and_pandaset import log_from_kitti, log_from_pandaset
from predmapnet.datasets.own_logs.scene import LogScene
from predmapnet.errors import UserError
from tests.predmapnet.datasets.drawn_recordings import LATITUDE, LONGITUDE, write_kitti, write_pandaset
from tests.predmapnet.datasets.own_logs.drawn_log import bend, entry, write_log

CAMERAS = {"front_camera": entry(0, 160, 96, 90.0), "left_camera": entry(80, 160, 96, 90.0, 5.0)}
FRAMES = 6


@pytest.fixture(scope="module")
def log(tmp_path_factory):
    """A log whose cameras take their images at the poses' times, and 30 ms after them."""
    folder = write_log(
        tmp_path_factory.mktemp("logs") / "drive", CAMERAS, bend(FRAMES + 1), 30_000_000, rows=range(FRAMES)
    )
    return LogScene(folder, 1000.0)


def pixels(scene: LogScene, name: str, row: int, points, shift=(0.0, 0.0, 0.0)):
    """Where points of the global frame, shifted, are in a camera's image, by the pose of the image's own instant."""
    camera = next(camera for camera in scene.rig if camera.name == name)
    pose = scene.poses.at(int(scene.images[name][0][row])) @ camera.camera_to_ego
    seen = (np.asarray(points) + shift - pose[:3, 3]) @ pose[:3, :3] @ camera.intrinsics.T
    return seen[:, :2] / seen[:, 2:]


def test_a_drive_of_kitti_raw_becomes_the_log_that_it_was_made_from(log, tmp_path):
    made = log_from_kitti(write_kitti(log, tmp_path / "2011_09_26"), tmp_path / "out")
    found, (front, _) = LogScene(tmp_path / "out", 1000.0), log.rig
    (camera,) = found.rig
    assert (camera.name, camera.width, camera.height, camera.ground_height) == ("image_02", 160, 96, -0.93)
    np.testing.assert_allclose(camera.intrinsics, front.intrinsics, atol=1e-9)
    np.testing.assert_allclose(camera.camera_to_ego, front.camera_to_ego, atol=1e-8)
    assert made.images == {"image_02": FRAMES} and made.notes == []
    np.testing.assert_array_equal(found.images["image_02"][0], log.images["front_camera"][0])
    np.testing.assert_array_equal(found.poses.timestamps, log.poses.timestamps)
    up = np.array([0.0, 0.0, 116.0])
    np.testing.assert_allclose(found.poses.ego_to_global[:, :3, :3], log.poses.ego_to_global[:, :3, :3], atol=1e-8)
    np.testing.assert_allclose(found.poses.ego_to_global[:, :3, 3], log.poses.ego_to_global[:, :3, 3] + up, atol=1e-5)
    assert (found.georeference.latitude, found.georeference.longitude) == pytest.approx(
        (LATITUDE, LONGITUDE), abs=1e-10
    )
    ground = [[12.0, 1.0, 0.0], [20.0, -3.0, 0.0]]
    for row in (0, FRAMES - 1):
        image = cv2.imread(str(found.images["image_02"][1][row]))
        assert np.array_equal(image, cv2.imread(str(log.images["front_camera"][1][row])))
        wanted = pixels(log, "front_camera", row, ground)
        np.testing.assert_allclose(pixels(found, "image_02", row, ground, up), wanted, atol=1e-4)


def test_a_scene_of_pandaset_becomes_the_log_that_it_was_made_from(log, tmp_path):
    made = log_from_pandaset(write_pandaset(log, tmp_path / "002"), tmp_path / "out", height=0.3)
    found = LogScene(tmp_path / "out", 1000.0)
    assert made.notes == [] and made.images == {"front_camera": FRAMES, "left_camera": FRAMES}
    np.testing.assert_allclose(found.poses.ego_to_global, log.poses.ego_to_global, atol=1e-6)
    ground = {"front_camera": [[12.0, 5.0, 0.0], [20.0, -1.0, 0.0]], "left_camera": [[3.0, 9.0, 0.0], [5.0, 15.0, 0.0]]}
    for a, b in zip(found.rig, log.rig, strict=True):
        assert (a.name, a.width, a.height, a.ground_height) == (b.name, b.width, b.height, b.ground_height)
        np.testing.assert_allclose(a.intrinsics, b.intrinsics, atol=1e-9)
        np.testing.assert_allclose(a.camera_to_ego, b.camera_to_ego, atol=1e-6)
        # Their times are seconds as floating-point numbers.
        assert np.abs(found.images[a.name][0] - log.images[a.name][0]).max() < 500
        for row, (here, there) in enumerate(zip(found.images[a.name][1], log.images[a.name][1], strict=True)):
            assert here.read_bytes() == there.read_bytes()
            wanted = pixels(log, a.name, row, ground[a.name])
            np.testing.assert_allclose(pixels(found, a.name, row, ground[a.name]), wanted, atol=1e-4)
    assert "taken to lie on the road" in log_from_pandaset(tmp_path / "002", tmp_path / "flat").notes[0]


KITTI_FAULTS = {
    "calib_velo_to_cam.txt": ("T: ", "T: x ", "'T'"),
    "calib_imu_to_velo.txt": ("R: ", "Q: ", "'R' is missing"),
    "calib_cam_to_cam.txt": ("P_rect_02", "P_rect_00", "'P_rect_02' is missing"),
    "2011_09_26_drive_0001_sync/image_02/timestamps.txt": ("2017-07-14 02:40:00.1", "noon", "line 2"),
    "2011_09_26_drive_0001_sync/oxts/timestamps.txt": ("2017-07-14 02:40:00.600000000", "", "line 7"),
    "2011_09_26_drive_0001_sync/oxts/data/0000000002.txt": ("49.", "x49.", "6 finite numbers"),
}


@pytest.mark.parametrize("name", KITTI_FAULTS)
def test_a_fault_of_kitti_raw_is_told_with_its_file(log, tmp_path, name):
    drive, path = write_kitti(log, tmp_path / "day"), tmp_path / "day" / name
    old, new, told = KITTI_FAULTS[name]
    content = path.read_text()
    assert old in content
    path.write_text(content.replace(old, new))
    with pytest.raises(UserError, match=told) as raised:
        log_from_kitti(drive, tmp_path / "out")
    assert str(path) in str(raised.value) and not (tmp_path / "out").exists()


PANDASET_FAULTS = {
    "lidar/poses.json": lambda listed: listed[1]["heading"].update(w=3.0),
    "camera/left_camera/poses.json": lambda listed: listed[2].pop("position"),
    "camera/left_camera/timestamps.json": lambda listed: listed.reverse(),
    "camera/front_camera/intrinsics.json": lambda values: values.update(cx="nan"),
}


@pytest.mark.parametrize("name", PANDASET_FAULTS)
def test_a_fault_of_pandaset_is_told_with_its_file(log, tmp_path, name):
    scene = write_pandaset(log, tmp_path / "002")
    path = scene / name
    content = json.loads(path.read_text())
    PANDASET_FAULTS[name](content)
    path.write_text(json.dumps(content))
    with pytest.raises(UserError) as raised:
        log_from_pandaset(scene, tmp_path / "out")
    assert str(path) in str(raised.value) and not (tmp_path / "out").exists()
    path.write_text("[")
    with pytest.raises(UserError, match=path.name):
        log_from_pandaset(scene, tmp_path / "out")


def test_poses_of_another_scene_and_missing_images_are_told(log, tmp_path):
    scene = write_pandaset(log, tmp_path / "002")
    (scene / "camera" / "left_camera" / "03.jpg").unlink()
    assert "missing: 1 images of left_camera" in log_from_pandaset(scene, tmp_path / "out").notes
    path = scene / "lidar" / "poses.json"
    listed = json.loads(path.read_text())
    path.write_text(json.dumps([{**pose, "position": listed[0]["position"]} for pose in listed]))
    with pytest.raises(UserError, match="this camera moves"):
        log_from_pandaset(scene, tmp_path / "other")


def test_damaged_images_are_left_out_and_told(log, tmp_path):
    scene, drive = write_pandaset(log, tmp_path / "002"), write_kitti(log, tmp_path / "day")
    (scene / "camera" / "left_camera" / "02.jpg").write_bytes(b"")
    path = drive / "image_02" / "data" / "0000000003.png"
    path.write_bytes(path.read_bytes()[:-30])
    for made, camera in (
        (log_from_pandaset(scene, tmp_path / "one"), "left_camera"),
        (log_from_kitti(drive, tmp_path / "two"), "image_02"),
    ):
        assert f"lost: 1 damaged images of {camera}" in made.notes
        assert made.images[camera] == FRAMES - 1 == len(list((made.written / "images" / camera).iterdir()))


def test_what_is_no_such_drive_is_told(log, tmp_path):
    drive = write_kitti(log, tmp_path / "day", "00")
    assert log_from_kitti(drive, tmp_path / "grey").images == {"image_00": FRAMES}
    drive.rename(tmp_path / "day" / "2011_09_26_drive_0001_extract")
    for read, message in ((log_from_kitti, "image_02"), (log_from_pandaset, "lidar")):
        with pytest.raises(UserError, match=message):
            read(tmp_path, tmp_path / "out")
    with pytest.raises(UserError, match="_sync"):
        log_from_kitti(tmp_path / "day" / "2011_09_26_drive_0001_extract", tmp_path / "out")
