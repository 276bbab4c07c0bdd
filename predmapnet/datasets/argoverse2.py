"""Argoverse 2 sensor logs: feather poses and calibration, seven ring cameras, one vector map per log."""

from __future__ import annotations

import difflib
import re
from collections.abc import Sequence
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import orjson
from numpy.typing import NDArray
from pyarrow import ArrowInvalid, feather

from mapfusion.elements import GlobalMap, RegionOfInterest
from predmapnet.datasets.georeference import argoverse2_georeference
from predmapnet.datasets.ground_truth.argoverse2 import Argoverse2GroundTruth
from predmapnet.datasets.ground_truth.cache import all_truths
from predmapnet.datasets.ground_truth.whole_map import truth_map
from predmapnet.datasets.poses import pose_matrix
from predmapnet.datasets.source import Camera, Frame, FrameTruth, Georeference, Progress, Rig, SceneInfo
from predmapnet.datasets.splits import SPLITS, check_split, split_names
from predmapnet.errors import UserError

Float = NDArray[np.float64]
Integer = NDArray[np.int64]

CAMERAS = (
    "ring_front_center",
    "ring_front_right",
    "ring_front_left",
    "ring_rear_right",
    "ring_rear_left",
    "ring_side_right",
    "ring_side_left",
)
KEY_FRAME_STRIDE = 4
"""Every fourth lidar sweep of 10 Hz is a key frame (2.5 Hz), as in the official vector-map data sets."""
IMAGE_TOLERANCE = 25_000_000
"""An image belongs to a sweep if it lies within half the cameras' shutter interval, nanoseconds."""
POSES = "city_SE3_egovehicle.feather"
SWEEP_LIST = "lidar_timestamps_ns.json"


def find_logs(root: Path) -> dict[str, Path]:
    """Return log folders by log id: ``root`` itself, its children, or those of its train, val and test folders."""
    if (root / POSES).is_file():
        return {root.name: root}
    patterns = [f"*/{POSES}", *(f"{split}/*/{POSES}" for split in SPLITS)]
    return {path.parent.name: path.parent for pattern in patterns for path in sorted(root.glob(pattern))}


class Argoverse2Source:
    """Argoverse 2 sensor logs on disk.

    Attributes:
        name: ``argoverse2``.
        root: a log, or a folder of logs, or a folder with train, val and test folders of logs.
        synthetic: False.
        stride: every how manieth lidar sweep is a frame.
    """

    name = "argoverse2"
    synthetic = False

    def __init__(self, root: Path, stride: int = KEY_FRAME_STRIDE, split_scheme: str = "official") -> None:
        """Find the logs; nothing is read yet.

        Args:
            root: see above.
            stride: every how manieth lidar sweep of 10 Hz is a frame.
            split_scheme: ``official`` (the folder that a log lies in) or ``disjoint`` (StreamMapNet's).

        Raises:
            UserError: no logs there.
        """
        self.root = Path(root)
        self.stride = stride
        if split_scheme not in ("official", "disjoint"):
            raise UserError(f"There is no Argoverse 2 split '{split_scheme}'; there are: official, disjoint.")
        self.split_scheme = split_scheme
        if not self.root.is_dir():
            raise UserError(f"The Argoverse 2 folder {self.root} does not exist.")
        self._logs = find_logs(self.root)
        if not self._logs:
            raise UserError(
                f"{self.root} holds no Argoverse 2 sensor logs: looked for {POSES} in it, in its folders, and in the "
                "folders of train, val and test."
            )

    @cached_property
    def _disjoint_split(self) -> dict[str, str]:
        return {log: split for split in ("train", "val") for log in split_names(f"argoverse2_new_{split}")}

    def _split(self, log: str) -> str | None:
        if self.split_scheme == "disjoint":
            return self._disjoint_split.get(log)
        folder = self._logs[log].parent.name
        return folder if folder in SPLITS else "test"

    def scenes(self, split: str | None = None) -> tuple[SceneInfo, ...]:
        """List the logs, sorted by folder and id; with the official split, a log outside train and val is ``test``.

        With the disjoint split, logs that it does not name are left out.
        """
        check_split(split)
        infos = [self._info(log) for log in self._logs if self._split(log) is not None]
        return tuple(info for info in infos if split in (None, info.split))

    def _info(self, log: str) -> SceneInfo:
        folder = self._logs[log]
        has_images = (folder / "sensors" / "cameras").is_dir()
        left_out = log in split_names("argoverse2_skipped")
        return SceneInfo(
            name=log,
            split=self._split(log) or "test",
            frames=len(_key_frames(folder, self.stride)),
            location=_city(folder),
            ready=has_images,
            description=("" if has_images else "no images: ground truth only")
            or ("left out of the published training sets" if left_out else ""),
        )

    def open(self, scene: str, progress: Progress | None = None) -> Argoverse2Scene:
        """Open one log by its id. Raises UserError with the nearest ids if it is not there."""
        matches = [log for log in self._logs if log == scene] or [log for log in self._logs if log.startswith(scene)]
        if len(matches) != 1:
            near = matches[:4] or difflib.get_close_matches(scene, list(self._logs), n=4, cutoff=0.3)
            hint = f" Did you mean {', '.join(near)}?" if near else ""
            raise UserError(f"{self.root} holds no log '{scene}' among its {len(self._logs)} logs.{hint}")
        return Argoverse2Scene(self._logs[matches[0]], self._info(matches[0]), self.stride)


class Argoverse2Scene:
    """One Argoverse 2 sensor log.

    Attributes:
        info: the log's line in the listing.
        georeference: of its city.
        timestamps: ``(n,) int64``, nanoseconds, of the key frames.
    """

    georeference: Georeference | None

    def __init__(self, folder: Path, info: SceneInfo, stride: int) -> None:
        """Read the poses; calibration, images and the map are read when they are asked for.

        Raises:
            UserError: poses are missing or damaged.
        """
        self.info = info
        self.georeference = argoverse2_georeference(info.location)
        self.timestamps = _key_frames(folder, stride)
        self._folder = folder
        self._poses = _read_table(folder / POSES)
        self._pose_rows = {int(time): row for row, time in enumerate(self._poses["timestamp_ns"])}
        if len(self.timestamps) == 0:
            raise UserError(f"{folder} names no lidar sweep and no image, so it has no frames.")

    def __len__(self) -> int:
        return len(self.timestamps)

    @cached_property
    def rig(self) -> Rig:
        """The seven ring cameras. Raises UserError for a log without calibration."""
        calibration = self._folder / "calibration"
        if not calibration.is_dir():
            raise UserError(
                f"{self._folder} has no calibration folder, so its cameras are unknown: it can serve ground truth, but "
                "it cannot be mapped. Fetch the log's calibration/*.feather."
            )
        intrinsics = _rows_by_sensor(calibration / "intrinsics.feather")
        mounting = _rows_by_sensor(calibration / "egovehicle_SE3_sensor.feather")
        missing = [name for name in CAMERAS if name not in intrinsics or name not in mounting]
        if missing:
            raise UserError(f"{calibration} does not describe the cameras {', '.join(missing)}.")
        return tuple(_camera(name, intrinsics[name], mounting[name], calibration) for name in CAMERAS)

    @cached_property
    def _images(self) -> dict[str, tuple[Integer, list[Path]]]:
        """Per camera the time stamps of its images, ascending, and their files."""
        folder = self._folder / "sensors" / "cameras"
        if not folder.is_dir():
            raise UserError(
                f"{self._folder} has no images (looked for sensors/cameras/ring_*/<timestamp>.jpg): it can serve "
                "ground truth, but it cannot be mapped. Fetch the log's camera images."
            )
        return {name: _timed_files(folder / name, ".jpg") for name in CAMERAS}

    def frame(self, index: int) -> Frame:
        """Return frame ``index``: pose at exactly the sweep's time stamp, nearest image of each camera within 25 ms.

        Raises:
            IndexError: no such frame.
            UserError: no calibration, no images, or a pose is missing or broken.
        """
        ego_to_global = self.pose(index)
        timestamp = int(self.timestamps[index])
        images = {name: _nearest(*self._images[name], timestamp) for name in CAMERAS}
        return Frame(
            scene=self.info.name,
            index=index,
            token=f"{self.info.name}_{timestamp}",
            timestamp=timestamp,
            ego_to_global=ego_to_global,
            rig=self.rig,
            images={name: path for name, path in images.items() if path is not None},
        )

    def pose(self, index: int) -> Float:
        """Return ``ego_to_global`` of frame ``index``, ``(4, 4) float64``; works without images and calibration."""
        if not 0 <= index < len(self.timestamps):
            raise IndexError(f"{self.info.name} has {len(self.timestamps)} frames, not a frame {index}")
        timestamp = int(self.timestamps[index])
        where = f"{self.info.name}, frame {index}, {self._folder / POSES}"
        if timestamp not in self._pose_rows:
            raise UserError(f"{where}: there is no pose with the time stamp {timestamp} of the lidar sweep.")
        row = self._pose_rows[timestamp]
        return pose_matrix(
            [self._poses[name][row] for name in ("qw", "qx", "qy", "qz")],
            [self._poses[name][row] for name in ("tx_m", "ty_m", "tz_m")],
            f"{where}, row {row}",
        )

    @cached_property
    def ground_truth(self) -> Argoverse2GroundTruth | None:
        """The log's vector map, or None if it has none."""
        maps = sorted((self._folder / "map").glob("log_map_archive_*.json"))
        return Argoverse2GroundTruth(maps[0]) if maps else None

    def truth(self, index: int, roi: RegionOfInterest) -> FrameTruth | None:
        """Return the official ground truth of frame ``index``, or None for a log without a map."""
        return None if self.ground_truth is None else self.ground_truth.frame(self.pose(index), roi)

    def truths(self, roi: RegionOfInterest, cache: Path | None = None) -> list[FrameTruth] | None:
        """Return the ground truth of all frames, kept in the folder ``cache`` if one is given."""
        if self.ground_truth is None:
            return None
        poses = [self.pose(index) for index in range(len(self))]
        return all_truths(self.ground_truth, poses, roi, cache, "argoverse2")

    def truth_map(self) -> GlobalMap | None:
        """Return what a perfect mapper would have made of this log, or None for a log without a map."""
        if self.ground_truth is None:
            return None
        frames = [(int(self.timestamps[index]), self.pose(index)) for index in range(len(self))]
        return truth_map(self.ground_truth, frames, RegionOfInterest())


def _key_frames(folder: Path, stride: int) -> Integer:
    """Time stamps of every ``stride``-th lidar sweep; without lidar files, of front images at the sweeps' rate."""
    sweeps, _ = _timed_files(folder / "sensors" / "lidar", ".feather")
    if len(sweeps) == 0 and (folder / SWEEP_LIST).is_file():
        sweeps = np.sort(np.array(_read_json(folder / SWEEP_LIST), dtype=np.int64))
    if len(sweeps):
        return sweeps[::stride]
    # The front camera runs at twice the lidar's rate.
    images, _ = _timed_files(folder / "sensors" / "cameras" / CAMERAS[0], ".jpg")
    return images[:: 2 * stride]


def _timed_files(folder: Path, suffix: str) -> tuple[Integer, list[Path]]:
    files = sorted((int(path.stem), path) for path in folder.glob(f"*{suffix}") if path.stem.isdigit())
    return np.array([time for time, _ in files], dtype=np.int64), [path for _, path in files]


def _nearest(times: Integer, files: Sequence[Path], timestamp: int) -> Path | None:
    if len(times) == 0:
        return None
    nearest = int(np.argmin(np.abs(times - timestamp)))
    return files[nearest] if abs(int(times[nearest]) - timestamp) <= IMAGE_TOLERANCE else None


def _city(folder: Path) -> str:
    """Three-letter city of a log, from the name of its map file (``..._PIT_city_47896.json``)."""
    for path in sorted((folder / "map").glob("log_map_archive_*.json")):
        found = re.search(r"_([A-Z]{3})_city_", path.name)
        if found:
            return found.group(1)
    return "unknown"


def _camera(name: str, intrinsics: dict[str, Any], mounting: dict[str, Any], folder: Path) -> Camera:
    matrix = np.eye(3)
    matrix[[0, 1, 0, 1], [0, 1, 2, 2]] = [intrinsics[key] for key in ("fx_px", "fy_px", "cx_px", "cy_px")]
    return Camera(
        name=name,
        width=int(intrinsics["width_px"]),
        height=int(intrinsics["height_px"]),
        intrinsics=matrix,
        camera_to_ego=pose_matrix(
            [mounting[key] for key in ("qw", "qx", "qy", "qz")],
            [mounting[key] for key in ("tx_m", "ty_m", "tz_m")],
            f"{folder / 'egovehicle_SE3_sensor.feather'}, {name}",
        ),
    )


def _rows_by_sensor(path: Path) -> dict[str, dict[str, Any]]:
    table = _read_table(path)
    return {
        str(name): {column: values[row] for column, values in table.items()}
        for row, name in enumerate(table["sensor_name"])
    }


def _read_table(path: Path) -> dict[str, NDArray[Any]]:
    try:
        table = feather.read_table(path)
    except FileNotFoundError:
        raise UserError(f"{path} does not exist. The log is incomplete: fetch it again.") from None
    except (ArrowInvalid, OSError) as error:
        raise UserError(f"{path} is not a readable feather file ({error}). Fetch it again.") from None
    return {name: table.column(name).to_numpy() for name in table.column_names}


def _read_json(path: Path) -> Any:
    try:
        return orjson.loads(path.read_bytes())
    except orjson.JSONDecodeError as error:
        raise UserError(f"{path} is not valid JSON ({error}). Fetch it again.") from None
