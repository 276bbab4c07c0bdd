"""ROS 2 bags of logs that are drawn in the test."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore
from scipy.spatial.transform import Rotation

from mapfusion.arrays import Float
from predmapnet.datasets.own_logs.pose_files import read_timed_poses

STORE = get_typestore(Stores.ROS2_HUMBLE)
T = SimpleNamespace(**{name.rpartition("/")[2]: cls for name, cls in STORE.types.items()})


@dataclass
class Drawn:
    """Messages of a bag: topic, time and message; a test may change them before they are written."""

    messages: list[tuple[str, int, Any]] = field(default_factory=list)

    def change(self, topic: str, edit: Callable[[Any], None]) -> None:
        for _, _, message in self.of(topic):
            edit(message)

    def of(self, topic: str) -> list[tuple[str, int, Any]]:
        return [entry for entry in self.messages if entry[0] == topic]

    def drop(self, topic: str) -> None:
        self.messages = [entry for entry in self.messages if entry[0] != topic]

    def write(self, path: Path, storage: str = "mcap", compression: str = "none") -> Path:
        """Write the bag; ``compression`` is none, file, message or storage."""
        plugin = StoragePlugin.MCAP if storage == "mcap" else StoragePlugin.SQLITE3
        writer = Writer(path, version=9, storage_plugin=plugin)
        if compression != "none":
            writer.set_compression(CompressionMode[compression.upper()], CompressionFormat.ZSTD)
        with writer:
            topics: dict[str, Any] = {}
            for topic, time, message in sorted(self.messages, key=lambda entry: entry[1]):
                kind = message.__msgtype__
                if topic not in topics:
                    topics[topic] = writer.add_connection(topic, kind, typestore=STORE)
                writer.write(topics[topic], time, STORE.serialize_cdr(message, kind))
        return path


def header(time: int, frame: str) -> Any:
    return T.Header(stamp=T.Time(sec=time // 10**9, nanosec=time % 10**9), frame_id=frame)


def quaternion(rotation: Float) -> Any:
    return T.Quaternion(*Rotation.from_matrix(rotation).as_quat().tolist())


def transform(parent: str, child: str, time: int, pose: Float) -> Any:
    moved = T.Transform(translation=T.Vector3(*pose[:3, 3].tolist()), rotation=quaternion(pose[:3, :3]))
    return T.TransformStamped(header=header(time, parent), child_frame_id=child, transform=moved)


def odometry(parent: str, child: str, time: int, pose: Float) -> Any:
    there = T.Pose(position=T.Point(*pose[:3, 3].tolist()), orientation=quaternion(pose[:3, :3]))
    zero, nothing = T.Vector3(0.0, 0.0, 0.0), np.zeros(36)
    return T.Odometry(
        header=header(time, parent),
        child_frame_id=child,
        pose=T.PoseWithCovariance(pose=there, covariance=nothing),
        twist=T.TwistWithCovariance(twist=T.Twist(linear=zero, angular=zero), covariance=nothing),
    )


def camera_info(entry: dict[str, Any], time: int, frame: str) -> Any:
    k = entry["intrinsics"]
    matrix = np.array([k["fx"], 0.0, k["cx"], 0.0, k["fy"], k["cy"], 0.0, 0.0, 1.0])
    model = {"pinhole": "plumb_bob", "fisheye": "equidistant"}.get(entry["model"], entry["model"])
    return T.CameraInfo(
        header=header(time, frame),
        height=entry["height"],
        width=entry["width"],
        distortion_model=model,
        d=np.array(entry.get("distortion", [0.0] * 5)),
        k=matrix,
        r=np.eye(3).ravel(),
        p=np.insert(matrix, [3, 6, 9], 0.0),
        binning_x=0,
        binning_y=0,
        roi=T.RegionOfInterest(x_offset=0, y_offset=0, height=0, width=0, do_rectify=False),
    )


def compressed(data: bytes, time: int, frame: str, stated: str = "jpeg") -> Any:
    return T.CompressedImage(header=header(time, frame), format=stated, data=np.frombuffer(data, dtype=np.uint8))


def raw(image: np.ndarray, encoding: str, time: int, frame: str, padding: int = 0) -> Any:
    """An image ``(height, width[, channels])`` of bytes, its rows ``padding`` bytes longer than they need to be."""
    rows = np.pad(image.reshape(len(image), -1), ((0, 0), (0, padding)))
    height, width = image.shape[:2]
    step, data = rows.shape[1], rows.ravel()
    return T.Image(header(time, frame), height, width, encoding, is_bigendian=0, step=step, data=data)


def tf(transforms: Iterable[Any]) -> Any:
    return T.TFMessage(transforms=list(transforms))


def pose_of(entry: dict[str, Any]) -> Float:
    w, x, y, z = entry["camera_to_ego"]["rotation_wxyz"]
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_quat([x, y, z, w]).as_matrix()
    pose[:3, 3] = entry["camera_to_ego"]["translation_m"]
    return pose


def moved(x: float, y: float, z: float, yaw: float = 0.0) -> Float:
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_euler("z", yaw).as_matrix()
    pose[:3, 3] = x, y, z
    return pose


def bag_of(log: Path) -> Drawn:
    """The messages of a drawn log, as an Autoware car records them: ``map -> odom -> base_link`` and static mountings.

    Each camera's optical frame hangs on a mast, ``odom`` drifts against ``map``, and what is recorded comes 3 ms late.
    """
    content = json.loads((log / "calibration.json").read_text())
    poses, late, found = read_timed_poses(log), 3_000_000, Drawn()
    start = int(poses.timestamps[0])
    static = [transform("base_link", "base_footprint", 0, moved(0.0, 0.0, -content["ego_origin_above_road_m"])),
              transform("base_link", "mast", 0, moved(0.5, 0.0, 1.0, 0.3))]  # fmt: skip
    mast = np.linalg.inv(moved(0.5, 0.0, 1.0, 0.3))
    for name, entry in content["cameras"].items():
        static.append(transform("mast", f"{name}_optical", 0, mast @ pose_of(entry)))
        found.messages.append((f"/sensing/{name}/camera_info", start, camera_info(entry, start, f"{name}_optical")))
        for path in sorted((log / "images" / name).iterdir()):
            time = int(path.stem)
            image = compressed(path.read_bytes(), time, f"{name}_optical", "bgr8; jpeg compressed bgr8")
            found.messages.append((f"/sensing/{name}/image_raw/compressed", time + late, image))
    found.messages.append(("/tf_static", start, tf(static)))
    for row, (time, pose) in enumerate(zip(poses.timestamps.tolist(), poses.ego_to_global, strict=True)):
        drift = moved(10.0 + 0.05 * row, -3.0, 0.5, 0.4 + 0.002 * row)
        found.messages.append(("/tf", time + late, tf([transform("map", "odom", time, drift)])))
        there = transform("odom", "base_link", time, np.linalg.inv(drift) @ pose)
        found.messages.append(("/tf", time + late, tf([there])))
    return found
