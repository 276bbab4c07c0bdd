"""Logs of py123d (Arrow IPC) as logs of one's own; the package itself is not needed."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import cv2
import msgpack
import numpy as np
import pyarrow as pa

from mapfusion.arrays import Float
from predmapnet.datasets.fields import numbers_field
from predmapnet.datasets.images import stored_size
from predmapnet.datasets.own_logs.calibration import CALIBRATION, write_calibration
from predmapnet.datasets.own_logs.made_log import MadeLog, check_made_log, count_and_rate
from predmapnet.datasets.own_logs.pose_files import POSE_FILES
from predmapnet.datasets.own_logs.timed_poses import TimedPoses, write_timed_poses
from predmapnet.datasets.poses import pose_matrix
from predmapnet.errors import UserError
from predmapnet.files import file_name, whole_folder
from predmapnet.scenes import Progress

EGO, CAMERA = "ego_state_se3", "camera"
MICROSECOND = 1_000
QUALITY = 95
"""Of the JPEG files that frames of a video become."""


def log_from_py123d(
    folder: Path,
    out: Path,
    names: Sequence[str] = (),
    sensor_root: Path | None = None,
    progress: Progress = lambda done, total, what: None,
) -> MadeLog:
    """Write a log of one's own (docs/own-logs.md) from a log folder of py123d.

    The car's frame is the one of its poses there (``imu_se3``); its height above the road follows from the car's size.

    Args:
        folder: with ``ego_state_se3.arrow`` and ``camera.<name>.arrow``.
        out: folder to make; it is there whole or not at all.
        names: of the cameras to take; all pinholes if empty.
        sensor_root: where the files of logs lie whose images are not in the Arrow files.
        progress: of the cameras.

    Raises:
        UserError: ``out`` is there already, or the log lacks something or is damaged.
    """
    poses, height = _drive(folder / f"{EGO}.arrow")
    paths = {path.stem.removeprefix(f"{CAMERA}."): path for path in sorted(folder.glob(f"{CAMERA}.*.arrow"))}
    unknown = [name for name in names if name not in paths]
    if unknown or not paths:
        raise UserError(f"{folder} has no camera {', '.join(unknown)}; there are: {', '.join(paths) or 'none'}.")
    notes, entries, sources, counts = [], {}, {}, {}
    with whole_folder(out) as draft:
        for number, (name, path) in enumerate(paths.items()):
            progress(number, len(paths), "cameras")
            if names and name not in names:
                continue
            table, metadata = _table(path)
            model = metadata.get("camera_model")
            if model != "pinhole" or metadata.get("intrinsics") is None:
                reason = "no intrinsics" if model == "pinhole" else f"the camera model '{model}' is not read here"
                if name in names:
                    raise UserError(f"{path}: {reason}.")
                notes.append(f"left out: {name}: {reason}")
                continue
            entries[name] = _entry(metadata, path)
            sources[name] = path.name
            counts[name] = _write_images(table, path, draft / "images" / file_name(name), sensor_root, notes)
        progress(len(paths), len(paths), "cameras")
        if not entries:
            raise UserError(f"{folder}: no camera can be used: {'; '.join(notes)}.")
        write_calibration(draft / CALIBRATION, entries, height)
        write_timed_poses(draft / POSE_FILES[0], poses)
        check_made_log(draft, out, folder)
    return MadeLog(sources, counts, f"{EGO}.arrow, {count_and_rate(poses)}", notes, out)


def _table(path: Path) -> tuple[pa.Table, dict[str, Any]]:
    """Return the table of a file, its columns without the name of the file, and its metadata."""
    if not path.is_file():
        raise UserError(f"There is no {path}: a log folder of py123d has it.")
    try:
        table = pa.ipc.open_file(pa.memory_map(str(path))).read_all()
        table.validate(full=True)
        metadata = msgpack.unpackb((table.schema.metadata or {})[b"metadata"], strict_map_key=False)
        if not isinstance(metadata, dict):
            raise ValueError("its metadata are no dictionary")
        if len(set(table.column_names)) < table.num_columns:
            raise ValueError(f"it has a column twice: {', '.join(table.column_names)}")
    except (pa.ArrowException, OSError, KeyError, TypeError, ValueError) as error:
        raise UserError(f"{path} is no file of py123d, or damaged: {error}.") from error
    prefix = f"{path.stem}."
    return table.rename_columns([name.removeprefix(prefix) for name in table.column_names]), metadata


def _column(table: pa.Table, name: str, path: Path) -> list[Any]:
    if name not in table.column_names:
        raise UserError(f"{path}: the column '{name}' is missing; there are: {', '.join(table.column_names)}.")
    if pa.types.is_temporal(table[name].type):  # not all of them can be Python's
        raise UserError(f"{path}: the column '{name}' holds {table[name].type}, not numbers.")
    return list(table[name].to_pylist())


def _times(table: pa.Table, path: Path) -> list[Any]:
    """Return the times of the rows, nanoseconds; None where there is none."""
    times = _column(table, "timestamp_us", path)
    for time in times:
        if time is not None and not (isinstance(time, int) and 0 <= time * MICROSECOND < 2**63):
            raise UserError(f"{path}: '{time}' in the column 'timestamp_us' is no whole number of microseconds.")
    return [None if time is None else time * MICROSECOND for time in times]


def _pose(numbers: Any, where: str) -> Float:
    """Return a pose ``(4, 4)`` of x, y, z and the quaternion w, x, y, z."""
    numbers = numbers if isinstance(numbers, list) else []
    return pose_matrix(numbers[3:], numbers[:3], where)


def _drive(path: Path) -> tuple[TimedPoses, float]:
    """Return the poses of the car, and how high its frame is above the road."""
    table, metadata = _table(path)
    rows = dict(zip(_times(table, path), _column(table, "imu_se3", path), strict=True))
    rows.pop(None, None)
    if not rows:
        raise UserError(f"{path} holds no pose.")
    times = sorted(rows)
    poses = np.array([_pose(rows[time], f"{path}, time {time} ns") for time in times])
    try:
        height = float(metadata["height"]) / 2 - float(metadata["center_to_imu_se3"][2])
    except (KeyError, IndexError, TypeError, ValueError) as error:
        raise UserError(f"{path}: its metadata do not tell the height of the car and its centre: {error}.") from error
    return TimedPoses(np.array(times, dtype=np.int64), poses), height


def _entry(metadata: dict[str, Any], path: Path) -> dict[str, Any]:
    """Return the entry of ``calibration.json``; what is wrong in it is told when the log is opened."""
    _pose(metadata.get("camera_to_imu_se3"), f"{path}, camera_to_imu_se3")
    mounting = metadata["camera_to_imu_se3"]
    intrinsics = numbers_field(metadata, "intrinsics", (5,), str(path)).tolist()
    entry = {
        "width": metadata.get("width"),
        "height": metadata.get("height"),
        "model": "pinhole",
        # Both have the centre of the first pixel at (0, 0), as OpenCV.
        "intrinsics": dict(zip(("fx", "fy", "cx", "cy"), intrinsics[:4], strict=True)),
        "camera_to_ego": {"translation_m": mounting[:3], "rotation_wxyz": mounting[3:]},
    }
    distortion = metadata.get("distortion")
    return entry if distortion is None or metadata.get("is_undistorted") else entry | {"distortion": distortion}


def _write_images(table: pa.Table, path: Path, folder: Path, root: Path | None, notes: list[str]) -> int:
    """Write the images of a camera, and return how many."""
    folder.mkdir(parents=True)
    count, damaged = 0, 0
    for time, content in _images(table, path, root):
        try:
            ending = _ending(content, path)
        except UserError:
            damaged += 1
            continue
        (folder / f"{time}{ending}").write_bytes(content)
        count += 1
    if damaged:
        notes.append(f"lost: {damaged} damaged images of {path.name}")
    return count


def _images(table: pa.Table, path: Path, root: Path | None) -> Iterator[tuple[int, bytes]]:
    """Yield time (nanoseconds) and content of each image: within the table, beside it, or in a video."""
    times = _times(table, path)
    if "data" not in table.column_names:
        raise UserError(f"{path}: the column 'data' is missing.")
    if pa.types.is_temporal(table["data"].type):
        raise UserError(f"{path}: the column 'data' holds no images and no names of files.")
    video = cv2.VideoCapture(str(path.with_suffix(".mp4"))) if pa.types.is_integer(table["data"].type) else None
    for time, scalar in zip(times, table["data"], strict=True):
        data = scalar.as_py()
        if time is None or data is None:
            continue
        if isinstance(data, str):
            if root is None:
                raise UserError(f"{path}: its images are files ({data}); --sensor-root names the folder they lie in.")
            data = _file(root, data)
        elif video is not None:
            seen, image = video.read()
            done, encoded = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, QUALITY]) if seen else (False, None)
            if encoded is None or not done:
                raise UserError(f"{path.with_suffix('.mp4')} cannot be read, or ends before {path.name} does.")
            data = encoded.tobytes()
        if not isinstance(data, bytes):
            raise UserError(f"{path}: the column 'data' holds no images and no names of files.")
        yield time, data


def _file(root: Path, name: str) -> bytes:
    try:
        path = Path(os.path.realpath(root / name))
        if not path.is_relative_to(os.path.realpath(root)):
            raise UserError(f"The image {name} would lie outside of {root}.")
        return path.read_bytes()
    except ValueError as error:  # a name that no disk can hold
        raise UserError(f"There is no image {name!r} in {root}: {error}.") from None


def _ending(content: bytes, path: Path) -> str:
    stored_size(content, f"{path}: an image")
    return ".jpg" if content[:2] == b"\xff\xd8" else ".png"
