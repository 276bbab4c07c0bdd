"""Drives of KITTI raw and scenes of PandaSet as logs of one's own."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from mapfusion.arrays import Float
from mapfusion.formats.local_plane import LocalPlane
from mapfusion.geometry import inverse_pose, rigid_pose_problem
from predmapnet.datasets.fields import numbers_field
from predmapnet.datasets.georeference import plane_at
from predmapnet.datasets.images import stored_size
from predmapnet.datasets.large_tables import parse_json
from predmapnet.datasets.own_logs.calibration import CALIBRATION, HALF_A_PIXEL, write_rig
from predmapnet.datasets.own_logs.made_log import MadeLog, check_made_log, count_and_rate
from predmapnet.datasets.own_logs.pose_files import POSE_FILES
from predmapnet.datasets.own_logs.timed_poses import TimedPoses, write_timed_poses
from predmapnet.datasets.pose_rows import nanoseconds
from predmapnet.datasets.poses import pose_matrix
from predmapnet.errors import UserError
from predmapnet.files import whole_folder
from predmapnet.scenes import Camera, Rig

KITTI_CAMERAS = ("image_02", "image_00", "image_03", "image_01")
"""Left colour, left grey, right colour, right grey: all see the same, so the first that is there is taken."""
ABOVE_ROAD = 0.93
"""Height of KITTI's GPS/IMU, whose frame is the car's, above the road, metres, by the data set's drawing of the car."""
PANDASET_AXES = np.array([[0.0, -1.0, 0.0, 0.0], [1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]])
"""From our ego frame (x ahead, y left) to PandaSet's (x right, y ahead)."""
NOTED, LARGEST = 0.1, 1.0
"""Metres by which a camera may move on its car until that is noted, and until it is no car's camera."""

Images = Mapping[str, Mapping[int, Path]]
"""Files by camera and time, nanoseconds."""


def log_from_kitti(drive: Path, out: Path) -> MadeLog:
    """Write a log of one's own (docs/own-logs.md) from a drive of KITTI raw.

    Args:
        drive: ``<date>_drive_NNNN_sync``, with the calibration of the day in the folder around it.
        out: folder to make; it is there whole or not at all.

    Raises:
        UserError: ``out`` is there already, or the drive lacks something, is damaged, or is not rectified.
    """
    folder = Path(os.path.realpath(drive))
    if folder.name.endswith("_extract"):
        raise UserError(f"{drive} holds images that are not rectified. Take the drive that ends with _sync.")
    name, *others = [name for name in KITTI_CAMERAS if (drive / name / "data").is_dir()] or KITTI_CAMERAS[:1]
    images = _kitti_files(drive / name, ".png")
    camera = _kitti_camera(folder.parent, name, next(iter(images.values())))
    packets = _kitti_files(drive / "oxts", ".txt")
    # Latitude and longitude, degrees, altitude, metres, roll, pitch and yaw (0 is east), radians.
    first = "first words"
    words = {path: _content(path).decode(errors="replace").split()[:6] for path in packets.values()}
    rows = np.array([_numbers({first: six}, first, (6,), path) for path, six in words.items()])
    plane = plane_at(float(rows[0, 0]), float(rows[0, 1]), "first pose", str(next(iter(packets.values()))))
    poses = np.tile(np.eye(4), (len(rows), 1, 1))
    try:
        # The Mercator projection on a sphere of the official code is 0.1 to 0.2 % off.
        poses[:, :2, 3] = plane.from_wgs84(rows[:, 1::-1])
    except ValueError as error:
        raise UserError(f"{drive / 'oxts'}: {error}.") from None
    poses[:, 2, 3] = rows[:, 2]
    poses[:, :3, :3] = Rotation.from_euler("ZYX", rows[:, :2:-1]).as_matrix()
    notes = [f"left out: {', '.join(others)}, which see what {name} sees"] if others else []
    log = (camera,), TimedPoses(np.array(list(packets)), poses), {name: images}
    return _write(out, drive, log, notes, plane)


def log_from_pandaset(scene: Path, out: Path, height: float | None = None) -> MadeLog:
    """Write a log of one's own (docs/own-logs.md) from a scene of PandaSet.

    The car's frame is that of ``lidar/poses.json``, with x ahead; where the cameras are on it follows from their poses.

    Args:
        scene: with ``camera/<name>`` and ``lidar``.
        out: folder to make; it is there whole or not at all.
        height: of the car's frame above the road, metres; it is taken to lie on the road without.

    Raises:
        UserError: ``out`` is there already, or the scene lacks something or is damaged.
    """
    lidar = _pandaset_poses(scene / "lidar")
    drive = TimedPoses(lidar.timestamps, lidar.ego_to_global @ PANDASET_AXES)
    rig, images, notes = [], {}, []
    if height is None:
        notes.append("the poses are taken to lie on the road; --height says how far above it they are")
    for folder in sorted(path for path in scene.glob("camera/*") if path.is_dir()) or [scene / "camera/front_camera"]:
        taken = _pandaset_poses(folder)
        files = {int(time): folder / f"{row:02d}.jpg" for row, time in enumerate(taken.timestamps)}
        images[folder.name] = {time: path for time, path in files.items() if path.is_file()}
        missing = len(files) - len(images[folder.name])
        if missing:
            notes.append(f"missing: {missing} images of {folder.name}")
        mounting, moved = _mounting(taken, drive, folder)
        if moved > NOTED:
            notes.append(f"{folder.name} moves by up to {moved:.2f} m on the car, by its poses; the middle is taken")
        path = folder / "intrinsics.json"
        stated = parse_json(_content(path), path)
        values = stated if isinstance(stated, dict) else {}
        focal_and_centre = [float(_numbers(values, key, (), path)) for key in ("fx", "fy", "cx", "cy")]
        image = next(iter(images[folder.name].values()), folder / "00.jpg")
        rig.append(_camera(image, folder.name, focal_and_centre, mounting, height or 0.0))
    return _write(out, scene, (tuple(rig), drive, images), notes)


def _write(
    out: Path, source: Path, log: tuple[Rig, TimedPoses, Images], notes: list[str], plane: LocalPlane | None = None
) -> MadeLog:
    """Write the folder of a log; raises UserError, naming ``source``, if no log came of it."""
    rig, poses, images = log
    counts: dict[str, int] = {}
    with whole_folder(out) as draft:
        for name, files in images.items():
            (draft / "images" / name).mkdir(parents=True)
            damaged = sum(
                not _copied(path, draft / "images" / name / f"{time}{path.suffix}") for time, path in files.items()
            )
            counts[name] = len(files) - damaged
            if damaged:
                notes.append(f"lost: {damaged} damaged images of {name}")
        write_rig(draft / CALIBRATION, rig)
        write_timed_poses(draft / POSE_FILES[0], poses)
        if plane is not None:
            place = {"latitude": plane.latitude, "longitude": plane.longitude}
            (draft / "georeference.json").write_text(json.dumps(place))
        check_made_log(draft, out, source)
    folders = {name: str(next(iter(files.values())).parent) for name, files in images.items()}
    return MadeLog(folders, counts, count_and_rate(poses), notes, out)


def _copied(image: Path, to: Path) -> bool:
    """Copy an image, and return whether it is a whole one; others are left out."""
    content = _content(image)
    try:
        stored_size(content, str(image))
    except UserError:
        return False
    to.write_bytes(content)
    return True


def _content(path: Path) -> bytes:
    if not path.is_file():
        raise UserError(f"There is no {path}: drives of KITTI raw and scenes of PandaSet have it.")
    return path.read_bytes()


def _numbers(values: Mapping[str, Any], name: str, shape: tuple[int, ...], path: Path) -> Float:
    return numbers_field(values, name, shape, str(path))


def _camera(image: Path, name: str, focal_and_centre: list[float], mounting: Float, height: float) -> Camera:
    """Return a pinhole camera of the size of one of its images; pixels are OpenCV's."""
    fx, fy, cx, cy = focal_and_centre
    intrinsics = np.array([[fx, 0.0, cx + HALF_A_PIXEL], [0.0, fy, cy + HALF_A_PIXEL], [0.0, 0.0, 1.0]])
    return Camera(name, *stored_size(_content(image), str(image)), intrinsics, mounting, -height)


def _kitti_files(folder: Path, ending: str) -> dict[int, Path]:
    """Return the files in ``data`` by time, nanoseconds, ascending; a file's number is that of its line of time."""
    times = folder / "timestamps.txt"
    lines = _content(times).decode(errors="replace").splitlines()
    found: dict[int, Path] = {}
    for path in sorted((folder / "data").glob(f"*{ending}")):
        number = int(path.stem) if path.stem.isdecimal() and len(path.stem) < 20 else len(lines)
        if number >= len(lines):
            raise UserError(f"{times} has {len(lines)} lines, and none for {path.name}.")
        try:
            time = int(np.datetime64(lines[number].strip(), "ns").astype(np.int64))
        except ValueError as error:
            raise UserError(f"{times}, line {number + 1}: {error}.") from None
        if time <= next(reversed(found), -1):
            raise UserError(f"{times}, line {number + 1}: no time after that of the file before.")
        found[time] = path
    if not found:
        raise UserError(f"{folder / 'data'} holds no file *{ending}.")
    return found


def _kitti_motion(path: Path, rotation: str = "R", translation: str | None = "T") -> Float:
    """Return the rigid motion ``(4, 4)`` of two lines of a calibration file."""
    values, pose = _kitti_lines(path), np.eye(4)
    pose[:3, :3] = _numbers(values, rotation, (9,), path).reshape(3, 3)
    if translation is not None:
        pose[:3, 3] = _numbers(values, translation, (3,), path)
    problem = rigid_pose_problem(pose)
    if problem is not None:
        raise UserError(f"{path}, '{rotation}': {problem}.")
    return pose


def _kitti_lines(path: Path) -> dict[str, Any]:
    """Return the words of each line of a calibration file by the line's name."""
    lines = (line.partition(":") for line in _content(path).decode(errors="replace").splitlines())
    return {name: words.split() for name, _, words in lines}


def _kitti_camera(day: Path, name: str, image: Path) -> Camera:
    """Return a rectified camera: ``P_rect R_rect_00 velo_to_cam imu_to_velo`` takes the IMU's frame to its pixels.

    The last column of ``P_rect`` holds the way from the first camera to this one.
    """
    path, line = day / "calib_cam_to_cam.txt", f"P_rect_{name.removeprefix('image_')}"
    projection = _numbers(_kitti_lines(path), line, (12,), path).reshape(3, 4)
    focal_and_centre = projection[[0, 1, 0, 1], [0, 1, 2, 2]]
    expected = np.array([[focal_and_centre[0], 0, focal_and_centre[2]], [0, *focal_and_centre[1::2]], [0, 0, 1]])
    if not (focal_and_centre[:2] > 0).all() or not np.array_equal(projection[:, :3], expected):
        raise UserError(f"{path}, '{line}': no projection of a rectified camera.")
    from_first = np.eye(4)
    from_first[:3, 3] = np.linalg.solve(expected, projection[:, 3])
    to_first = _kitti_motion(path, "R_rect_00", None) @ _kitti_motion(day / "calib_velo_to_cam.txt")
    mounting = inverse_pose(from_first @ to_first @ _kitti_motion(day / "calib_imu_to_velo.txt"))
    return _camera(image, name, focal_and_centre.tolist(), mounting, ABOVE_ROAD)


def _pandaset_poses(folder: Path) -> TimedPoses:
    """Return the poses of a sensor in the world, with their times."""
    path, clock = folder / "poses.json", folder / "timestamps.json"
    poses, times = parse_json(_content(path), path), parse_json(_content(clock), clock)
    if not (isinstance(poses, list) and isinstance(times, list) and len(poses) == len(times) > 0):
        raise UserError(f"{folder}: poses.json and timestamps.json must be lists of equal length.")
    try:
        parts = [([p["heading"][axis] for axis in "wxyz"], [p["position"][axis] for axis in "xyz"]) for p in poses]
    except (TypeError, KeyError):
        raise UserError(f"{path}: every pose needs a position x, y, z and a heading w, x, y, z.") from None
    matrices = [pose_matrix(*part, f"{path}, pose {row}") for row, part in enumerate(parts)]
    try:
        stamps = np.array([nanoseconds(time, "timestamp_s") for time in times], dtype=np.int64)
    except ValueError as error:
        raise UserError(f"{clock}: {error}.") from None
    if not (np.diff(stamps, prepend=-1) > 0).all():
        raise UserError(f"{clock}: the times do not ascend.")
    return TimedPoses(stamps, np.array(matrices))


def _mounting(taken: TimedPoses, drive: TimedPoses, folder: Path) -> tuple[Float, float]:
    """Return the middle ``camera_to_ego`` of all images, and the metres by which the farthest one differs."""
    known = drive.cover(taken.timestamps)
    if not known.any():
        raise UserError(f"{folder / 'timestamps.json'}: no time at which lidar/poses.json says where the car was.")
    pairs = zip(taken.timestamps[known].tolist(), taken.ego_to_global[known], strict=True)
    found = np.array([inverse_pose(drive.at(time)) @ pose for time, pose in pairs])
    mounting = np.eye(4)
    mounting[:3, :3] = Rotation.from_matrix(found[:, :3, :3]).mean().as_matrix()
    mounting[:3, 3] = np.median(found[:, :3, 3], axis=0)
    moved = float(np.linalg.norm(found[:, :3, 3] - mounting[:3, 3], axis=1).max())
    if moved > LARGEST:
        raise UserError(f"{folder / 'poses.json'}: by lidar/poses.json, this camera moves {moved:.1f} m on its car.")
    return mounting, moved
