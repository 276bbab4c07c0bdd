"""Pose files in JSON or CSV: poses of frames by token."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from mapfusion.arrays import Float
from mapfusion.geometry import rigid_pose_problem
from predmapnet.datasets.fields import numbers
from predmapnet.datasets.large_tables import parse_json
from predmapnet.datasets.plausibility import (
    NANOSECONDS,
    drives_backwards,
    judged_unit,
    reordered_rotations,
    trajectory_problem,
    unit_quaternions,
)
from predmapnet.datasets.pose_rows import csv_pose_rows, nanoseconds, time_column
from predmapnet.datasets.poses import pose_matrix
from predmapnet.errors import UserError
from predmapnet.scenes import Instant

HOW = (
    "Each pose needs a token, a timestamp (integer nanoseconds; "
    "or timestamp_us, timestamp_ms, timestamp_s) and either ego_to_global (4 x 4), or translation "
    "(x, y, z) and rotation (quaternion w, x, y, z); in CSV the columns token, timestamp, x, y and either yaw "
    "(radians) or qw, qx, qy, qz; scene (or log) is optional"
)


@dataclass(frozen=True)
class FramePose(Instant):
    """Time and pose of a frame, as a file gives them.

    Attributes:
        scene: name of the drive, empty if the file does not say.
    """

    scene: str


def read_poses(path: Path, notes: list[str] | None = None) -> dict[str, FramePose]:
    """Read poses by token.

    JSON is an object ``{token: pose}`` or a list of poses that say their ``token``; nuScenes' names ``translation`` and
    ``rotation`` are understood. CSV has a head line. Time stamps that can only be of another unit are taken as such.

    Args:
        path: the file.
        notes: receives what the user should know of the file.

    Raises:
        UserError: no such file, a pose that is missing something, not finite, not rigid or given twice, or poses that
            no car has.
    """
    if not path.is_file():
        raise UserError(f"There is no file {path}.")
    rows = csv_pose_rows(path, HOW) if path.suffix.lower() == ".csv" else _json_rows(path)
    poses: dict[str, FramePose] = {}
    stated: set[bool] = set()
    for where, row in rows:
        pose, has_unit = _pose(f"{path}, {where}", row)
        if pose.token in poses:
            raise UserError(f"{path}, {where}: the token {pose.token} has a pose already.")
        poses[pose.token] = pose
        stated.add(has_unit)
    if not poses:
        raise UserError(f"{path} holds no pose. {HOW}.")
    if stated == {False}:
        poses = _in_nanoseconds(path, poses, notes)
    _check_drives(path, poses, [row for _, row in rows], notes)
    return poses


def _drives(poses: Mapping[str, FramePose]) -> list[list[FramePose]]:
    """Return the poses of each drive, in the order of time."""
    drives: dict[str, list[FramePose]] = {}
    for pose in sorted(poses.values(), key=lambda pose: pose.timestamp):
        drives.setdefault(pose.scene, []).append(pose)
    return list(drives.values())


def _in_nanoseconds(path: Path, poses: dict[str, FramePose], notes: list[str] | None) -> dict[str, FramePose]:
    """Return the poses with their times in nanoseconds, judged by size and speed where the file names no unit."""
    longest = max(_drives(poses), key=len)
    times = np.array([pose.timestamp for pose in longest], dtype=np.int64)
    unit = judged_unit(times, np.array([pose.ego_to_global[:2, 3] for pose in longest]))
    if unit == "nanoseconds":
        return poses
    if notes is not None:
        notes.append(f"the time stamps of {path.name} are taken as {unit}: in nanoseconds the car would be too fast")
    factor = NANOSECONDS[unit]
    return {token: replace(pose, timestamp=pose.timestamp * factor) for token, pose in poses.items()}


def _check_drives(
    path: Path, poses: Mapping[str, FramePose], rows: Sequence[Mapping[str, Any]], notes: list[str] | None
) -> None:
    """Raise UserError for equal times in a drive, and for a car that tilts or drives as no car does."""
    stored = dict(zip(poses, (row.get("rotation") for row in rows), strict=True))
    for drive in _drives(poses):
        for earlier, later in pairwise(drive):
            if earlier.timestamp == later.timestamp:
                raise UserError(
                    f"{path}: the poses {earlier.token} and {later.token} have the same time, {later.timestamp}; times "
                    "of a drive must differ. Are they rounded?"
                )
        positions = np.array([pose.ego_to_global[:2, 3] for pose in drive])
        rotations = np.array([pose.ego_to_global[:3, :3] for pose in drive])
        quaternions = unit_quaternions([stored[pose.token] for pose in drive])
        other = reordered_rotations(quaternions) if len(quaternions) == len(drive) else None
        problem = trajectory_problem(rotations, positions, other)
        if problem is not None:
            raise UserError(f"{path}: {problem}.")
        if notes is not None and drives_backwards(rotations, positions):
            notes.append(
                f"by {path.name} the car drives sideways or backwards throughout: the map is right only if it did; x "
                "of the ego frame points forward"
            )


def _json_rows(path: Path) -> list[tuple[str, Mapping[str, Any]]]:
    content = parse_json(path.read_bytes(), path, unique=True)
    if isinstance(content, dict):
        content = [{"token": token, **pose} if isinstance(pose, dict) else pose for token, pose in content.items()]
    if not isinstance(content, list):
        raise UserError(f"{path} holds neither an object nor a list of poses. {HOW}.")
    for number, row in enumerate(content):
        if not isinstance(row, dict):
            raise UserError(f"{path}, pose {number}: an object is expected, not {str(row)[:40]}. {HOW}.")
    return [(f"pose {row.get('token', number)}", row) for number, row in enumerate(content)]


def _pose(where: str, row: Mapping[str, Any]) -> tuple[FramePose, bool]:
    """Return a pose, and whether the name of its time says the unit."""
    column = time_column(row)
    missing = [name for name in ("token", column) if row.get(name) is None]
    if missing:
        raise UserError(f"{where}: {' and '.join(missing)} missing. {HOW}.")
    try:
        timestamp = nanoseconds(row[column], column)
        matrix = _matrix(where, row)
    except KeyError as error:
        raise UserError(f"{where}: {error} is missing. {HOW}.") from error
    except ValueError as error:
        raise UserError(f"{where}: {error}. {HOW}.") from error
    problem = rigid_pose_problem(matrix)
    if problem is not None:
        raise UserError(f"{where}: {problem}; its rotation is {np.round(matrix[:3, :3], 3).tolist()}.")
    scene = next((row[name] for name in ("scene", "log") if row.get(name) is not None), "")
    return FramePose(str(row["token"]), timestamp, matrix, str(scene)), column != "timestamp"


def _matrix(where: str, row: Mapping[str, Any]) -> Float:
    if "ego_to_global" in row:
        matrix = numbers(row["ego_to_global"])
        if matrix.size != 16:
            raise ValueError(f"ego_to_global has {matrix.size} numbers instead of 16")
        return matrix.reshape(4, 4)
    return pose_matrix(row["rotation"], row["translation"], where)
