"""The thirteen tables of a nuScenes data set with one demo scene: https://www.nuscenes.org/nuscenes#data-format."""

from __future__ import annotations

import hashlib
from datetime import UTC, datetime
from typing import Any

from scipy.spatial.transform import Rotation

from mapfusion.arrays import Float
from predmapnet.demo_world.rig import LIDAR_TO_EGO
from predmapnet.demo_world.world import Trajectory, World
from predmapnet.scenes import Rig

Record = dict[str, Any]

LIDAR = "LIDAR_TOP"

LOCATION = "singapore-onenorth"
"""The official devkit accepts only its own four locations; ``demo_world.json`` says where the scene really lies."""


def token(*names: object) -> str:
    """A token of 32 hexadecimal digits that is always the same for the same names."""
    return hashlib.md5("/".join(map(str, names)).encode(), usedforsecurity=False).hexdigest()


def sample_file_name(scene: str, channel: str, timestamp: int) -> str:
    """Path of one measurement below the root; ``timestamp`` in nanoseconds."""
    ending = "pcd.bin" if channel == LIDAR else "jpg"
    return f"samples/{channel}/demo-{scene}__{channel}__{timestamp // 1000}.{ending}"


def build_tables(world: World, rig: Rig) -> dict[str, list[Record]]:
    """Return the records of all tables by name, linked by tokens that depend only on the scene's name."""
    name = world.name
    channels = [camera.name for camera in rig] + [LIDAR]
    return {
        "category": [],
        "attribute": [],
        "visibility": _visibility(),
        "instance": [],
        "sensor": [
            {
                "token": token("sensor", channel),
                "channel": channel,
                "modality": "lidar" if channel == LIDAR else "camera",
            }
            for channel in channels
        ],
        "calibrated_sensor": _calibrated_sensors(name, rig),
        "ego_pose": _ego_poses(name, channels, world.trajectory),
        "log": [
            {
                "token": token(name, "log"),
                "logfile": f"demo-world-{name}",
                "vehicle": "demo",
                "date_captured": datetime.fromtimestamp(int(world.trajectory.timestamps[0]) // 10**9, tz=UTC)
                .date()
                .isoformat(),
                "location": LOCATION,
            }
        ],
        "scene": [_scene(world)],
        "sample": _samples(name, world.trajectory),
        "sample_data": _sample_data(name, rig, world.trajectory),
        "sample_annotation": [],
        "map": [
            {
                "category": "semantic_prior",
                "token": token(name, "map"),
                "filename": f"maps/{token(name, 'map')}.png",
                "log_tokens": [token(name, "log")],
            }
        ],
    }


def _visibility() -> list[Record]:
    levels = [(0, 40), (40, 60), (60, 80), (80, 100)]
    return [
        {
            "token": str(index + 1),
            "level": f"v{low}-{high}",
            "description": f"visibility of whole object is between {low} and {high}%",
        }
        for index, (low, high) in enumerate(levels)
    ]


def _quaternion(rotation: Float) -> list[float]:
    """Unit quaternion w, x, y, z of a rotation matrix."""
    x, y, z, w = Rotation.from_matrix(rotation).as_quat(canonical=True)
    return [float(w), float(x), float(y), float(z)]


def _calibrated_sensors(name: str, rig: Rig) -> list[Record]:
    mounted = [(camera.name, camera.camera_to_ego, camera.intrinsics.tolist()) for camera in rig]
    return [
        {
            "token": token(name, "calibrated_sensor", channel),
            "sensor_token": token("sensor", channel),
            "translation": sensor_to_ego[:3, 3].tolist(),
            "rotation": _quaternion(sensor_to_ego[:3, :3]),
            "camera_intrinsic": intrinsics,
        }
        for channel, sensor_to_ego, intrinsics in [*mounted, (LIDAR, LIDAR_TO_EGO, [])]
    ]


def _ego_poses(name: str, channels: list[str], trajectory: Trajectory) -> list[Record]:
    """One pose per measurement, with the token of the measurement, as in nuScenes."""
    return [
        {
            "token": token(name, "sample_data", channel, index),
            "timestamp": int(trajectory.timestamps[index]) // 1000,
            "rotation": _quaternion(pose[:3, :3]),
            "translation": pose[:3, 3].tolist(),
        }
        for index, pose in enumerate(trajectory.ego_to_global)
        for channel in channels
    ]


def _scene(world: World) -> Record:
    count = len(world.trajectory.timestamps)
    return {
        "token": token(world.name, "scene"),
        "log_token": token(world.name, "log"),
        "nbr_samples": count,
        "first_sample_token": token(world.name, "sample", 0),
        "last_sample_token": token(world.name, "sample", count - 1),
        "name": world.name,
        "description": f"demo world, {world.look}, synthetic town {world.seed}",
    }


def _neighbours(count: int, index: int, *names: object) -> Record:
    """Links of a doubly linked list; empty at its ends."""
    return {
        "prev": token(*names, index - 1) if index > 0 else "",
        "next": token(*names, index + 1) if index < count - 1 else "",
    }


def _samples(name: str, trajectory: Trajectory) -> list[Record]:
    count = len(trajectory.timestamps)
    return [
        {
            "token": token(name, "sample", index),
            "timestamp": int(trajectory.timestamps[index]) // 1000,
            **_neighbours(count, index, name, "sample"),
            "scene_token": token(name, "scene"),
        }
        for index in range(count)
    ]


def _sample_data(name: str, rig: Rig, trajectory: Trajectory) -> list[Record]:
    sizes = {camera.name: (camera.width, camera.height) for camera in rig} | {LIDAR: (0, 0)}
    count = len(trajectory.timestamps)
    return [
        {
            "token": token(name, "sample_data", channel, index),
            "sample_token": token(name, "sample", index),
            "ego_pose_token": token(name, "sample_data", channel, index),
            "calibrated_sensor_token": token(name, "calibrated_sensor", channel),
            "timestamp": int(trajectory.timestamps[index]) // 1000,
            "fileformat": "pcd" if channel == LIDAR else "jpg",
            "is_key_frame": True,
            "height": height,
            "width": width,
            "filename": sample_file_name(name, channel, int(trajectory.timestamps[index])),
            **_neighbours(count, index, name, "sample_data", channel),
        }
        for index in range(count)
        for channel, (width, height) in sizes.items()
    ]
