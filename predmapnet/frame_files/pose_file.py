"""Pose files in JSON or CSV: poses of frames by token."""

from __future__ import annotations

import csv
import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import orjson

from mapfusion.arrays import Float
from mapfusion.geometry import rigid_pose_problem
from predmapnet.datasets.poses import pose_matrix
from predmapnet.errors import UserError
from predmapnet.scenes import Instant

HOW = (
    "Each pose needs a token, a timestamp (integer nanoseconds) and either ego_to_global (4 x 4), or translation "
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


def read_poses(path: Path) -> dict[str, FramePose]:
    """Read poses by token.

    JSON is an object ``{token: pose}`` or a list of poses that say their ``token``; nuScenes' names ``translation`` and
    ``rotation`` are understood. CSV has a head line.

    Raises:
        UserError: no such file, or a pose that is missing something, not finite, not rigid or given twice.
    """
    if not path.is_file():
        raise UserError(f"There is no file {path}.")
    rows = _csv_rows(path) if path.suffix.lower() == ".csv" else _json_rows(path)
    poses: dict[str, FramePose] = {}
    for where, row in rows:
        pose = _pose(f"{path}, {where}", row)
        if pose.token in poses:
            raise UserError(f"{path}, {where}: the token {pose.token} has a pose already.")
        poses[pose.token] = pose
    if not poses:
        raise UserError(f"{path} holds no pose. {HOW}.")
    return poses


def _json_rows(path: Path) -> list[tuple[str, Mapping[str, Any]]]:
    try:
        content = orjson.loads(path.read_bytes())
    except orjson.JSONDecodeError as error:
        raise UserError(f"{path} is not valid JSON: {error}. NaN is not JSON, either.") from error
    if isinstance(content, dict):
        content = [{"token": token, **pose} if isinstance(pose, dict) else pose for token, pose in content.items()]
    if not isinstance(content, list):
        raise UserError(f"{path} holds neither an object nor a list of poses. {HOW}.")
    for number, row in enumerate(content):
        if not isinstance(row, dict):
            raise UserError(f"{path}, pose {number}: an object is expected, not {str(row)[:40]}. {HOW}.")
    return [(f"pose {row.get('token', number)}", row) for number, row in enumerate(content)]


def _csv_rows(path: Path) -> list[tuple[str, Mapping[str, Any]]]:
    with path.open(encoding="utf-8-sig", newline="") as file:
        rows = list(csv.DictReader(file))
    result: list[tuple[str, Mapping[str, Any]]] = []
    for line, row in enumerate(rows, start=2):
        values: dict[str, Any] = {key.strip(): value for key, value in row.items() if key and value not in (None, "")}
        try:
            values["translation"] = [float(values[axis]) for axis in "xy"] + [float(values.get("z", 0.0))]
            if "yaw" in values:
                half = float(values["yaw"]) / 2
                values["rotation"] = [math.cos(half), 0.0, 0.0, math.sin(half)]
            else:
                values["rotation"] = [float(values[name]) for name in ("qw", "qx", "qy", "qz")]
        except KeyError as error:
            raise UserError(f"{path}, line {line}: {error} is missing. {HOW}.") from error
        except ValueError as error:
            raise UserError(f"{path}, line {line}: {error}.") from error
        result.append((f"line {line}", values))
    return result


def _pose(where: str, row: Mapping[str, Any]) -> FramePose:
    missing = [name for name in ("token", "timestamp") if name not in row]
    if missing:
        raise UserError(f"{where}: {' and '.join(missing)} missing. {HOW}.")
    try:
        timestamp = int(row["timestamp"])
        matrix = _matrix(where, row)
    except KeyError as error:
        raise UserError(f"{where}: {error} is missing. {HOW}.") from error
    except (TypeError, ValueError) as error:
        raise UserError(f"{where}: {error}. {HOW}.") from error
    problem = rigid_pose_problem(matrix)
    if problem is not None:
        raise UserError(f"{where}: {problem}; its rotation is {np.round(matrix[:3, :3], 3).tolist()}.")
    return FramePose(str(row["token"]), timestamp, matrix, str(row.get("scene", row.get("log", ""))))


def _matrix(where: str, row: Mapping[str, Any]) -> Float:
    if "ego_to_global" in row:
        matrix = np.array(row["ego_to_global"], dtype=np.float64)
        if matrix.size != 16:
            raise ValueError(f"ego_to_global has {matrix.size} numbers instead of 16")
        return matrix.reshape(4, 4)
    return pose_matrix(row["rotation"], row["translation"], where)
