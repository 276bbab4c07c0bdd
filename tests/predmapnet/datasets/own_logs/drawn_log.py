"""Logs of cars with any cameras over a road of coarse grain, drawn in milliseconds."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from mapfusion.arrays import Float
from predmapnet.datasets.own_logs.timed_poses import TimedPoses, write_timed_poses
from predmapnet.datasets.undistortion import KANNALA_BRANDT, Lens

START = 1_500_000_000_000_000_000
ABOVE_ROAD = 0.3
TEXEL = 0.04
"""Metres."""
Entry = dict[str, Any]


def entry(yaw: float, width: int = 320, height: int = 192, focal: float = 180.0, pitch: float = 0.0, **lens) -> Entry:
    """A camera of ``calibration.json`` that looks ``yaw`` degrees to the left, ``pitch`` down, 1.5 m above the road."""
    rotation = Rotation.from_euler("ZY", [yaw, pitch], degrees=True) * Rotation.from_matrix(
        [[0, 0, 1], [-1, 0, 0], [0, -1, 0]]
    )
    x, y, z, w = rotation.as_quat().tolist()
    place = [1.0 + np.cos(np.radians(yaw)), 0.5 * np.sin(np.radians(yaw)), 1.2]
    return {
        "width": width,
        "height": height,
        "model": "pinhole",
        "intrinsics": {"fx": focal, "fy": focal, "cx": width / 2 - 0.5, "cy": height / 2 - 0.5},
        "camera_to_ego": {"translation_m": place, "rotation_wxyz": [w, x, y, z]},
    } | lens


def bend(frames: int, period: float = 0.1, speed: float = 6.0, turn: float = 0.15) -> TimedPoses:
    """A car that drives a bend, ``turn`` radians a second, its origin 0.3 m above the road."""
    seconds = period * np.arange(frames)
    poses = np.tile(np.eye(4), (frames, 1, 1))
    poses[:, :3, :3] = Rotation.from_euler("z", turn * seconds[:, None]).as_matrix()
    poses[:, :2, 3] = speed / turn * np.stack([np.sin(turn * seconds), 1 - np.cos(turn * seconds)], axis=1)
    poses[:, 2, 3] = ABOVE_ROAD
    return TimedPoses(START + np.round(1e9 * seconds).astype(np.int64), poses)


def rays_of(camera: Entry) -> Float:
    """Rays ``(height, width, 3)`` of a camera's pixels, its own axes."""
    column, row = np.meshgrid(np.arange(camera["width"]), np.arange(camera["height"]))
    k = camera["intrinsics"]
    if camera["model"] == "fisheye":
        matrix = np.array([[k["fx"], 0.0, k["cx"]], [0.0, k["fy"], k["cy"]], [0.0, 0.0, 1.0]])
        lens = Lens(KANNALA_BRANDT, 0, 0, matrix, np.array(camera["distortion"]), np.eye(3))
        return lens.unproject(np.stack([column, row], axis=-1).reshape(-1, 2).astype(float)).reshape(*row.shape, 3)
    return np.stack([(column - k["cx"]) / k["fx"], (row - k["cy"]) / k["fy"], np.ones(row.shape)], axis=-1)


def grain() -> Float:
    """Random patches of all sizes, ``(1024, 1024)``, that can be repeated."""
    generator = np.random.default_rng(3)
    sizes = (32, 128, 512, 1024)
    layers = [cv2.resize(generator.normal(size=(size, size)), (1024, 1024), interpolation=cv2.INTER_CUBIC)
              for size in sizes]  # fmt: skip
    return np.clip(128 + 35 * sum(layers), 1, 255).astype(np.uint8)


def draw(rays: Float, camera_to_ego: Float, pose: Float, texture: Float) -> Float:
    """What a camera sees: the road, and above it a far wall."""
    camera_to_global = pose @ camera_to_ego
    there = rays @ camera_to_global[:3, :3].T
    down = there[..., 2] < -1e-3
    depth = np.where(down, camera_to_global[2, 3] / np.where(down, -there[..., 2], 1.0), 0.0)
    road = (camera_to_global[:2, 3] + depth[..., None] * there[..., :2]) / TEXEL
    angle = np.arctan2(there[..., 1], there[..., 0])
    far = np.stack([angle, there[..., 2] / np.linalg.norm(there[..., :2], axis=-1)], axis=-1) * 400
    place = np.where(down[..., None], road, far) % 1024
    x, y = np.moveaxis(place.astype(np.float32), -1, 0)
    return np.asarray(cv2.remap(texture, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP))


def write_log(
    folder: Path,
    cameras: dict[str, Entry],
    poses: TimedPoses,
    late: int = 0,
    changed: Callable[[str, Float], Float] = lambda name, image: image,
    rows: Sequence[int] | None = None,
) -> Path:
    """Write a log whose cameras take images at the poses' instants, each ``late`` nanoseconds after the one before.

    Args:
        folder: to write.
        cameras: entries by name.
        poses: of the car.
        late: see above.
        changed: makes the stored image of what a camera sees.
        rows: poses at which images are taken; all without.
    """
    texture = grain()
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "calibration.json").write_text(json.dumps({"ego_origin_above_road_m": ABOVE_ROAD, "cameras": cameras}))
    write_timed_poses(folder / "poses.csv", poses)
    for number, (name, camera) in enumerate(cameras.items()):
        mounting = np.eye(4)
        w, x, y, z = camera["camera_to_ego"]["rotation_wxyz"]
        mounting[:3, :3] = Rotation.from_quat([x, y, z, w]).as_matrix()
        mounting[:3, 3] = camera["camera_to_ego"]["translation_m"]
        rays = rays_of(camera)
        (folder / "images" / name).mkdir(parents=True, exist_ok=True)
        for row in range(len(poses.timestamps)) if rows is None else rows:
            taken = int(poses.timestamps[row]) + number * late
            image = changed(name, draw(rays, mounting, poses.at(taken), texture))
            cv2.imwrite(str(folder / "images" / name / f"{taken}.jpg"), np.repeat(image[..., None], 3, axis=-1))
    return folder
