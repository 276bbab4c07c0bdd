"""One log of one's own: frames at a chosen rate, each image with the pose of its own instant."""

from __future__ import annotations

from dataclasses import replace
from functools import cached_property
from pathlib import Path

import numpy as np

from mapfusion.arrays import Float, Integer
from mapfusion.elements import GlobalMap, RegionOfInterest
from mapfusion.formats.local_plane import LocalPlane
from mapfusion.geometry import inverse_pose
from predmapnet.datasets.argoverse2_files import IMAGE_ENDINGS, timed_files
from predmapnet.datasets.fields import is_given, numbers_field
from predmapnet.datasets.georeference import local_frame, plane_at
from predmapnet.datasets.large_tables import parse_json
from predmapnet.datasets.own_logs.calibration import CALIBRATION, read_calibration
from predmapnet.datasets.own_logs.pose_files import read_timed_poses
from predmapnet.datasets.own_logs.timed_poses import TimedPoses
from predmapnet.datasets.own_logs.truth import Lines, read_truth, truth_around, truth_of_drive
from predmapnet.errors import UserError
from predmapnet.scenes import STANDARD_REGION, Camera, Frame, FrameTruth, Instant, Rig, SceneInfo

RATE = 2.0
"""Frames a second: as the shipped network was trained."""
LATEST = 100_000_000
"""An image farther from the frame's instant does not belong to it, nanoseconds."""


class LogScene:
    """A folder with ``calibration.json``, ``poses.csv`` and ``images/<camera>/<timestamp_ns>.jpg``.

    Frames are at instants of the reference camera's images: of the camera that looks ahead the most. The image of
    another camera belongs to a frame if it lies within 0.1 s of it, and that camera stands where it was at the instant
    of its own image, seen from where the car is at the frame's.

    Attributes:
        folder: of the log.
        info: the line in a listing.
        rig: the cameras as they are mounted.
        poses: of the drive.
        georeference: of ``georeference.json`` (latitude and longitude of the origin of the poses), or None.
        timestamps: ``(n,) int64`` of the frames, nanoseconds.
    """

    def __init__(self, folder: Path, rate: float = RATE, split: str = "test", name: str | None = None) -> None:
        """Read calibration and poses; images are named, not read.

        Args:
            folder: of the log.
            rate: frames a second at most.
            split: that the log belongs to.
            name: of the log; that of its folder without.

        Raises:
            UserError: a file is missing or damaged, or images and poses are not of the same time.
        """
        self.folder = folder
        calibration = read_calibration(folder / CALIBRATION)
        self.rig: Rig = calibration.rig
        self.poses: TimedPoses = read_timed_poses(folder, calibration.poses_of)
        self.georeference = _georeference(folder / "georeference.json")
        self.timestamps: Integer = self._instants(rate)
        self.info = SceneInfo(
            name or folder.resolve().name, split, len(self.timestamps), "", description=self._left_out()
        )

    @cached_property
    def images(self) -> dict[str, tuple[Integer, list[Path]]]:
        """Time stamps of the images of each camera, ascending, and the files."""
        return {camera.name: timed_files(self.folder / "images" / camera.name, *IMAGE_ENDINGS) for camera in self.rig}

    @property
    def reference(self) -> Camera:
        """The camera whose images make the frames: of those that have images, the one that looks ahead the most."""
        seeing = [camera for camera in self.rig if len(self.images[camera.name][0])]
        if not seeing:
            raise UserError(
                f"{self.folder} holds no image: looked for images/<camera>/<nanoseconds>.jpg (or .jpeg, .png) of "
                f"{', '.join(camera.name for camera in self.rig)}."
            )
        return max(seeing, key=lambda camera: float(camera.camera_to_ego[0, 2]))

    def _instants(self, rate: float) -> Integer:
        """Choose the reference camera's images that make frames."""
        times, _ = self.images[self.reference.name]
        known = times[self.poses.cover(times)]
        if not len(known):
            first, last = self.poses.timestamps[[0, -1]].tolist()
            raise UserError(
                f"{self.folder}: no image of {self.reference.name} lies between poses: its images are from {times[0]} "
                f"to {times[-1]}, the poses from {first} to {last} nanoseconds. Are both of one clock and unit?"
            )
        step = round(1e9 / rate)
        # Cameras trigger unevenly: an image that comes up to half of their period early is taken, too.
        slack = min(int(np.median(np.diff(known))) if len(known) > 1 else 0, step) // 2
        chosen = [int(known[0])]
        for time in known[1:].tolist():
            if time - chosen[-1] >= step - slack:
                chosen.append(time)
        return np.array(chosen, dtype=np.int64)

    def _left_out(self) -> str:
        times, _ = self.images[self.reference.name]
        count = int((~self.poses.cover(times)).sum())
        return f"{count} of {len(times)} images of {self.reference.name} left out: no pose" if count else ""

    def __len__(self) -> int:
        return len(self.timestamps)

    def frame(self, index: int) -> Frame:
        """Return frame ``index``; its rig is that of this frame, ``missing`` says how far off other images are."""
        instant = self.instant(index)
        to_ego = inverse_pose(instant.ego_to_global)
        rig, images, missing = [], {}, {}
        for camera in self.rig:
            times, files = self.images[camera.name]
            row = _nearest(times, instant.timestamp)
            if row is None or abs(int(times[row]) - instant.timestamp) > LATEST:
                missing[camera.name] = _how_far(times, row, instant.timestamp)
                rig.append(camera)
                continue
            images[camera.name] = files[row]
            if times[row] != instant.timestamp:
                moved = to_ego @ self.poses.at(int(times[row])) @ camera.camera_to_ego
                camera = replace(camera, camera_to_ego=moved)
            rig.append(camera)
        return Frame(
            self.info.name, index, instant.token, instant.timestamp, instant.ego_to_global, tuple(rig), images, missing
        )

    def instant(self, index: int) -> Instant:
        """Return token, time stamp and pose of frame ``index``."""
        if not 0 <= index < len(self):
            raise IndexError(f"{self.info.name} has {len(self)} frames, not a frame {index}")
        timestamp = int(self.timestamps[index])
        return Instant(f"{self.info.name}_{timestamp}", timestamp, self.poses.at(timestamp))

    def lidar(self, index: int) -> Float | None:
        """Return None: these logs have no lidar."""
        return None

    @cached_property
    def _lines(self) -> Lines | None:
        origin = self.poses.ego_to_global[0, :2, 3]
        return read_truth(self.folder, self.georeference or local_frame(self.info.name, origin))

    def truth(self, index: int, roi: RegionOfInterest) -> FrameTruth | None:
        """Return the truth of frame ``index``, or None for a log without ``truth.json`` or ``truth.geojson``."""
        return None if self._lines is None else truth_around(self._lines, self.instant(index).ego_to_global, roi)

    def truths(self, roi: RegionOfInterest, cache: Path | None = None) -> list[FrameTruth] | None:
        """Return the truth of all frames, or None; it is quickly made, so nothing is kept in ``cache``."""
        found = (self.truth(index, roi) for index in range(len(self)))
        return None if self._lines is None else [truth for truth in found if truth is not None]

    def truth_map(self, roi: RegionOfInterest = STANDARD_REGION) -> GlobalMap | None:
        """Return the true lines of the whole drive, or None."""
        return None if self._lines is None else truth_of_drive(self._lines, self.timestamps)


def _nearest(times: Integer, timestamp: int) -> int | None:
    """Return the row of the time nearest to an instant; None if there is none."""
    if not len(times):
        return None
    after = int(np.searchsorted(times, timestamp).clip(1, max(len(times) - 1, 1)))
    return min(range(max(after - 1, 0), min(after + 1, len(times))), key=lambda row: abs(int(times[row]) - timestamp))


def _how_far(times: Integer, row: int | None, timestamp: int) -> str:
    if row is None:
        return "the log holds none"
    seconds = abs(int(times[row]) - timestamp) / 1e9
    return f"the nearest one is {seconds:.2f} s away, and at most {LATEST / 1e9:g} s are taken"


def _georeference(path: Path) -> LocalPlane | None:
    """Read where the origin of the poses lies; x is east, y is north. None where there is no file."""
    if not is_given(path):
        return None
    content = parse_json(path.read_bytes(), path, unique=True)
    record = content if isinstance(content, dict) else {}
    latitude, longitude = (float(numbers_field(record, name, (), str(path))) for name in ("latitude", "longitude"))
    place = f"{path}: latitude {latitude:g}, longitude {longitude:g}"
    return plane_at(latitude, longitude, "origin of georeference.json", place)
