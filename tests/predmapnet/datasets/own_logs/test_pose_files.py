"""Poses of a drive: between instants, and from files in the layouts of CSV, TUM and KITTI."""

import csv
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from mapfusion.geometry import inverse_pose
from predmapnet.datasets.own_logs.pose_files import read_timed_poses
from predmapnet.datasets.own_logs.timed_poses import (
    FARTHEST_BEYOND,
    LONGEST_GAP,
    TimedPoses,
    rows_apart,
    write_timed_poses,
)
from predmapnet.errors import UserError

START = 1_500_000_000_000_000_000
NUMBER = st.floats(-1.0, 1.0)


def moving(turn: np.ndarray, velocity: np.ndarray, seconds: float) -> np.ndarray:
    """Where a car is after some seconds that turns and moves steadily."""
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_rotvec(turn * seconds).as_matrix()
    pose[:3, 3] = velocity * seconds
    return pose


@settings(max_examples=60, deadline=None)
@given(
    st.lists(st.integers(10_000_000, 900_000_000), min_size=1, max_size=8),
    st.tuples(NUMBER, NUMBER, NUMBER),
    st.tuples(NUMBER, NUMBER, NUMBER),
    st.floats(-0.1, 1.1),
)
def test_a_steady_motion_is_found_at_any_instant(gaps, turn, velocity, share):
    """Uneven instants, any turn, 3D: between the poses exactly, and a tenth of a second beyond them."""
    stamps = START + np.concatenate([[0], np.cumsum(gaps)]).astype(np.int64)
    turn, velocity = 2.0 * np.array(turn), 30.0 * np.array(velocity)
    poses = TimedPoses(stamps, np.array([moving(turn, velocity, (stamp - START) / 1e9) for stamp in stamps.tolist()]))
    instant = START + round(share * int(stamps[-1] - START))
    within = min(max(instant, START - FARTHEST_BEYOND), int(stamps[-1]) + FARTHEST_BEYOND)
    expected = moving(turn, velocity, (within - START) / 1e9)
    np.testing.assert_allclose(poses.at(instant), expected, atol=1e-6)


def test_between_two_poses_the_others_do_not_matter():
    poses = np.tile(np.eye(4), (4, 1, 1))
    poses[:, 0, 3] = [0.0, 1.0, 5.0, 6.0]
    found = [TimedPoses(START + 10**8 * np.arange(4), poses).at(START + 5 * 10**7 + row * 10**8) for row in range(3)]
    assert [pose[0, 3] for pose in found] == pytest.approx([0.5, 3.0, 5.5])


def test_the_drive_is_known_between_near_poses_alone():
    stamps = START + np.array([0, 1, 2, 2 + LONGEST_GAP // 10**8 + 1], dtype=np.int64) * 10**8
    poses = TimedPoses(stamps, np.tile(np.eye(4), (4, 1, 1)))
    asked = START + np.array([-2, -1, 0, 1, 2, 3, 12, 13, 14, 15]) * 10**8
    # The last pose lies behind a gap: it is known itself, and the way after it is not.
    assert poses.cover(asked).tolist() == [False, True, True, True, False, False, False, False, False, False]
    alone = TimedPoses(stamps[:1], np.eye(4)[None])
    assert alone.cover(asked).tolist() == [False, True, True, True] + [False] * 6


def curve() -> TimedPoses:
    """A car that drives a bend, once around in 40 s, level."""
    seconds = 0.1 * np.arange(30)
    poses = np.tile(np.eye(4), (30, 1, 1))
    headings = 0.5 + 0.157 * seconds
    poses[:, :3, :3] = Rotation.from_euler("z", headings[:, None]).as_matrix()
    poses[:, :2, 3] = 50 * np.stack([np.sin(headings), -np.cos(headings)], axis=1)
    poses[:, 2, 3] = 3.0
    return TimedPoses(START + np.round(seconds * 1e9).astype(np.int64), poses)


def write_tum(folder, poses: TimedPoses, nanoseconds: bool) -> None:
    lines = ["# time x y z qx qy qz qw"]
    for stamp, pose in zip(poses.timestamps.tolist(), poses.ego_to_global, strict=True):
        time = str(stamp) if nanoseconds else f"{stamp // 10**9}.{stamp % 10**9:09d}"
        numbers = [*pose[:3, 3], *Rotation.from_matrix(pose[:3, :3]).as_quat()]
        lines.append(" ".join([time, *(f"{number:.9f}" for number in numbers)]))
    (folder / "poses.txt").write_text("\n".join(lines) + "\n")


def write_kitti(folder, poses: TimedPoses) -> None:
    rows = poses.ego_to_global[:, :3].reshape(-1, 12)
    (folder / "poses.txt").write_text("\n".join(" ".join(f"{number:.9e}" for number in row) for row in rows))
    (folder / "times.txt").write_text("\n".join(f"{stamp / 1e9:.9f}" for stamp in poses.timestamps.tolist()))


@pytest.mark.parametrize("layout", ["csv", "tum", "tum in nanoseconds", "kitti"])
def test_every_layout_gives_the_same_drive(tmp_path, layout):
    poses = curve()
    if layout == "csv":
        write_timed_poses(tmp_path / "poses.csv", poses)
    elif layout == "kitti":
        write_kitti(tmp_path, poses)
    else:
        write_tum(tmp_path, poses, "nano" in layout)
    found = read_timed_poses(tmp_path)
    np.testing.assert_allclose(found.timestamps, poses.timestamps, atol=300 if layout == "kitti" else 0)
    np.testing.assert_allclose(found.ego_to_global, poses.ego_to_global, atol=1e-7)


@pytest.mark.parametrize("up", [True, False], ids=["global frame with z up", "global frame of the first camera"])
def test_poses_of_a_camera_become_those_of_the_car(tmp_path, up):
    camera_to_ego = np.eye(4)
    camera_to_ego[:3, :3] = [[0, 0, 1], [-1, 0, 0], [0, -1, 0]]
    camera_to_ego[:3, 3] = 1.5, -0.2, 1.4
    poses = curve()
    of_camera = poses.ego_to_global @ camera_to_ego
    if not up:
        of_camera = inverse_pose(of_camera[0]) @ of_camera
    write_kitti(tmp_path, TimedPoses(poses.timestamps, of_camera))
    found = read_timed_poses(tmp_path, camera_to_ego).ego_to_global
    expected = poses.ego_to_global if up else inverse_pose(poses.ego_to_global[0]) @ poses.ego_to_global
    np.testing.assert_allclose(found, expected, atol=1e-6)
    with pytest.raises(UserError, match="tilted" if up else "poses_of"):
        read_timed_poses(tmp_path)


def rewritten(path, change) -> None:
    with path.open(newline="") as file:
        rows = list(csv.DictReader(file))
    rows = change(rows) or rows
    with path.open("w", newline="") as file:
        writer = csv.DictWriter(file, rows[0])
        writer.writeheader()
        writer.writerows(rows)


def swap_order(rows) -> None:
    for row in rows:
        row["qw"], row["qx"], row["qy"], row["qz"] = row["qx"], row["qy"], row["qz"], row["qw"]


def in_milliseconds(rows) -> None:
    for row in rows:
        row["timestamp_ns"] = int(row["timestamp_ns"]) // 10**6


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (swap_order, "x, y, z, w"),
        (in_milliseconds, "milliseconds"),
        (lambda rows: [rows[0], *rows], "same time"),
        (lambda rows: rows[3].update(qw="2.0"), "line 5.*rigid"),
        (lambda rows: rows[3].update(x="nan"), "line 5.*rigid"),
        (lambda rows: rows[3].update(y=""), "line 5.*missing"),
        (lambda rows: rows[3].update(timestamp_ns="soon"), "line 5.*no number"),
    ],
)
def test_what_no_car_drives_is_refused_with_its_place(tmp_path, change, message):
    write_timed_poses(tmp_path / "poses.csv", curve())
    rewritten(tmp_path / "poses.csv", change)
    with pytest.raises(UserError, match=message) as caught:
        read_timed_poses(tmp_path)
    assert "poses.csv" in str(caught.value)


def test_columns_between_semicolons_are_named(tmp_path):
    write_timed_poses(tmp_path / "poses.csv", curve())
    path = tmp_path / "poses.csv"
    path.write_text(path.read_text().replace(",", ";"))
    with pytest.raises(UserError, match="the columns are: timestamp_ns;x;y"):
        read_timed_poses(tmp_path)


def test_text_files_that_are_neither_are_refused(tmp_path):
    path = tmp_path / "poses.txt"
    for text, message in (("1 2 3\n", "8 .TUM."), ("", "no pose"), ("a b c d e f g h\n", "line 1"), (
        "0 0 0 0 0 0 0 1\n" + " ".join(["1"] * 12), "8 and 12"), (" ".join(["1"] * 12), "times.txt")):  # fmt: skip
        path.write_text(text)
        with pytest.raises(UserError, match=message):
            read_timed_poses(tmp_path)
    (tmp_path / "times.txt").write_text("1.0")
    with pytest.raises(UserError, match="line 1"):
        read_timed_poses(tmp_path)
    write_timed_poses(tmp_path / "poses.csv", curve())
    with pytest.raises(UserError, match=r"poses\.csv and poses\.txt"):
        read_timed_poses(tmp_path)


@settings(max_examples=50, deadline=None)
@given(st.lists(st.floats(0.0, 5.0), min_size=1, max_size=30), st.floats(0.1, 3.0))
def test_rows_are_thinned_along_the_way(steps, metres):
    way = np.cumsum(steps)
    rows = rows_apart(way[:, None], metres)
    assert rows[0] == 0 and (np.diff(rows) > 0).all() and rows[-1] < len(way)
    # No stretch of the way goes unseen: from a row to the next, only its own step may be longer.
    assert all(way[later - 1] - way[row] <= metres for row, later in pairwise([*rows.tolist(), len(way)]))


def test_a_wrong_order_is_told_of_poses_in_close_succession_too(tmp_path):
    seconds = 0.005 * np.arange(1000)
    poses = np.tile(np.eye(4), (1000, 1, 1))
    poses[:, :3, :3] = Rotation.from_euler("z", 0.3 * seconds[:, None]).as_matrix()
    poses[:, 0, 3], poses[:, 1, 3] = 20 * np.sin(0.3 * seconds), 20 * (1 - np.cos(0.3 * seconds))
    write_timed_poses(tmp_path / "poses.csv", TimedPoses(START + np.round(seconds * 1e9).astype(np.int64), poses))
    read_timed_poses(tmp_path)
    rewritten(tmp_path / "poses.csv", swap_order)
    with pytest.raises(UserError, match="x, y, z, w"):
        read_timed_poses(tmp_path)


def test_rows_may_come_in_any_order(tmp_path):
    poses = curve()
    write_timed_poses(tmp_path / "poses.csv", poses)
    rewritten(tmp_path / "poses.csv", lambda rows: rows[::-1])
    found = read_timed_poses(tmp_path)
    np.testing.assert_array_equal(found.timestamps, poses.timestamps)
    np.testing.assert_allclose(found.ego_to_global, poses.ego_to_global, atol=1e-8)


def test_positions_that_are_on_no_earth_are_told(tmp_path):
    write_timed_poses(tmp_path / "poses.csv", curve())
    rewritten(tmp_path / "poses.csv", lambda rows: rows[7].update(x="1e154"))
    with pytest.raises(UserError, match=r"line 9: .* translation \[1e\+154, .* at most 1e\+08"):
        read_timed_poses(tmp_path)
