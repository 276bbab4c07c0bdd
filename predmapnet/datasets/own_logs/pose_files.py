"""Pose files of a log: CSV, and text files in the layouts of TUM and KITTI."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from mapfusion.arrays import Float
from mapfusion.geometry import inverse_pose, rigid_pose_problem
from predmapnet.datasets.log_checks import check_clock, check_drive
from predmapnet.datasets.own_logs.timed_poses import TimedPoses, rows_apart
from predmapnet.datasets.plausibility import MOVING, STEEPEST
from predmapnet.datasets.pose_rows import csv_pose_rows, nanoseconds, time_column
from predmapnet.datasets.poses import pose_matrix
from predmapnet.errors import UserError

POSE_FILES = ("poses.csv", "poses.txt", "poses.tum", "poses.kitti")
TIMES_FILE = "times.txt"
HOW = (
    "Each row of poses.csv needs timestamp_ns (or timestamp_us, timestamp_ms, timestamp_s), x, y, z in metres and qw, "
    "qx, qy, qz, or yaw in radians; poses.txt may be of TUM (time x y z qx qy qz qw) or of KITTI (12 numbers, times in "
    "times.txt); see docs/own-logs.md"
)
TUM, KITTI = 8, 12
"""Numbers in a line."""
MOVED = 3.0
"""Shorter ways up and down may be noise, metres."""
WHOLE_NANOSECONDS = re.compile("[0-9]{16,}")
"""Times of TUM and KITTI are seconds; whole numbers as long as this can only be nanoseconds."""

Rows = Sequence[tuple[str, Mapping[str, Any]]]
"""Place in the file, and the time, ``translation`` and ``rotation`` (w, x, y, z) of each pose."""


def read_timed_poses(folder: Path, camera_to_ego: Float | None = None) -> TimedPoses:
    """Read the poses of a log.

    Args:
        folder: of the log.
        camera_to_ego: ``(4, 4)`` of the camera that the poses are of, if they are not of the car. Their global frame
            may have the axes of a camera, too (z ahead); it then becomes that of the car's first pose.

    Raises:
        UserError: there is no such file, or two; it is damaged, two poses have one time, or no car drives so.
    """
    found = [folder / name for name in POSE_FILES if (folder / name).is_file()]
    if len(found) != 1:
        several = f"{folder} has {' and '.join(path.name for path in found)}: which is right? Keep one."
        raise UserError(
            several if found else f"There is no {folder / POSE_FILES[0]}: it says where the car was. {HOW}."
        )
    path = found[0]
    rows = csv_pose_rows(path, HOW) if path.suffix == ".csv" else _text_rows(path)
    if not rows:
        raise UserError(f"{path} holds no pose. {HOW}.")
    timestamps = np.array([_time(row, f"{path}, {place}") for place, row in rows], dtype=np.int64)
    poses = np.array([pose_matrix(row["rotation"], row["translation"], f"{path}, {place}") for place, row in rows])
    order = np.argsort(timestamps, kind="stable")
    repeated = np.flatnonzero(np.diff(timestamps[order]) == 0)
    if len(repeated):
        places = " and ".join(rows[row][0] for row in order[repeated[0] : repeated[0] + 2].tolist())
        raise UserError(f"{path}: the poses of {places} have the same time. Are the times rounded?")
    drive = TimedPoses(timestamps[order], _of_car(poses[order], camera_to_ego))
    positions = drive.ego_to_global[:, :2, 3]
    check_clock(drive.timestamps, positions, "nanoseconds", str(path))
    stored = np.array([row["rotation"] for _, row in rows], dtype=np.float64)[order]
    if camera_to_ego is not None:
        stored = Rotation.from_matrix(drive.ego_to_global[:, :3, :3]).as_quat()[:, [3, 0, 1, 2]]
    # Of poses in close succession, none moves far enough to tell where the car drives.
    apart = rows_apart(positions, 2 * MOVING)
    judged = apart if len(apart) > 1 else slice(None)
    check_drive(stored[judged], positions[judged], str(path))
    _check_climb(drive.ego_to_global[:, :3, 3], path)
    return drive


def _check_climb(positions: Float, path: Path) -> None:
    """Raise UserError for a car that goes up or down more than along, as cameras do whose z axis points ahead."""
    steps = np.abs(np.diff(positions, axis=0))
    along, up = float(np.linalg.norm(steps[:, :2], axis=1).sum()), float(steps[:, 2].sum())
    if up > max(along, MOVED):
        raise UserError(
            f"{path}: the car would go {up:.0f} m up and down and {along:.0f} m along. Are the poses those of a camera "
            '(z ahead)? Then name it in calibration.json: "poses_of": "<camera>".'
        )


def _of_car(poses: Float, camera_to_ego: Float | None) -> Float:
    """Return ``ego_to_global`` of poses that are of a camera, or of the car already."""
    if camera_to_ego is None:
        return poses
    of_car = np.asarray(poses @ inverse_pose(camera_to_ego))
    if np.median(of_car[:, 2, 2]) >= np.cos(np.radians(STEEPEST)):
        return of_car
    return np.asarray(camera_to_ego @ of_car)


def _text_rows(path: Path) -> Rows:
    """Read lines of numbers; their count tells TUM from KITTI."""
    lines = _lines(path)
    counts = {len(words) for _, words in lines}
    if counts - {TUM, KITTI} or len(counts) > 1:
        shown = " and ".join(str(count) for count in sorted(counts))
        raise UserError(f"{path}: lines of {shown} numbers; 8 (TUM) or 12 (KITTI) are expected in all of them. {HOW}.")
    if counts == {TUM}:
        return [(place, _tum(words, f"{path}, {place}")) for place, words in lines]
    times = _lines(path.with_name(TIMES_FILE)) if path.with_name(TIMES_FILE).is_file() else []
    if len(times) != len(lines):
        raise UserError(
            f"{path} has {len(lines)} poses of KITTI, but {TIMES_FILE} beside it has {len(times)} times: one in each "
            "line is expected, in seconds, of the same clock as the images."
        )
    return [
        (place, _kitti(words, time[0], f"{path}, {place}"))
        for (place, words), (_, time) in zip(lines, times, strict=True)
    ]


def _lines(path: Path) -> list[tuple[str, list[str]]]:
    """Return place and words of each line that holds any; # begins a comment."""
    try:
        text = path.read_text(encoding="utf-8-sig")
    except UnicodeDecodeError as error:
        raise UserError(f"{path} is no text in UTF-8: {error}.") from error
    split = ((f"line {line}", words.partition("#")[0].replace(",", " ").split())
             for line, words in enumerate(text.splitlines(), start=1))  # fmt: skip
    return [(place, words) for place, words in split if words]


def _tum(words: list[str], where: str) -> dict[str, Any]:
    x, y, z, qx, qy, qz, qw = _numbers(words[1:], where)
    return {_unit(words[0]): words[0], "translation": [x, y, z], "rotation": [qw, qx, qy, qz]}


def _kitti(words: list[str], time: str, where: str) -> dict[str, Any]:
    pose = np.vstack([np.array(_numbers(words, where)).reshape(3, 4), [0.0, 0.0, 0.0, 1.0]])
    problem = rigid_pose_problem(pose)
    if problem is not None:
        raise UserError(f"{where}: {problem}.")
    x, y, z, w = Rotation.from_matrix(pose[:3, :3]).as_quat().tolist()
    return {_unit(time): time, "translation": pose[:3, 3].tolist(), "rotation": [w, x, y, z]}


def _numbers(words: list[str], where: str) -> list[float]:
    try:
        return [float(word) for word in words]
    except ValueError as error:
        raise UserError(f"{where}: {error}. {HOW}.") from error


def _unit(time: str) -> str:
    return "timestamp_ns" if WHOLE_NANOSECONDS.fullmatch(time) else "timestamp_s"


def _time(row: Mapping[str, Any], where: str) -> int:
    column = time_column(row)
    if row.get(column) is None:
        raise UserError(f"{where}: the time is missing. {HOW}.")
    try:
        return nanoseconds(row[column], column)
    except ValueError as error:
        raise UserError(f"{where}: {error}. {HOW}.") from error
