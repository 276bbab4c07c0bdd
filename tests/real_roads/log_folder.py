"""A driving log as plain files: photographs by camera and time stamp, one calibration, one file of poses.

    images/<camera>/<timestamp_ns>.jpg
    calibration.json        pinhole cameras, OpenCV's convention: the centre of the first pixel is (0, 0)
    poses.csv               timestamp_ns,x,y,z,qw,qx,qy,qz: ego_to_global, at instants of their own

The real street comes in this form, and dressed drives are kept in it, so that one reader serves both.
"""

from __future__ import annotations

import csv
import json
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation, Slerp

from mapfusion.elements import GlobalMap, RegionOfInterest
from mapfusion.geometry import inverse_pose
from predmapnet.datasets.poses import pose_matrix
from predmapnet.errors import UserError
from predmapnet.files import write_file
from predmapnet.scenes import Camera, Frame, FrameTruth, Georeference, Instant, Rig, SceneInfo

Float = NDArray[np.float64]

HALF_A_PIXEL = 0.5
"""From OpenCV's principal point (centre of the first pixel at 0) to ours (at 0.5)."""

LATEST = 100_000_000
"""An image farther from the frame's instant does not belong to it, nanoseconds."""


@dataclass(frozen=True)
class Poses:
    """Poses at instants: ``timestamps`` ``(n,) int64`` ascending, nanoseconds; ``ego_to_global`` ``(n, 4, 4)``."""

    timestamps: NDArray[np.int64]
    ego_to_global: Float

    def at(self, timestamp: int) -> Float:
        """Return the pose at any instant: a straight line and a steady turn between neighbours, held at the ends."""
        offset = float(np.clip(timestamp, self.timestamps[0], self.timestamps[-1]) - self.timestamps[0])
        seconds = (self.timestamps - self.timestamps[0]).astype(np.float64)
        pose = np.eye(4)
        if len(seconds) == 1:
            return np.asarray(self.ego_to_global[0].copy())
        pose[:3, :3] = Slerp(seconds, Rotation.from_matrix(self.ego_to_global[:, :3, :3]))(offset).as_matrix()
        pose[:3, 3] = [np.interp(offset, seconds, self.ego_to_global[:, axis, 3]) for axis in range(3)]
        return pose


def moved_rig(rig: Rig, mounting: Callable[[Camera], Float]) -> Rig:
    """Return a rig whose cameras sit where ``mounting`` says (``camera_to_ego``, ``(4, 4)``)."""
    return tuple(replace(camera, camera_to_ego=mounting(camera)) for camera in rig)


def read_poses(path: Path) -> Poses:
    """Read ``poses.csv``. Raises UserError for a damaged pose."""
    with path.open(newline="") as file:
        rows = list(csv.DictReader(file))
    poses = [
        pose_matrix([float(row[name]) for name in ("qw", "qx", "qy", "qz")],
                    [float(row[name]) for name in "xyz"], f"{path}, row {number}")
        for number, row in enumerate(rows)
    ]  # fmt: skip
    return Poses(np.array([int(row["timestamp_ns"]) for row in rows], dtype=np.int64), np.array(poses))


def write_poses(path: Path, poses: Poses) -> None:
    """Write ``poses.csv``."""
    lines = ["timestamp_ns,x,y,z,qw,qx,qy,qz"]
    for timestamp, pose in zip(poses.timestamps.tolist(), poses.ego_to_global, strict=True):
        x, y, z, w = Rotation.from_matrix(pose[:3, :3]).as_quat(canonical=True)
        values = [*pose[:3, 3], w, x, y, z]
        lines.append(f"{timestamp}," + ",".join(f"{value:.10f}" for value in values))
    with write_file(path) as draft:
        draft.write_text("\n".join(lines) + "\n")


def read_rig(path: Path) -> Rig:
    """Read ``calibration.json``; the road lies ``ego_origin_above_road_m`` below the ego origin."""
    content = json.loads(path.read_text())
    return tuple(
        _camera(name, entry, -float(content["ego_origin_above_road_m"]), str(path))
        for name, entry in content["cameras"].items()
    )


def _camera(name: str, entry: dict, ground_height: float, where: str) -> Camera:
    intrinsics = np.eye(3)
    intrinsics[[0, 1], [0, 1]] = entry["intrinsics"]["fx"], entry["intrinsics"]["fy"]
    intrinsics[:2, 2] = entry["intrinsics"]["cx"] + HALF_A_PIXEL, entry["intrinsics"]["cy"] + HALF_A_PIXEL
    mounting = entry["camera_to_ego"]
    pose = pose_matrix(mounting["rotation_wxyz"], mounting["translation_m"], f"{where}, {name}")
    return Camera(name, entry["width"], entry["height"], intrinsics, pose, ground_height)


def write_rig(path: Path, rig: Rig) -> None:
    """Write ``calibration.json``."""
    cameras = {}
    for camera in rig:
        x, y, z, w = Rotation.from_matrix(camera.camera_to_ego[:3, :3]).as_quat(canonical=True).tolist()
        k = camera.intrinsics
        cameras[camera.name] = {
            "width": camera.width,
            "height": camera.height,
            "model": "pinhole",
            "intrinsics": {"fx": k[0, 0], "fy": k[1, 1], "cx": k[0, 2] - HALF_A_PIXEL, "cy": k[1, 2] - HALF_A_PIXEL},
            "camera_to_ego": {
                "translation_m": camera.camera_to_ego[:3, 3].tolist(),
                "rotation_wxyz": [w, x, y, z],
            },
        }
    with write_file(path) as draft:
        content = {"ego_origin_above_road_m": -rig[0].ground_height, "cameras": cameras}
        draft.write_text(json.dumps(content, indent=1))


def image_path(folder: Path, camera: str, timestamp: int) -> Path:
    """Where the image of a camera at an instant lies."""
    return folder / "images" / camera / f"{timestamp}.jpg"


@dataclass(frozen=True)
class Truth:
    """What is true along a drive.

    Attributes:
        frame: truth of frame ``index`` of the folder's poses, clipped to a region, ego frame.
        whole: the map of the whole drive, global frame.
    """

    frame: Callable[[int, RegionOfInterest], FrameTruth]
    whole: Callable[[], GlobalMap]


class LogScene:
    """A log folder as a scene: one frame for each pose, with the image of each camera that lies nearest in time.

    Attributes:
        info: its line in a listing.
        mounted: the cameras as the calibration has them.
        georeference: None.
    """

    georeference: Georeference | None = None

    def __init__(self, folder: Path, truth: Truth | None = None, own_instants: bool = True) -> None:
        """Read calibration and poses; images are named, not read.

        Args:
            folder: as this module describes it.
            truth: if it is known.
            own_instants: True moves each camera to where the car was when it took its image, which is not the frame's
                instant; False takes all images as taken at the frame's instant.

        Raises:
            UserError: a file is damaged.
        """
        for name in ("calibration.json", "poses.csv"):
            if not (folder / name).is_file():
                raise UserError(f"{folder} is no log folder: it lacks {name}.")
        self.folder = folder
        self.mounted = read_rig(folder / "calibration.json")
        self.poses = read_poses(folder / "poses.csv")
        self.known_truth = truth
        self.own_instants = own_instants
        self.info = SceneInfo(folder.name, "test", len(self), folder.parent.name)

    def __len__(self) -> int:
        return len(self.poses.timestamps)

    @property
    def rig(self) -> Rig:
        """The cameras as the calibration has them."""
        return self.mounted

    @cached_property
    def _images(self) -> dict[str, NDArray[np.int64]]:
        """Ascending time stamps of the images by camera."""
        return {
            camera.name: np.array(
                sorted(int(path.stem) for path in (self.folder / "images" / camera.name).glob("*.jpg")), dtype=np.int64
            )
            for camera in self.mounted
        }

    def frame(self, index: int) -> Frame:
        """Return frame ``index``; its rig is that of this frame (see ``own_instants``)."""
        instant = self.instant(index)
        times = {name: nearest(stamps, instant.timestamp) for name, stamps in self._images.items()}

        def mounting(camera: Camera) -> Float:
            time = times[camera.name]
            if time is None or time == instant.timestamp or not self.own_instants:
                return camera.camera_to_ego
            return np.asarray(inverse_pose(instant.ego_to_global) @ self.poses.at(time) @ camera.camera_to_ego)

        images = {name: image_path(self.folder, name, time) for name, time in times.items() if time is not None}
        rig = moved_rig(self.mounted, mounting)
        return Frame(self.info.name, index, instant.token, instant.timestamp, instant.ego_to_global, rig, images)

    def instant(self, index: int) -> Instant:
        """Return token, time stamp and pose of frame ``index``."""
        if not 0 <= index < len(self):
            raise IndexError(f"{self.info.name} has {len(self)} frames, not a frame {index}")
        timestamp = int(self.poses.timestamps[index])
        return Instant(f"{self.info.name}_{timestamp}", timestamp, self.poses.ego_to_global[index])

    def lidar(self, index: int) -> Float | None:
        """Return None: there is no lidar."""
        return None

    def truth(self, index: int, roi: RegionOfInterest) -> FrameTruth | None:
        """Return the truth of frame ``index``, or None where nothing is known."""
        return None if self.known_truth is None else self.known_truth.frame(index, roi)

    def truths(self, roi: RegionOfInterest, cache: Path | None = None) -> list[FrameTruth] | None:
        """Return the truth of all frames; nothing is kept in ``cache``."""
        return None if self.known_truth is None else [self.known_truth.frame(index, roi) for index in range(len(self))]

    def truth_map(self) -> GlobalMap | None:
        """Return the true map of the whole drive, or None where nothing is known."""
        return None if self.known_truth is None else self.known_truth.whole()


def nearest(stamps: NDArray[np.int64], timestamp: int) -> int | None:
    """Return the time stamp nearest to an instant, or None if all lie farther than :data:`LATEST`."""
    if not len(stamps):
        return None
    found = int(stamps[np.argmin(np.abs(stamps - timestamp))])
    return found if abs(found - timestamp) <= LATEST else None
