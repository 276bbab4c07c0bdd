"""What is wrong with a log is told, and nothing of a log that is right."""

import csv
import json
import re

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from predmapnet.datasets.own_logs.ground_pictures import write_pictures
from predmapnet.datasets.own_logs.log_check import check_log
from predmapnet.datasets.own_logs.timed_poses import TimedPoses, write_timed_poses
from tests.predmapnet.datasets.own_logs.drawn_log import bend, entry, write_log

CAMERAS = {"front": entry(0), "left": entry(90), "right": entry(-80)}


@pytest.fixture(scope="module")
def right(tmp_path_factory):
    """A log in which nothing is wrong; its cameras trigger 20 ms apart."""
    return write_log(tmp_path_factory.mktemp("logs") / "right", CAMERAS, bend(24), late=20_000_000)


@pytest.fixture
def log(right, tmp_path):
    """A copy of the right log whose tables can be changed."""
    folder = tmp_path / "changed"
    folder.mkdir()
    (folder / "images").symlink_to(right / "images")
    for name in ("calibration.json", "poses.csv"):
        (folder / name).write_text((right / name).read_text())
    return folder


def problems(folder) -> str:
    return " / ".join(check_log(folder, 2.0)[1].problems)


def test_nothing_is_wrong_with_a_right_log(right):
    _, found = check_log(right, 2.0)
    assert found.problems == []
    told = " / ".join(found.notes)
    for name in CAMERAS:
        assert f"{name}: 24 images, 10.0 Hz" in told
    shares = [int(note.split(" %")[0].split(": ")[1]) for note in found.notes if "points move" in note]
    assert len(shares) == 3 and min(shares) > 85


def change(log, edit) -> None:
    content = json.loads((log / "calibration.json").read_text())
    edit(content["cameras"])
    (log / "calibration.json").write_text(json.dumps(content))


def turned(axis: str, degrees: float):
    """Return a change that turns the front camera about an axis of the car."""

    def edit(cameras) -> None:
        mounting = cameras["front"]["camera_to_ego"]
        w, x, y, z = mounting["rotation_wxyz"]
        rotation = Rotation.from_euler(axis, degrees, degrees=True) * Rotation.from_quat([x, y, z, w])
        x, y, z, w = rotation.as_quat().tolist()
        mounting["rotation_wxyz"] = [w, x, y, z]

    return edit


def inverted(cameras) -> None:
    for camera in cameras.values():
        mounting = camera["camera_to_ego"]
        w, x, y, z = mounting["rotation_wxyz"]
        mounting["translation_m"] = (-Rotation.from_quat([x, y, z, w]).inv().apply(mounting["translation_m"])).tolist()
        mounting["rotation_wxyz"] = [w, -x, -y, -z]


def swapped(cameras) -> None:
    left, right = cameras["left"], cameras["right"]
    left["camera_to_ego"], right["camera_to_ego"] = right["camera_to_ego"], left["camera_to_ego"]


def in_millimetres(cameras) -> None:
    for camera in cameras.values():
        camera["camera_to_ego"]["translation_m"] = [1000 * x for x in camera["camera_to_ego"]["translation_m"]]


@pytest.mark.parametrize(
    ("edit", "message"),
    [
        (in_millimetres, "camera would be 2,.* millimetres"),
        (inverted, "Are their rotations inverted"),
        (swapped, "left: .* if the camera looks the other way"),
        (turned("y", 25.0), "front: .* look at its picture"),
        (turned("z", 180.0), "front: .* looks the other way"),
        (turned("x", 180.0), "front stands on its head"),
        (turned("x", 90.0), "front lies on its side"),
        (turned("y", 80.0), "front looks into the ground: 80"),
        (turned("y", -50.0), "front sees nothing of the road"),
        (lambda cameras: cameras["front"].update(width=640, height=384), "640 x 384"),
        (lambda cameras: cameras["front"]["intrinsics"].update(fx=2000.0, fy=2000.0), "9 degrees from left to right"),
        (lambda cameras: cameras["left"].update(camera_to_ego=cameras["front"]["camera_to_ego"]), "the same camera_to"),
        (lambda cameras: cameras.update(rear=entry(180)), "rear has no images"),
    ],
)
def test_a_wrong_calibration_is_told(log, edit, message):
    change(log, edit)
    found = problems(log)
    assert re.search(message, found), found


def change_poses(log, edit) -> None:
    with (log / "poses.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    for row in rows:
        edit(row)
    with (log / "poses.csv").open("w", newline="") as file:
        writer = csv.DictWriter(file, rows[0])
        writer.writeheader()
        writer.writerows(rows)


@pytest.mark.parametrize(
    ("edit", "message"),
    [
        (lambda row: row.update({axis: 1000 * float(row[axis]) for axis in "xyz"}), "poses in millimetres"),
        (lambda row: row.update(timestamp_ns=int(row["timestamp_ns"]) // 1000), "microseconds"),
        (lambda row: row.update(timestamp_ns=int(row["timestamp_ns"]) + 10**12), "of one clock"),
        (lambda row: row.update(qw=row["qz"], qz=row["qw"]), "sideways or backwards"),
    ],
)
def test_wrong_poses_are_told(log, edit, message):
    change_poses(log, edit)
    assert message in problems(log)


def test_clocks_that_differ_are_told(tmp_path):
    # A steady bend looks the same at any time, so this car drives in wiggles.
    poses = bend(36)
    headings = 0.5 * np.sin(0.35 * np.arange(36))
    poses.ego_to_global[:, :3, :3] = Rotation.from_euler("z", headings[:, None]).as_matrix()
    steps = 0.6 * np.stack([np.cos(headings), np.sin(headings)], axis=1)
    poses.ego_to_global[:, :2, 3] = np.cumsum(steps, axis=0)
    folder = write_log(tmp_path, {"front": CAMERAS["front"]}, poses)
    assert problems(folder) == ""
    change_poses(folder, lambda row: row.update(timestamp_ns=int(row["timestamp_ns"]) - 500_000_000))
    assert "if -0.5 s were added to the times of the images" in problems(folder)


def test_headings_in_degrees_are_told(log):
    poses = bend(24, turn=0.4)
    lines = ["timestamp_ns,x,y,z,yaw"]
    for stamp, pose in zip(poses.timestamps.tolist(), poses.ego_to_global, strict=True):
        yaw = np.degrees(np.arctan2(pose[1, 0], pose[0, 0]))
        lines.append(f"{stamp},{pose[0, 3]},{pose[1, 3]},{pose[2, 3]},{yaw}")
    (log / "poses.csv").write_text("\n".join(lines))
    assert "headings in radians" in problems(log)


def test_a_jump_and_missing_images_are_told(log, right):
    poses = bend(24)
    poses.ego_to_global[15:, 0, 3] += 40.0
    write_timed_poses(log / "poses.csv", poses)
    (log / "images").unlink()
    for path in sorted((right / "images").rglob("*.jpg")):
        target = log / path.relative_to(right)
        target.parent.mkdir(parents=True, exist_ok=True)
        index = sorted(path.parent.iterdir()).index(path)
        if not (path.parent.name == "left" and 4 <= index < 8) and not (path.parent.name == "right" and index > 2):
            target.symlink_to(path)
    (log / "images" / "spare").mkdir()
    _, found = check_log(log, 10.0)
    assert any("jump by 40" in problem for problem in found.problems)
    assert any("right has no image within 0.1 s of" in problem for problem in found.problems)
    told = " / ".join(found.notes)
    assert "left: 20 images, 10.0 Hz, 4 lost (the longest gap is 0.50 s)" in told
    assert "left has no image within 0.1 s of" in told and "images of spare are left out" in told


@pytest.mark.parametrize(
    ("name", "flip", "message"),
    [
        ("left", lambda image: image[:, ::-1], "mirrored left to right"),
        ("front", lambda image: image[:, ::-1], "mirrored left to right"),
        ("front", lambda image: image[::-1, ::-1], "stand on their heads"),
    ],
)
def test_images_that_are_stored_wrongly_are_told(tmp_path, name, flip, message):
    folder = write_log(
        tmp_path, {name: CAMERAS[name]}, bend(24, turn=0.5), changed=lambda _, image: np.ascontiguousarray(flip(image))
    )
    assert message in problems(folder)


def test_fisheyes_are_checked_as_pinholes_are(tmp_path):
    lens = {"model": "fisheye", "distortion": [0.02, -0.005, 0.001, 0.0], "focal": 110.0}
    cameras = {"front": entry(0, pitch=20.0, **lens), "left": entry(95, pitch=30.0, **lens)}
    folder = write_log(tmp_path, cameras, bend(24))
    assert problems(folder) == ""
    change(folder, swapped_fisheyes)
    assert "the other way" in problems(folder) or "look at its picture" in problems(folder)


def swapped_fisheyes(cameras) -> None:
    front, left = cameras["front"], cameras["left"]
    front["camera_to_ego"], left["camera_to_ego"] = left["camera_to_ego"], front["camera_to_ego"]


def test_pictures_show_the_horizon_where_it_is(right, tmp_path):
    log, _ = check_log(right, 2.0)
    paths = write_pictures(log, tmp_path / "pictures", [])
    assert [path.name for path in paths] == ["front.png", "left.png", "right.png"]
    picture = cv2.imread(str(paths[0])).astype(int)
    pink = (np.abs(picture - [200, 80, 255]).sum(axis=-1) < 60).sum(axis=1)
    # The camera is level: its horizon lies in the middle, where the road of the image begins.
    assert abs(int(np.argmax(pink)) - 96) <= 1 and pink.max() > 20


def test_one_pose_says_nothing_about_a_drive(log):
    poses = bend(24)
    write_timed_poses(log / "poses.csv", TimedPoses(poses.timestamps[:1], poses.ego_to_global[:1]))
    assert "only one pose" in problems(log)
