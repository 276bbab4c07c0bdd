"""Drawn logs in the layouts of other people's recordings: KITTI raw, PandaSet and py123d."""

import json
import shutil
from pathlib import Path
from typing import Any

import cv2
import msgpack
import numpy as np
import pyarrow as pa
from scipy.spatial.transform import Rotation

from predmapnet.datasets.own_logs.pose_files import read_timed_poses
from predmapnet.datasets.own_logs.scene import LogScene
from tests.predmapnet.datasets.own_logs.drawn_log import ABOVE_ROAD

LATITUDE, LONGITUDE = 49.0112, 8.4229


def line(name: str, values) -> str:
    return f"{name}: " + " ".join(f"{value:.12e}" for value in np.ravel(values))


def _image(path: Path | str) -> np.ndarray:
    image = cv2.imread(str(path))
    assert image is not None, path
    return image


def clock(nanoseconds: int) -> str:
    seconds, rest = divmod(int(nanoseconds), 10**9)
    return str(np.datetime64(seconds, "s")).replace("T", " ") + f".{rest:09d}"


def geodetic(east: float, north: float) -> tuple[float, float]:
    """Latitude and longitude, by the equations of an east-north-up frame at LATITUDE, LONGITUDE (WGS84)."""
    a, e2 = 6378137.0, 6.69437999014e-3
    p, t = np.radians([LATITUDE, LONGITUDE])
    n = a / np.sqrt(1 - e2 * np.sin(p) ** 2)
    origin = np.array([n * np.cos(p) * np.cos(t), n * np.cos(p) * np.sin(t), n * (1 - e2) * np.sin(p)])
    axes = np.array([[-np.sin(t), np.cos(t), 0], [-np.sin(p) * np.cos(t), -np.sin(p) * np.sin(t), np.cos(p)]])
    x, y, z = origin + east * axes[0] + north * axes[1]
    latitude = np.arctan2(z, np.hypot(x, y) * (1 - e2))
    for _ in range(5):
        radius = a / np.sqrt(1 - e2 * np.sin(latitude) ** 2)
        latitude = np.arctan2(z + e2 * radius * np.sin(latitude), np.hypot(x, y))
    return float(np.degrees(latitude)), float(np.degrees(np.arctan2(y, x)))


def write_kitti(log: LogScene, day, camera: str = "02"):
    """The front camera as KITTI raw: its mounting split over the four calibration files."""
    drive = day / "2011_09_26_drive_0001_sync"
    front = log.rig[0]
    lidar, first = np.eye(4), np.eye(4)  # of the ego frame
    lidar[:3, :3], lidar[:3, 3] = Rotation.from_euler("xyz", [0.01, -0.02, 0.03]).as_matrix(), [0.8, -0.3, 0.7]
    rectified = front.camera_to_ego[:3, :3]
    turn = Rotation.from_euler("xyz", [0.01, 0.005, -0.007]).as_matrix()  # of rectification
    baseline = np.array([-0.06, 0.0003, 0.002])  # of this camera in the first one's rectified frame
    first[:3, :3], first[:3, 3] = rectified @ turn, front.camera_to_ego[:3, 3] - rectified @ baseline
    k = front.intrinsics - np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])
    to_lidar, to_first = np.linalg.inv(lidar), np.linalg.inv(first) @ lidar
    day.mkdir()
    for name, pose in (("imu_to_velo", to_lidar), ("velo_to_cam", to_first)):
        text = ["calib_time: 25-May-2012 16:47:16", line("R", pose[:3, :3]), line("T", pose[:3, 3])]
        (day / f"calib_{name}.txt").write_text("\n".join(text) + "\n")
    text = ["calib_time: 09-Jan-2012 13:57:47", "corner_dist: 9.950000e-02", line("R_rect_00", turn),
            line("R_rect_02", np.eye(3)), line(f"P_rect_{camera}", np.c_[k, k @ -baseline])]  # fmt: skip
    (day / "calib_cam_to_cam.txt").write_text("\n".join(text) + "\n")
    times, paths = log.images["front_camera"]
    images, oxts = drive / f"image_{camera}", drive / "oxts"
    for folder, stamps in ((images, times), (oxts, log.poses.timestamps)):
        (folder / "data").mkdir(parents=True)
        (folder / "timestamps.txt").write_text("\n".join(map(clock, stamps)) + "\n")
    for row, path in enumerate(paths):
        cv2.imwrite(str(images / "data" / f"{row:010d}.png"), _image(path))
    for row, pose in enumerate(log.poses.ego_to_global):
        yaw, pitch, roll = Rotation.from_matrix(pose[:3, :3]).as_euler("ZYX")
        packet = [*geodetic(*pose[:2, 3]), 116.0 + pose[2, 3], roll, pitch, yaw, *[0.0] * 19, 4, 11, 6, 6, 6]
        (oxts / "data" / f"{row:010d}.txt").write_text(" ".join(map(repr, map(float, packet))) + "\n")
    return drive


def write_pandaset(log: LogScene, scene):
    """The log as a scene of PandaSet, whose car has x right and y ahead."""
    turned = np.array([[0, 1, 0, 0], [-1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1.0]])  # theirs in our ego frame
    sensors = {"lidar": (log.poses.timestamps, [pose @ turned for pose in log.poses.ego_to_global])}
    for camera in log.rig:
        times, paths = log.images[camera.name]
        poses = [log.poses.at(int(time)) @ camera.camera_to_ego for time in times]
        sensors[f"camera/{camera.name}"] = (times, poses)
        folder = scene / "camera" / camera.name
        folder.mkdir(parents=True)
        for row, path in enumerate(paths):
            shutil.copyfile(path, folder / f"{row:02d}.jpg")
        k = camera.intrinsics
        values = {"fx": k[0, 0], "fy": k[1, 1], "cx": k[0, 2] - 0.5, "cy": k[1, 2] - 0.5}
        (folder / "intrinsics.json").write_text(json.dumps(values))
    (scene / "lidar").mkdir()
    for name, (times, poses) in sensors.items():
        listed = []
        for pose in poses:
            x, y, z, w = Rotation.from_matrix(pose[:3, :3]).as_quat().tolist()
            place = dict(zip("xyz", pose[:3, 3].tolist(), strict=True))
            listed.append({"position": place, "heading": {"w": w, "x": x, "y": y, "z": z}})
        (scene / name / "poses.json").write_text(json.dumps(listed))
        (scene / name / "timestamps.json").write_text(json.dumps([int(time) / 1e9 for time in times]))
    return scene


def numbers_of(log: Path) -> dict[str, Any]:
    """The log as numbers: see ``write_py123d_log.py``."""
    poses = read_timed_poses(log)
    rows = []
    for time, pose in zip(poses.timestamps.tolist(), poses.ego_to_global, strict=True):
        x, y, z, w = Rotation.from_matrix(pose[:3, :3]).as_quat().tolist()
        rows.append([time // 1000, *pose[:3, 3].tolist(), w, x, y, z])
    cameras = {}
    for name, camera in json.loads((log / "calibration.json").read_text())["cameras"].items():
        mounting = camera["camera_to_ego"]
        cameras[name] = {
            "width": camera["width"],
            "height": camera["height"],
            "intrinsics": [*camera["intrinsics"].values(), 0.0],
            "distortion": camera.get("distortion"),
            "pose": [*mounting["translation_m"], *mounting["rotation_wxyz"]],
            "images": [[int(p.stem) // 1000, str(p)] for p in sorted((log / "images" / name).iterdir())],
        }
    return {"height": ABOVE_ROAD, "poses": rows, "cameras": cameras}


def write_table(folder: Path, key: str, columns: dict[str, Any], metadata: dict[str, Any]) -> None:
    """A file of a modality, laid out as py123d 0.7.0 does."""
    table = pa.table({f"{key}.{name}": column for name, column in columns.items()})
    with pa.ipc.new_file(
        str(folder / f"{key}.arrow"), table.schema.with_metadata({"metadata": msgpack.packb(metadata)})
    ) as file:
        file.write_table(table)


def write_py123d(log: Path, folder: Path, codec: str = "jpeg_binary") -> Path:
    folder.mkdir()
    numbers = numbers_of(log)
    car = {"height": 1.8, "center_to_imu_se3": [1.4, 0.0, 0.9 - numbers["height"], 1.0, 0.0, 0.0, 0.0]}
    times, poses = [row[0] for row in numbers["poses"]], [row[1:] for row in numbers["poses"]]
    write_table(folder, "ego_state_se3", {"timestamp_us": pa.array(times, pa.int64()), "imu_se3": poses}, car)
    for name, camera in numbers["cameras"].items():
        times, paths = [image[0] for image in camera["images"]], [image[1] for image in camera["images"]]
        data: Any = [Path(path).read_bytes() if codec == "jpeg_binary" else Path(path).name for path in paths]
        if codec == "mp4":
            size = (camera["width"], camera["height"])
            video = cv2.VideoWriter(str(folder / f"camera.{name}.mp4"), cv2.VideoWriter.fourcc(*"mp4v"), 10.0, size)
            for path in paths:
                video.write(_image(path))
            video.release()
            data = pa.array(range(len(paths)), pa.int32())
        metadata = {"camera_model": "pinhole", "camera_to_imu_se3": camera["pose"], "is_undistorted": False}
        metadata |= {key: camera[key] for key in ("width", "height", "intrinsics", "distortion")}
        columns = {"timestamp_us": pa.array(times, pa.int64()), "data": data}
        write_table(folder, f"camera.{name}", columns, metadata)
    return folder
