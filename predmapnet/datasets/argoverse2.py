"""Argoverse 2 sensor logs: feather poses and calibration, seven ring cameras, one vector map per log."""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Sequence
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from mapfusion.arrays import Float, Integer
from mapfusion.elements import GlobalMap, RegionOfInterest
from mapfusion.georeference import Georeference
from predmapnet.datasets.argoverse2_files import (
    ARGOVERSE2_CAMERAS,
    IMAGE_ENDINGS,
    POSES,
    city,
    every_sweep,
    find_logs,
    read_table,
    rows_by_sensor,
    timed_files,
)
from predmapnet.datasets.argoverse2_frames import (
    IMAGE_TOLERANCE,
    strided_over_logs,
    strided_over_time,
    sweeps_with_images,
)
from predmapnet.datasets.fields import check_mounting, check_principal_point, whole_field
from predmapnet.datasets.georeference import argoverse2_georeference
from predmapnet.datasets.ground_truth.argoverse2 import Argoverse2GroundTruth, united_map
from predmapnet.datasets.ground_truth.cache import all_truths
from predmapnet.datasets.ground_truth.whole_map import truth_map
from predmapnet.datasets.lidar import read_argoverse2_sweep
from predmapnet.datasets.log_checks import check_cameras, check_clock, check_drive
from predmapnet.datasets.poses import pose_matrix
from predmapnet.datasets.splits import SPLITS, check_scheme, check_split, split_names
from predmapnet.errors import UserError
from predmapnet.scenes import STANDARD_REGION, Camera, Frame, FrameTruth, Instant, Progress, Rig, SceneInfo

KEY_FRAME_STRIDE = 4
"""Every fourth lidar sweep of 10 Hz is a key frame (2.5 Hz), as in the official vector-map data sets."""
GROUND_HEIGHT = -0.33
"""z of the road under the car in the ego frame, metres: its origin is the middle of the rear axle."""
QUATERNION, TRANSLATION = ("qw", "qx", "qy", "qz"), ("tx_m", "ty_m", "tz_m")
INTRINSICS = ("fx_px", "fy_px", "cx_px", "cy_px", "width_px", "height_px")
NAMED = 8
"""Number of things that a message names."""
OLD_TRAIN_LOGS = 700
"""Logs in the train folder of the whole data set."""


class Argoverse2Source:
    """Argoverse 2 sensor logs on disk.

    Attributes:
        name: ``argoverse2``.
        root: a log, or a folder of logs, or a folder with train, val and test folders of logs.
        synthetic: False.
        stride: lidar sweeps per frame.
        split_scheme: ``old`` or ``new``.
        official_frames: whether frames are counted across logs.
    """

    name = "argoverse2"
    synthetic = False

    def __init__(
        self,
        root: Path,
        stride: int = KEY_FRAME_STRIDE,
        split_scheme: str = "old",
        official_frames: bool = False,
    ) -> None:
        """Find the logs; nothing is read yet.

        Args:
            root: see above.
            stride: lidar sweeps (10 Hz) per frame.
            split_scheme: ``old`` (the folder that a log lies in) or ``new`` (StreamMapNet's).
            official_frames: False counts the sweeps of each log from 0, so that a log's frames depend on nothing else.
                True takes exactly the frames of the published benchmarks: sweeps without all images are dropped,
                and the rest is counted across all logs of a split (:mod:`predmapnet.datasets.argoverse2_frames`).
                That needs the images of every log of the split.

        Raises:
            UserError: no logs there, or no such scheme.
        """
        self.root = Path(root)
        self.stride = stride
        check_scheme(split_scheme)
        self.split_scheme = split_scheme
        self.official_frames = official_frames
        self._frames_of_split: dict[str, dict[str, Integer]] = {}
        if not self.root.is_dir():
            raise UserError(f"The Argoverse 2 folder {self.root} does not exist.")
        self._logs = find_logs(self.root)
        if not self._logs:
            raise UserError(
                f"{self.root} holds no Argoverse 2 sensor logs: looked for {POSES} in it, in its folders, and in the "
                "folders of train, val and test."
            )

    @cached_property
    def _new_split(self) -> dict[str, str]:
        return {log: split for split in ("train", "val") for log in split_names(f"argoverse2_new_{split}")}

    def _split(self, log: str) -> str | None:
        if self.split_scheme == "new":
            return self._new_split.get(log)
        folder = self._logs[log].parent.name
        return folder if folder in SPLITS else "test"

    def scenes(self, split: str | None = None) -> tuple[SceneInfo, ...]:
        """List the logs, sorted by folder and id; with the old split, a log outside train and val is ``test``.

        With the new split, logs that it does not name are left out; so are logs without any official frame, if those
        were asked for.
        """
        check_split(split, self.split_scheme)
        splits = {log: self._split(log) for log in self._logs}
        if not any(splits.values()):
            raise UserError(f"The new split names none of the {len(self._logs)} logs in {self.root}.")
        infos = [self._info(log) for log, of in splits.items() if of is not None and split in (None, of)]
        return tuple(info for info in infos if info.frames or not self.official_frames)

    def _key_frames(self, log: str) -> Integer:
        """Time stamps of a log's frames, ascending."""
        if not self.official_frames:
            return every_sweep(self._logs[log])[:: self.stride]
        split = self._split(log)
        if split is None:
            raise UserError(f"{log} is not in the new split, so it has no official frames.")
        if split not in self._frames_of_split:
            self._frames_of_split[split] = self._official_frames(split)
        return self._frames_of_split[split].get(log, np.zeros(0, dtype=np.int64))

    def _official_frames(self, split: str) -> dict[str, Integer]:
        """Frames of all logs of a split as the published benchmarks count them; UserError if any log is missing."""
        if self.split_scheme == "new":
            logs = split_names(f"argoverse2_new_{split}")
            missing = [log for log in logs if log not in self._logs]
            lacking = f"{len(missing)} of {len(logs)} logs, {missing[0]} for one" if missing else ""
        elif split == "train":
            logs = tuple(log for log in self._logs if self._split(log) == split)
            lacking = f"{OLD_TRAIN_LOGS - len(logs)} of {OLD_TRAIN_LOGS} logs" if len(logs) < OLD_TRAIN_LOGS else ""
        else:
            raise UserError(
                f"There is no rule for the official frames of the old {split} split: the published code reads them "
                "from a file of its own. Use the new split, or count the frames of each log by itself."
            )
        if lacking:
            raise UserError(
                f"The official frames of the {self.split_scheme} {split} split are counted across all its logs, but "
                f"{self.root} lacks {lacking}. Fetch them, or count the frames of each log by itself."
            )
        kept = [log for log in logs if log not in split_names("argoverse2_skipped")]
        sweeps = {log: sweeps_with_images(every_sweep(self._logs[log]), self._image_times(log)) for log in kept}
        return (strided_over_logs if self.split_scheme == "new" else strided_over_time)(sweeps, self.stride)

    def _image_times(self, log: str) -> list[Integer]:
        cameras = self._logs[log] / "sensors" / "cameras"
        if not cameras.is_dir():
            raise UserError(f"{self._logs[log]} has no images, but the official frames are those with all images.")
        return [timed_files(cameras / name, *IMAGE_ENDINGS)[0] for name in ARGOVERSE2_CAMERAS]

    def _info(self, log: str) -> SceneInfo:
        folder = self._logs[log]
        has_images = (folder / "sensors" / "cameras").is_dir()
        left_out = log in split_names("argoverse2_skipped")
        return SceneInfo(
            name=log,
            split=self._split(log) or "test",
            frames=len(self._key_frames(log)),
            location=city(folder),
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
        return Argoverse2Scene(self._logs[matches[0]], self._info(matches[0]), self._key_frames(matches[0]))

    def truth_map(self, scenes: Sequence[str], roi: RegionOfInterest) -> GlobalMap | None:
        """Return the true map of what came into the region along logs of one city; None if one has no map."""
        opened = [self.open(name) for name in scenes]
        files = [scene.map_file for scene in opened]
        known = [file for file in files if file is not None]
        if len(known) < len(files):
            return None
        truth = Argoverse2GroundTruth(united_map(known))
        return truth_map(truth, [pose for scene in opened for pose in scene.way()], roi)

    def scenes_of(self, tokens: Iterable[str]) -> dict[str, str]:
        """Look up which logs frames belong to; unknown tokens are absent.

        Tokens are ``<log>_<timestamp>`` as MapTRv2 and this package name frames, or the time stamp alone as
        StreamMapNet and MapTracker do.
        """
        known: dict[str, str] = {}
        for info in self.scenes():
            for time in self._key_frames(info.name).tolist():
                known[f"{info.name}_{time}"] = known[str(time)] = info.name
        return {token: known[token] for token in tokens if token in known}


class Argoverse2Scene:
    """One Argoverse 2 sensor log; its key frames are at ``timestamps (n,) int64``, nanoseconds."""

    georeference: Georeference | None

    def __init__(self, folder: Path, info: SceneInfo, timestamps: Integer) -> None:
        """Read the poses at time stamps ``(n,)``, nanoseconds, all else when it is asked for; raises UserError."""
        self.info = info
        self.georeference = argoverse2_georeference(info.location)
        self.timestamps = timestamps
        self._folder = folder
        self._poses = read_table(folder / POSES, ("timestamp_ns", *QUATERNION, *TRANSLATION))
        if len(self.timestamps) == 0:
            raise UserError(f"{folder} names no lidar sweep and no image that is a frame, so it has none.")
        self._check_drive()
        self._pose_rows = {int(time): row for row, time in enumerate(self._poses["timestamp_ns"])}

    def _check_drive(self) -> None:
        """Raise UserError for times of another unit, and for poses that no car has."""
        path = self._folder / POSES
        times = self._poses["timestamp_ns"]
        if not np.issubdtype(times.dtype, np.integer):
            raise UserError(f"{path}: the column timestamp_ns must hold integer nanoseconds, not {times.dtype}.")
        times = self._poses["timestamp_ns"] = times.astype(np.int64)
        order = np.argsort(times, kind="stable")
        table = {name: values[order] for name, values in self._poses.items()}
        quaternions = np.stack([table[name] for name in QUATERNION], axis=1).astype(np.float64)
        positions = np.stack([table[name] for name in TRANSLATION[:2]], axis=1).astype(np.float64)
        whole = np.isfinite(positions).all(axis=1) & (np.abs(np.linalg.norm(quaternions, axis=1) - 1.0) < 1e-3)
        check_clock(table["timestamp_ns"][whole], positions[whole], "nanoseconds", str(path))
        check_drive(quaternions[whole], positions[whole], str(path))

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
        intrinsics = rows_by_sensor(calibration / "intrinsics.feather", INTRINSICS)
        mounting = rows_by_sensor(calibration / "egovehicle_SE3_sensor.feather", (*QUATERNION, *TRANSLATION))
        missing = [name for name in ARGOVERSE2_CAMERAS if name not in intrinsics or name not in mounting]
        if missing:
            raise UserError(f"{calibration} does not describe the cameras {', '.join(missing)}.")
        stored = [[mounting[name][key] for key in QUATERNION] for name in ARGOVERSE2_CAMERAS]
        check_cameras(stored, f"{calibration / 'egovehicle_SE3_sensor.feather'}")
        return tuple(_camera(name, intrinsics[name], mounting[name], calibration) for name in ARGOVERSE2_CAMERAS)

    @cached_property
    def _images(self) -> dict[str, tuple[Integer, list[Path]]]:
        """Per camera the time stamps of its images, ascending, and their files."""
        folder = self._folder / "sensors" / "cameras"
        if not folder.is_dir():
            raise UserError(
                f"{self._folder} has no images (looked for sensors/cameras/ring_*/<timestamp>.jpg): it can serve "
                "ground truth, but it cannot be mapped. Fetch the log's camera images."
            )
        images = {name: timed_files(folder / name, *IMAGE_ENDINGS) for name in ARGOVERSE2_CAMERAS}
        if not any(files for _, files in images.values()):
            found = ", ".join(sorted(path.name for path in folder.iterdir())[:NAMED]) or "nothing"
            raise UserError(
                f"{folder} holds no image that can be used: looked for ring_*/<timestamp>.jpg (or .jpeg, .png) of "
                f"{', '.join(ARGOVERSE2_CAMERAS)}; found {found}."
            )
        return images

    def frame(self, index: int) -> Frame:
        """Return frame ``index``: pose at exactly the sweep's time stamp, nearest image of each camera within 25 ms.

        Raises IndexError, and UserError without calibration, images or a whole pose.
        """
        instant = self.instant(index)
        images = {name: _nearest(*self._images[name], instant.timestamp) for name in ARGOVERSE2_CAMERAS}
        return Frame(
            scene=self.info.name,
            index=index,
            token=instant.token,
            timestamp=instant.timestamp,
            ego_to_global=instant.ego_to_global,
            rig=self.rig,
            images={name: path for name, path in images.items() if path is not None},
        )

    def instant(self, index: int) -> Instant:
        """Return token, time stamp and pose of frame ``index``; works without images and calibration."""
        pose = self.pose(index)
        timestamp = int(self.timestamps[index])
        return Instant(f"{self.info.name}_{timestamp}", timestamp, pose)

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
            [self._poses[name][row] for name in QUATERNION],
            [self._poses[name][row] for name in TRANSLATION],
            f"{where}, row {row}",
        )

    def lidar(self, index: int) -> Float | None:
        """Return the lidar sweep of frame ``index``, ``(n, 3)``, metres, ego frame; None if the file is not there."""
        path = self._folder / "sensors" / "lidar" / f"{int(self.timestamps[index])}.feather"
        return read_argoverse2_sweep(path) if path.is_file() else None

    @cached_property
    def ground_truth(self) -> Argoverse2GroundTruth | None:
        """The log's vector map, or None if it has none."""
        return None if self.map_file is None else Argoverse2GroundTruth(self.map_file)

    @property
    def map_file(self) -> Path | None:
        """File of the log's vector map, or None if it has none."""
        return next(iter(sorted((self._folder / "map").glob("log_map_archive_*.json"))), None)

    def truth(self, index: int, roi: RegionOfInterest) -> FrameTruth | None:
        """Return the official ground truth of frame ``index``, or None for a log without a map."""
        return None if self.ground_truth is None else self.ground_truth.frame(self.pose(index), roi)

    def truths(self, roi: RegionOfInterest, cache: Path | None = None) -> list[FrameTruth] | None:
        """Return the ground truth of all frames, kept in the folder ``cache`` if one is given."""
        if self.ground_truth is None:
            return None
        poses = [self.pose(index) for index in range(len(self))]
        return all_truths(self.ground_truth, poses, roi, cache, "argoverse2")

    def truth_map(self, roi: RegionOfInterest = STANDARD_REGION) -> GlobalMap | None:
        """Return the true map of this log, as a perfect mapper would make it; None for a log without a map."""
        return None if self.ground_truth is None else truth_map(self.ground_truth, self.way(), roi)

    def way(self) -> list[tuple[int, Float]]:
        """Return time stamp and ``ego_to_global`` of all frames."""
        return [(int(timestamp), self.pose(index)) for index, timestamp in enumerate(self.timestamps)]


def _nearest(times: Integer, files: Sequence[Path], timestamp: int) -> Path | None:
    if len(times) == 0:
        return None
    nearest = int(np.argmin(np.abs(times - timestamp)))
    return files[nearest] if abs(int(times[nearest]) - timestamp) <= IMAGE_TOLERANCE else None


def _camera(name: str, intrinsics: dict[str, Any], mounting: dict[str, Any], folder: Path) -> Camera:
    where = f"{folder / 'intrinsics.feather'}, {name}"
    matrix = np.eye(3)
    matrix[[0, 1, 0, 1], [0, 1, 2, 2]] = [intrinsics[key] for key in INTRINSICS[:4]]
    width, height = whole_field(intrinsics, "width_px", where), whole_field(intrinsics, "height_px", where)
    check_principal_point(matrix, width, height, where)
    mounted = f"{folder / 'egovehicle_SE3_sensor.feather'}, {name}"
    camera_to_ego = pose_matrix([mounting[key] for key in QUATERNION], [mounting[key] for key in TRANSLATION], mounted)
    check_mounting(camera_to_ego, mounted)
    return Camera(
        name=name,
        width=width,
        height=height,
        intrinsics=matrix,
        camera_to_ego=camera_to_ego,
        ground_height=GROUND_HEIGHT,
    )
