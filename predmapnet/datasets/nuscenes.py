"""nuScenes (v1.0-mini, v1.0-trainval, and anything else written in its schema)."""

from __future__ import annotations

import difflib
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path

import numpy as np

from mapfusion.arrays import Float
from mapfusion.elements import GlobalMap, RegionOfInterest
from mapfusion.geometry import inverse_pose
from mapfusion.georeference import Georeference
from predmapnet.datasets.fields import (
    check_mounting,
    check_principal_point,
    is_there,
    numbers_field,
    text_field,
    whole_field,
)
from predmapnet.datasets.georeference import demo_georeference, nuscenes_georeference
from predmapnet.datasets.ground_truth.cache import all_truths
from predmapnet.datasets.ground_truth.map_file import read_map_file
from predmapnet.datasets.ground_truth.nuscenes import NuScenesGroundTruth
from predmapnet.datasets.ground_truth.whole_map import truth_map
from predmapnet.datasets.large_tables import Record
from predmapnet.datasets.lidar import read_nuscenes_sweep
from predmapnet.datasets.log_checks import check_cameras, check_clock, check_drive, usable_poses
from predmapnet.datasets.nuscenes_tables import LIDAR, NUSCENES_CAMERAS, Tables, choose_version, expansion_path
from predmapnet.datasets.poses import combined, pose_matrix
from predmapnet.datasets.splits import check_scheme, check_split, split_names
from predmapnet.errors import UserError
from predmapnet.scenes import STANDARD_REGION, Camera, Frame, FrameTruth, Instant, Progress, Rig, SceneInfo

OLD_SPLIT = {"train": "nuscenes_old_train", "val": "nuscenes_old_val", "test": "nuscenes_test"}
OLD_MINI_SPLIT = {"train": "nuscenes_mini_train", "val": "nuscenes_mini_val"}
NEW_SPLIT = {"train": "nuscenes_new_train", "val": "nuscenes_new_val"}
DEMO_MARKER = "demo_world.json"
"""A data set with this file in its root was rendered by the demo world."""
LEFT_OUT = "left out of the published training sets"


class NuScenesSource:
    """A nuScenes data set on disk.

    Attributes:
        name: ``nuscenes``.
        root: folder with ``v1.0-*``, ``samples`` and ``maps``.
        version: name of the table folder that is read.
        synthetic: whether its images were rendered, as the demo world's marker file says.
        split_scheme: ``old`` or ``new``.
        keep_corners: whether crossings keep the corners of the region.
    """

    name = "nuscenes"

    def __init__(
        self, root: Path, version: str | None = None, split_scheme: str = "old", keep_corners: bool = False
    ) -> None:
        """Find the tables; nothing is read yet.

        Args:
            root: folder with ``v1.0-*``, ``samples`` and ``maps``.
            version: table folder; None takes v1.0-trainval if it is there, v1.0-mini only if nothing else is.
            split_scheme: ``old`` (the data set's own; v1.0-mini has one of its own) or ``new`` (StreamMapNet's
                geographically disjoint one).
            keep_corners: of crossings in the ground truth, which the official code may lose; see
                :class:`~predmapnet.datasets.ground_truth.NuScenesGroundTruth`. Rendered towns always keep them.

        Raises:
            UserError: nothing to open, or no such scheme.
        """
        self.root = Path(root)
        self.synthetic = (self.root / DEMO_MARKER).is_file()
        self.version = choose_version(self.root, version)
        check_scheme(split_scheme)
        self.split_scheme = split_scheme
        self.keep_corners = keep_corners or self.synthetic
        self.tables = Tables(self.root / self.version)
        self._maps: dict[str, NuScenesGroundTruth | None] = {}

    @cached_property
    def _split_of(self) -> dict[str, str]:
        old = OLD_MINI_SPLIT if self.version == "v1.0-mini" else OLD_SPLIT
        lists = NEW_SPLIT if self.split_scheme == "new" else old
        return {scene: split for split, name in lists.items() for scene in split_names(name)}

    def scenes(self, split: str | None = None) -> tuple[SceneInfo, ...]:
        """List the scenes in the order of ``scene.json``.

        Scenes that no split list names (one's own logs in this schema) are given as ``test``; with the new split
        they are left out, like the four scenes of nuScenes that it leaves out.
        """
        check_split(split, self.split_scheme)
        names = [name for name in self.tables.scenes if self.split_scheme == "old" or name in self._split_of]
        if not names and self.tables.scenes:
            raise UserError(
                f"The new split names none of the {len(self.tables.scenes)} scenes in {self.tables.folder}."
            )
        infos = tuple(self._info(name) for name in names)
        return infos if split is None else tuple(info for info in infos if info.split == split)

    def _info(self, name: str) -> SceneInfo:
        record, where = self.tables.scenes[name], str(self.tables.path("scene"))
        log = self.tables.logs.get(text_field(record, "log_token", where))
        if log is None:
            raise UserError(f"{self.tables.folder}: scene {name} names a log that log.json does not hold.")
        return SceneInfo(
            name=name,
            split=self._split_of.get(name, "test"),
            frames=whole_field(record, "nbr_samples", where),
            location=text_field(log, "location", str(self.tables.path("log"))),
            description=LEFT_OUT if name in split_names("nuscenes_skipped") else str(record.get("description", "")),
        )

    def open(self, scene: str, progress: Progress | None = None) -> NuScenesScene:
        """Open one scene by name. Raises UserError with the nearest names if it is not there."""
        if scene not in self.tables.scenes:
            near = difflib.get_close_matches(scene, list(self.tables.scenes), n=4, cutoff=0.5)
            hint = f" Did you mean {', '.join(near)}?" if near else ""
            raise UserError(
                f"{self.tables.folder} holds no scene '{scene}' among its {len(self.tables.scenes)} scenes.{hint}"
            )
        info = self._info(scene)
        truth = partial(self._ground_truth, info.location)
        return NuScenesScene(self.root, self.tables, info, truth, self._georeference(info))

    def truth_map(self, scenes: Sequence[str], roi: RegionOfInterest) -> GlobalMap | None:
        """Return the true map of what came into the region along scenes of one location; None without an expansion."""
        opened = [self.open(name) for name in scenes]
        truth = opened[0].ground_truth
        return None if truth is None else truth_map(truth, [pose for scene in opened for pose in scene.way()], roi)

    def scenes_of(self, tokens: Iterable[str]) -> dict[str, str]:
        """Look up which scenes frames belong to, by sample token; unknown tokens are absent."""
        names = {str(record.get("token")): name for name, record in self.tables.scenes.items()}
        samples = ((token, self.tables.samples.get(token)) for token in tokens)
        return {
            token: names[str(sample["scene_token"])]
            for token, sample in samples
            if sample is not None and str(sample.get("scene_token")) in names
        }

    def _georeference(self, info: SceneInfo) -> Georeference | None:
        """Return the georeference of a scene; rendered towns carry a borrowed location, but lie in the ocean."""
        if not self.synthetic:
            return nuscenes_georeference(info.location)
        seed = whole_field({"town_seed": 0, **read_map_file(self.root / DEMO_MARKER)[0]}, "town_seed", DEMO_MARKER)
        return demo_georeference(f"demo world, {info.name}", seed)

    def _ground_truth(self, location: str) -> NuScenesGroundTruth | None:
        if location not in self._maps:
            path = expansion_path(self.root, location)
            self._maps[location] = NuScenesGroundTruth(path, self.keep_corners) if path.is_file() else None
        return self._maps[location]


@dataclass(frozen=True)
class _KeyFrame:
    """Records of one sample."""

    token: str
    timestamp: int
    ego_pose: Record | None
    sensors: Mapping[str, Record]


class NuScenesScene:
    """One nuScenes scene; frames are its key frames (2 Hz).

    Attributes:
        info: the scene's line in the listing.
        rig: cameras of the first frame, in the order of the official vector-map data sets.
        georeference: of the scene's map; None for a map that nuScenes does not know.
    """

    def __init__(
        self,
        root: Path,
        tables: Tables,
        info: SceneInfo,
        ground_truth: Callable[[], NuScenesGroundTruth | None],
        georeference: Georeference | None,
    ) -> None:
        """Read the scene's records below ``root``, the folder with ``samples``; its map is read when it is needed."""
        self.info = info
        self._read_ground_truth = ground_truth
        self.georeference = georeference
        self._root = root
        self._tables = tables
        self._sensor_poses: dict[str, Float] = {}
        self._frames = self._read_frames()
        self._cameras = self._read_cameras()
        self._check()
        self.rig: Rig = self.frame(0).rig

    def __len__(self) -> int:
        return len(self._frames)

    @cached_property
    def ground_truth(self) -> NuScenesGroundTruth | None:
        """The map expansion of the scene's location, or None. Raises UserError for one that cannot be used."""
        return self._read_ground_truth()

    def _read_frames(self) -> list[_KeyFrame]:
        samples: list[Record] = []
        scene = self._tables.scenes[self.info.name]
        token = text_field(scene, "first_sample_token", str(self._tables.path("scene")))
        table = str(self._tables.path("sample"))
        while token:
            if token not in self._tables.samples:
                raise UserError(f"{self._tables.path('sample')}: sample {token} of {self.info.name} is missing.")
            samples.append(self._tables.samples[token])
            # Some writers of this schema end a scene with null instead of an empty text.
            ended = samples[-1].get("next", "") is None and token == scene.get("last_sample_token")
            token = "" if ended else text_field(samples[-1], "next", table)
            if len(samples) > len(self._tables.samples):
                raise UserError(f"{self._tables.path('sample')}: the samples of {self.info.name} run in a circle.")
        if not samples:
            raise UserError(f"{self._tables.folder}: {self.info.name} holds no frame.")
        sensors = self._tables.sample_data(sample["token"] for sample in samples)
        table_of_data = str(self._tables.path("sample_data"))
        pose_tokens = {
            token: text_field(data[LIDAR], "ego_pose_token", table_of_data)
            for token, data in sensors.items()
            if LIDAR in data
        }
        poses = self._tables.ego_poses(pose_tokens.values())
        return [
            _KeyFrame(
                token=sample["token"],
                timestamp=whole_field(sample, "timestamp", table) * 1000,
                ego_pose=poses.get(pose_tokens.get(sample["token"], "")),
                sensors=sensors[sample["token"]],
            )
            for sample in samples
        ]

    def _read_cameras(self) -> dict[str, Record]:
        """First record of each camera, in rig order: stands in for the calibration where a frame lacks an image."""
        cameras = {
            channel: next(frame.sensors[channel] for frame in self._frames if channel in frame.sensors)
            for channel in NUSCENES_CAMERAS
            if any(channel in frame.sensors for frame in self._frames)
        }
        if not cameras:
            found = sorted({channel for frame in self._frames for channel in frame.sensors})
            raise UserError(
                f"{self._tables.path('sensor')}: {self.info.name} has no camera of the names that nuScenes gives "
                f"({', '.join(NUSCENES_CAMERAS)}); its sensors are {', '.join(found) or 'none'}."
            )
        return cameras

    def _check(self) -> None:
        """Raise UserError for times that do not go on or are of another unit, and for cameras and poses of no car."""
        name, path = self.info.name, self._tables.path
        stored = [self._calibration(record).get("rotation") for record in self._cameras.values()]
        check_cameras(stored, f"{path('calibrated_sensor')}, {name}")
        times = np.array([frame.timestamp // 1000 for frame in self._frames], dtype=np.int64)
        late = np.flatnonzero(np.diff(times) <= 0)
        if len(late):
            frame = int(late[0]) + 1
            raise UserError(f"{path('sample')}, {name}: the time of frame {frame} is not after that of the one before.")
        poses = [frame.ego_pose or {} for frame in self._frames]
        rows, quaternions, positions = usable_poses([(pose.get("rotation"), pose.get("translation")) for pose in poses])
        check_clock(times[rows], positions, "microseconds", f"{path('sample')}, {name}")
        check_drive(quaternions, positions, f"{path('ego_pose')}, {name}")

    def _where(self, index: int, table: str) -> str:
        return f"{self.info.name}, frame {index}, {self._tables.folder / table}.json"

    def _poses(self, index: int) -> tuple[Float, Float]:
        """``ego_to_global`` and ``lidar_to_ego`` of the lidar's instant, as stored."""
        frame = self._frames[index]
        if LIDAR not in frame.sensors:
            raise UserError(f"{self._where(index, 'sample_data')}: there is no {LIDAR} key frame, so no pose.")
        if frame.ego_pose is None:
            token = frame.sensors[LIDAR]["ego_pose_token"]
            raise UserError(f"{self._where(index, 'ego_pose')}: the pose {token} is missing.")
        ego_to_global = _pose(frame.ego_pose, self._where(index, "ego_pose"))
        return ego_to_global, self._sensor_to_ego(frame.sensors[LIDAR], self._where(index, "calibrated_sensor"))

    def _calibration(self, record: Record) -> Record:
        return self._tables.calibrations[str(record["calibrated_sensor_token"])]

    def _sensor_to_ego(self, record: Record, where: str) -> Float:
        """Return the pose of a sensor on the car; the same few are asked for in every frame."""
        token = record["calibrated_sensor_token"]
        if token not in self._sensor_poses:
            self._sensor_poses[token] = _pose(self._calibration(record), where)
        return self._sensor_poses[token]

    def instant(self, index: int) -> Instant:
        """Return token, time stamp and pose of frame ``index``; raises as :meth:`frame` does."""
        if not 0 <= index < len(self._frames):
            raise IndexError(f"{self.info.name} has {len(self._frames)} frames, not a frame {index}")
        ego_to_global, lidar_to_ego = self._poses(index)
        shifted_to_global = ego_to_global.copy()
        shifted_to_global[:2, 3] = combined(ego_to_global, lidar_to_ego)[:2, 3]
        return Instant(self._frames[index].token, self._frames[index].timestamp, shifted_to_global)

    def frame(self, index: int) -> Frame:
        """Return frame ``index`` (the official convention: ego axes, origin at the lidar's x, y).

        The cameras' own time stamps are not used: like the official data sets, all calibrations are read as if
        taken at the lidar's instant.

        Raises:
            IndexError: no such frame.
            UserError: a pose is missing, not finite or not rigid.
        """
        instant = self.instant(index)
        ego_to_shifted = inverse_pose(instant.ego_to_global) @ self._poses(index)[0]
        frame = self._frames[index]
        table = str(self._tables.path("sample_data"))
        images = {
            channel: self._root / text_field(frame.sensors[channel], "filename", table)
            for channel in NUSCENES_CAMERAS
            if channel in frame.sensors
        }
        return Frame(
            scene=self.info.name,
            index=index,
            token=instant.token,
            timestamp=instant.timestamp,
            ego_to_global=instant.ego_to_global,
            rig=tuple(
                self._camera(channel, frame.sensors.get(channel, first), ego_to_shifted, index)
                for channel, first in self._cameras.items()
            ),
            images={channel: path for channel, path in images.items() if is_there(path)},
            missing={channel: f"{path} does not exist" for channel, path in images.items() if not is_there(path)},
        )

    def _camera(self, channel: str, record: Record, ego_to_shifted: Float, index: int) -> Camera:
        calibration = self._calibration(record)
        where = f"{self._where(index, 'calibrated_sensor')}, {channel}"
        table = str(self._tables.path("sample_data"))
        intrinsics = numbers_field(calibration, "camera_intrinsic", (3, 3), where)
        width, height = whole_field(record, "width", table), whole_field(record, "height", table)
        check_principal_point(intrinsics, width, height, where)
        check_mounting(self._sensor_to_ego(record, where), where)
        return Camera(
            name=channel,
            width=width,
            height=height,
            intrinsics=intrinsics,
            camera_to_ego=ego_to_shifted @ self._sensor_to_ego(record, where),
        )

    def lidar_to_global(self, index: int) -> Float:
        """Pose of the lidar in frame ``index``, ``(4, 4) float64``; the official ground truth hangs on it."""
        ego_to_global, lidar_to_ego = self._poses(index)
        return combined(ego_to_global, lidar_to_ego)

    def lidar_path(self, index: int) -> Path | None:
        """Return the lidar file of frame ``index``, or None if it is not there."""
        record, table = self._frames[index].sensors[LIDAR], str(self._tables.path("sample_data"))
        path = self._root / text_field(record, "filename", table)
        return path if path.is_file() else None

    def lidar(self, index: int) -> Float | None:
        """Return the lidar sweep of frame ``index``, ``(n, 3)``, metres, ego frame; None if the file is not there."""
        path = self.lidar_path(index)
        if path is None:
            return None
        shifted_to_global = self.instant(index).ego_to_global
        return read_nuscenes_sweep(path, inverse_pose(shifted_to_global) @ self.lidar_to_global(index))

    def truth(self, index: int, roi: RegionOfInterest) -> FrameTruth | None:
        """Return the official ground truth of frame ``index``, or None without a map expansion."""
        if self.ground_truth is None:
            return None
        return self.ground_truth.frame(self.lidar_to_global(index), roi)

    def truths(self, roi: RegionOfInterest, cache: Path | None = None) -> list[FrameTruth] | None:
        """Return the ground truth of all frames, kept in the folder ``cache`` if one is given."""
        if self.ground_truth is None:
            return None
        poses = [self.lidar_to_global(index) for index in range(len(self))]
        return all_truths(self.ground_truth, poses, roi, cache, "nuscenes")

    def truth_map(self, roi: RegionOfInterest = STANDARD_REGION) -> GlobalMap | None:
        """Return the true map of this scene, as a perfect mapper would make it; None without a map expansion."""
        return None if self.ground_truth is None else truth_map(self.ground_truth, self.way(), roi)

    def way(self) -> list[tuple[int, Float]]:
        """Return time stamp and ``lidar_to_global`` of all frames."""
        return [(frame.timestamp, self.lidar_to_global(index)) for index, frame in enumerate(self._frames)]


def _pose(record: Record, where: str) -> Float:
    for name in ("rotation", "translation"):
        if record.get(name) is None:
            raise UserError(f"{where}, record {record.get('token')}: the field '{name}' is missing.")
    return pose_matrix(record["rotation"], record["translation"], where)
