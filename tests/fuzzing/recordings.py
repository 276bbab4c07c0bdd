"""Small examples of other people's recordings, and their conversion into logs of one's own."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np

from predmapnet.datasets.bags.conversion import log_from_bag
from predmapnet.datasets.kitti_and_pandaset import log_from_kitti, log_from_pandaset
from predmapnet.datasets.own_logs.made_log import MadeLog
from predmapnet.datasets.own_logs.scene import LogScene
from predmapnet.datasets.py123d_logs import log_from_py123d
from tests.predmapnet.datasets.bags.drawn_bag import bag_of, odometry, raw
from tests.predmapnet.datasets.drawn_recordings import write_kitti, write_pandaset, write_py123d
from tests.predmapnet.datasets.own_logs.drawn_log import bend, entry, write_log

CAMERAS = {
    "front_camera": entry(0.0, 32, 20, 20.0),
    "left_camera": entry(90.0, 32, 20, 20.0, model="plumb_bob", distortion=[-0.1, 0.01, 0.0, 0.0, 0.0]),
}


def _drawn_log(folder: Path) -> Path:
    return write_log(folder / "drawn", CAMERAS, bend(4, period=0.5), rows=range(3))


def write_bags(folder: Path) -> list[Path]:
    """Write a bag in both storages: a camera with compressed images and one with raw ones, transforms and odometry."""
    log = _drawn_log(folder)
    drawn = bag_of(log)
    topic = "/sensing/left_camera/image_raw/compressed"
    images = [(time, message) for _, time, message in drawn.of(topic)]
    drawn.drop(topic)
    for time, message in images:
        pixels = cv2.imdecode(message.data, cv2.IMREAD_GRAYSCALE)
        assert pixels is not None
        drawn.messages.append(
            (topic.removesuffix("/compressed"), time, raw(pixels, "mono8", time, "left_camera_optical"))
        )
        drawn.messages.append(("/odom", time, odometry("odom", "base_link", time, np.eye(4))))
    shutil.rmtree(log)
    for storage in ("mcap", "sqlite3"):
        (folder / f"{storage}.bag").mkdir()
        drawn.write(folder / "written", storage)
        for path in (folder / "written").iterdir():
            path.rename(folder / f"{storage}.bag" / path.name)
        (folder / "written").rmdir()
    return [path for ending in ("mcap", "db3") for path in folder.glob(f"*/*.{ending}")]


def write_drive_of_kitti(folder: Path) -> list[Path]:
    """Write a drive of KITTI raw."""
    log = _drawn_log(folder)
    write_kitti(LogScene(log), folder / "day")
    shutil.rmtree(log)
    return sorted(path for path in folder.rglob("*") if path.is_file())


def write_scene_of_pandaset(folder: Path) -> list[Path]:
    """Write a scene of PandaSet."""
    log = _drawn_log(folder)
    write_pandaset(LogScene(log), folder / "scene")
    shutil.rmtree(log)
    return sorted(path for path in folder.rglob("*") if path.is_file())


def write_logs_of_py123d(folder: Path) -> list[Path]:
    """Write a log of py123d in each of its three ways to keep images."""
    log = _drawn_log(folder)
    for codec in ("jpeg_binary", "mp4", "path"):
        write_py123d(log, folder / codec, codec)
    for path in (log / "images" / "front_camera").iterdir():
        shutil.copyfile(path, folder / path.name)
        shutil.copyfile(log / "images" / "left_camera" / path.name, folder / path.name)
    shutil.rmtree(log)
    return sorted(path for path in folder.rglob("*") if path.suffix in (".arrow", ".mp4"))


def converted(convert: Callable[[Path, Path, Path], MadeLog]) -> Callable[[Path, Path], None]:
    """Return a reader that makes a log and opens it."""

    def read(folder: Path, changed: Path) -> None:
        out = folder / "made" / "log"
        try:
            made = convert(folder, changed, out)
            scene = LogScene(out)
            assert len(scene) > 0 and sum(made.images.values()) > 0
            for index in range(len(scene)):
                frame = scene.frame(index)
                assert np.isfinite(frame.ego_to_global).all() and frame.timestamp >= 0
                assert all(np.isfinite(camera.intrinsics).all() for camera in frame.rig)
        finally:
            shutil.rmtree(out, ignore_errors=True)

    return read


RECORDINGS = {
    "bags": (write_bags, converted(lambda _, changed, out: log_from_bag(changed, out))),
    "kitti": (write_drive_of_kitti,
              converted(lambda at, _, out: log_from_kitti(next((at / "day").glob("*_sync")), out))),
    "pandaset": (write_scene_of_pandaset, converted(lambda at, _, out: log_from_pandaset(at / "scene", out))),
    "py123d": (write_logs_of_py123d,
               converted(lambda at, changed, out: log_from_py123d(changed.parent, out, sensor_root=at))),
}  # fmt: skip
"""By the name of a reader, what writes its examples and what reads them."""
