"""Poses of a drive at instants of their own, and between them."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from mapfusion.arrays import Bool, Float, Integer
from predmapnet.datasets.log_checks import check_clock, check_drive
from predmapnet.datasets.pose_rows import csv_pose_rows, nanoseconds, time_column
from predmapnet.datasets.poses import pose_matrix
from predmapnet.errors import UserError
from predmapnet.files import write_file

HOW = (
    "Each row needs timestamp_ns (or timestamp_us, timestamp_ms, timestamp_s), x, y, z in metres and qw, qx, qy, qz, "
    "or yaw in radians (docs/own-logs.md)"
)
LONGEST_GAP = 1_000_000_000
"""Poses farther apart say nothing about the way between them, nanoseconds."""
FARTHEST_BEYOND = 100_000_000
"""How far before the first and after the last pose the drive is carried on, nanoseconds."""


@dataclass(frozen=True)
class TimedPoses:
    """Poses of one drive.

    Attributes:
        timestamps: ``(n,) int64``, ascending, nanoseconds.
        ego_to_global: ``(n, 4, 4) float64``.
    """

    timestamps: Integer
    ego_to_global: Float

    def at(self, timestamp: int) -> Float:
        """Return the pose ``(4, 4)`` at any instant: a straight line and a steady turn between neighbours.

        Beyond the first and the last pose, the motion goes on for a tenth of a second and then stands still.
        """
        if len(self.timestamps) == 1:
            return np.array(self.ego_to_global[0])
        first, last = int(self.timestamps[0]), int(self.timestamps[-1])
        instant = min(max(timestamp, first - FARTHEST_BEYOND), last + FARTHEST_BEYOND)
        row = min(max(int(np.searchsorted(self.timestamps, instant, side="right")) - 1, 0), len(self.timestamps) - 2)
        start, stop = self.timestamps[row : row + 2].tolist()
        share = (instant - start) / (stop - start)
        before, after = self.ego_to_global[row], self.ego_to_global[row + 1]
        turn = Rotation.from_matrix(before[:3, :3].T @ after[:3, :3]).as_rotvec()
        pose = np.array(before)
        pose[:3, :3] = before[:3, :3] @ Rotation.from_rotvec(share * turn).as_matrix()
        pose[:3, 3] += share * (after[:3, 3] - before[:3, 3])
        return pose

    def cover(self, timestamps: Integer) -> Bool:
        """Tell of instants whether the drive is known there: not in a long gap, not far before or after the poses."""
        first, last = self.timestamps[[0, -1]]
        inside = (timestamps >= first - FARTHEST_BEYOND) & (timestamps <= last + FARTHEST_BEYOND)
        if len(self.timestamps) == 1:
            return np.asarray(inside)
        after = np.searchsorted(self.timestamps, timestamps, side="right").clip(1, len(self.timestamps) - 1)
        return np.asarray(inside & (self.timestamps[after] - self.timestamps[after - 1] <= LONGEST_GAP))


def read_timed_poses(folder: Path) -> TimedPoses:
    """Read the poses of a log.

    Raises:
        UserError: there is no such file, it is damaged, two poses have one time, or no car drives so.
    """
    path = folder / "poses.csv"
    if not path.is_file():
        raise UserError(f"There is no {path}: it says where the car was. {HOW}.")
    return _poses_of(csv_pose_rows(path, HOW), path)


def _poses_of(rows: Sequence[tuple[str, Mapping[str, Any]]], path: Path) -> TimedPoses:
    if not rows:
        raise UserError(f"{path} holds no pose. {HOW}.")
    timestamps = np.array([_time(row, f"{path}, {place}") for place, row in rows], dtype=np.int64)
    poses = np.array([pose_matrix(row["rotation"], row["translation"], f"{path}, {place}") for place, row in rows])
    order = np.argsort(timestamps, kind="stable")
    repeated = np.flatnonzero(np.diff(timestamps[order]) == 0)
    if len(repeated):
        places = " and ".join(rows[row][0] for row in order[repeated[0] : repeated[0] + 2].tolist())
        raise UserError(f"{path}: the poses of {places} have the same time. Are the times rounded?")
    quaternions = np.array([rows[row][1]["rotation"] for row in order.tolist()], dtype=np.float64)
    found = TimedPoses(timestamps[order], poses[order])
    check_clock(found.timestamps, found.ego_to_global[:, :2, 3], "nanoseconds", str(path))
    check_drive(quaternions, found.ego_to_global[:, :2, 3], str(path))
    return found


def _time(row: Mapping[str, Any], where: str) -> int:
    column = time_column(row)
    if row.get(column) is None:
        raise UserError(f"{where}: the time is missing. {HOW}.")
    try:
        return nanoseconds(row[column], column)
    except ValueError as error:
        raise UserError(f"{where}: {error}. {HOW}.") from error


def write_timed_poses(path: Path, poses: TimedPoses) -> None:
    """Write ``poses.csv``; raises UserError if that fails."""
    with write_file(path) as draft:
        draft.write_text("\n".join(["timestamp_ns,x,y,z,qw,qx,qy,qz", *_lines(poses)]) + "\n")


def _lines(poses: TimedPoses) -> Iterable[str]:
    for timestamp, pose in zip(poses.timestamps.tolist(), poses.ego_to_global, strict=True):
        x, y, z, w = Rotation.from_matrix(pose[:3, :3]).as_quat(canonical=True)
        yield f"{timestamp}," + ",".join(f"{value:.10f}" for value in (*pose[:3, 3], w, x, y, z))
