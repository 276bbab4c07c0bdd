"""Pose files: units of time, order of quaternions, and what no car does."""

from __future__ import annotations

import json
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from predmapnet.errors import UserError
from predmapnet.frame_files.pose_file import read_poses

START = 1_600_000_000_000_000_000


def drive(yaw=0.3, frames=12, step=4.0, start=START, unit=1):
    """Poses of a straight drive at 8 m/s, as JSON rows."""
    return [
        {
            "token": f"t{i}",
            "timestamp": (start + i * 500_000_000) // unit,
            "translation": [100.0 + step * i * math.cos(yaw), step * i * math.sin(yaw), 0.0],
            "rotation": [math.cos(yaw / 2), 0.0, 0.0, math.sin(yaw / 2)],
        }
        for i in range(frames)
    ]


@pytest.fixture
def read(tmp_path):
    def reader(rows, name="poses.json"):
        path = tmp_path / name
        path.write_text(rows if isinstance(rows, str) else json.dumps(rows))
        notes: list[str] = []
        return list(read_poses(path, notes).values()), notes

    return reader


@pytest.mark.parametrize("start", [START, 0])
@pytest.mark.parametrize(("unit", "name"), [(1, ""), (1_000, "microseconds"), (1_000_000, "milliseconds")])
def test_the_unit_of_time_is_judged_by_size_and_speed(read, start, unit, name):
    poses, notes = read(drive(start=start, unit=unit))
    assert [pose.timestamp for pose in poses] == [row["timestamp"] for row in drive(start=start)]
    assert [note for note in notes if name in note and "time stamps" in note] == notes
    assert len(notes) == bool(name)


def test_a_column_says_its_unit(read):
    rows = drive()
    for row in rows:
        row["timestamp_s"] = row.pop("timestamp") / 1e9
    poses, notes = read(rows)
    assert poses[1].timestamp - poses[0].timestamp == pytest.approx(500_000_000, abs=1000)
    assert notes == []


@pytest.mark.parametrize("time", [1600000000.5, "1600000000.25", "soon", True, "nan", "1e999999999", [1], 2**80])
def test_times_that_are_no_whole_nanoseconds_are_refused(read, time):
    rows = drive()
    rows[3]["timestamp"] = time
    with pytest.raises(UserError, match=r"pose t3"):
        read(rows)


def test_equal_times_are_refused(read):
    rows = drive()
    rows[5]["timestamp"] = rows[4]["timestamp"]
    with pytest.raises(UserError, match="t4 and t5 have the same time"):
        read(rows)


@settings(max_examples=40, deadline=None)
@given(st.floats(-math.pi, math.pi))
def test_quaternions_in_the_other_order_are_noticed_at_every_heading(tmp_path_factory, yaw):
    path = tmp_path_factory.mktemp("poses") / "poses.json"
    rows = drive(yaw)
    path.write_text(json.dumps(rows))
    assert len(read_poses(path, [])) == len(rows)
    for row in rows:
        w, x, y, z = row["rotation"]
        row["rotation"] = [x, y, z, w]
    path.write_text(json.dumps(rows))
    with pytest.raises(UserError, match="x, y, z, w"):
        read_poses(path, [])


def test_a_car_that_backs_up_is_no_error_but_told(read):
    rows = drive(yaw=0.3)
    for row in rows:
        row["translation"] = [-value for value in row["translation"]]
    poses, notes = read(rows)
    assert len(poses) == len(rows)
    assert any("backwards" in note for note in notes)


def test_a_car_on_its_side_is_refused(read):
    rows = drive()
    for row in rows:
        row["rotation"] = [math.sqrt(0.5), math.sqrt(0.5), 0.0, 0.0]
    with pytest.raises(UserError, match="tilted"):
        read(rows)


def test_a_null_scene_is_no_name(read):
    rows = [row | {"scene": None} for row in drive()]
    assert {pose.scene for pose in read(rows)[0]} == {""}


def test_a_csv_that_is_not_utf_8_is_named(tmp_path):
    path = tmp_path / "poses.csv"
    path.write_bytes("token,timestamp,x,y,yaw,scene\nt,1,0,0,0,M\xfcnchen\n".encode("latin-1"))
    with pytest.raises(UserError, match="UTF-8"):
        read_poses(path)


def test_a_standing_car_has_no_direction(read):
    rows = drive(step=0.0)
    poses, notes = read(rows)
    assert np.ptp([pose.ego_to_global[0, 3] for pose in poses]) == 0
    assert notes == []
