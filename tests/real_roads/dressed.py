"""Real roads drawn by our renderer, kept in the cache as log folders."""

from __future__ import annotations

import hashlib
import os
import zlib
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TypeVar

import cv2
import numpy as np

from mapfusion.arrays import Float
from mapfusion.elements import GlobalMap, RegionOfInterest
from predmapnet.datasets.own_logs.calibration import CALIBRATION, write_rig
from predmapnet.datasets.own_logs.scene import LogScene
from predmapnet.datasets.own_logs.timed_poses import TimedPoses, write_timed_poses
from predmapnet.demo_world.catalogue import WORLD_VERSION
from predmapnet.demo_world.render.renderer import Renderer
from predmapnet.demo_world.rig import DEMO_RIG, LIDAR_TO_EGO
from predmapnet.demo_world.street.dressing import dress
from predmapnet.demo_world.world import CrossingStyle, Look, Trajectory, VectorMap
from predmapnet.files import write_file
from predmapnet.machine import available_cores
from predmapnet.scenes import STANDARD_REGION, Camera, FrameTruth, Rig, Scene
from tests.real_roads.argoverse_logs import read_log
from tests.real_roads.road_maps import Truth, drives_along, read_road_map, truth_along
from tests.real_roads.scene_views import ChosenFrames, moved_rig
from tests.real_roads.street import EVERY_IMAGE

T = TypeVar("T")
FrameProgress = Callable[[int, int], None]

LOOKS = (Look.DAY, Look.OVERCAST)
"""Each log is drawn in both, dressed anew; a map's first drive in the first look, its second in the other."""
OWN_SCALE = 0.5
"""The cameras of Argoverse 2 have 2048 x 1550 pixels; they are drawn at half of that."""
JPEG_QUALITY = 90


def _centred(camera: Camera) -> Float:
    """The demo world's frames lie at the lidar, a metre before the rear axle; so its cameras sit around that."""
    pose = camera.camera_to_ego.copy()
    pose[0, 3] -= LIDAR_TO_EGO[0, 3]
    return pose


CENTRED_DEMO_RIG = moved_rig(DEMO_RIG, _centred)
"""The demo car's cameras around the centre of the region, where a network that was trained on it expects them."""


@dataclass(frozen=True)
class DressedDrive:
    """A drive over a real map, ready to be drawn.

    Attributes:
        name: of the log or map.
        look: light and weather.
        rig_name: ``demo`` or ``own``.
        rig: the cameras.
        vector_map: what is painted.
        trajectory: of the ego origin.
        truth: along it.
        seed: of everything that the map does not tell: wear of the paint, buildings, trees, traffic.
    """

    name: str
    look: Look
    rig_name: str
    rig: Rig
    vector_map: VectorMap
    trajectory: Trajectory
    truth: Truth
    seed: int

    def folder(self, cache: Path) -> Path:
        """Where its images are kept: by world version, look, rig, log, and all numbers that decide the images."""
        numbers = [np.array(self.seed), self.trajectory.timestamps, self.trajectory.ego_to_global]
        numbers += [part for camera in self.rig for part in (camera.intrinsics, camera.camera_to_ego)]
        numbers += [divider.points for divider in self.vector_map.dividers]
        numbers += [np.array(list(CrossingStyle).index(crossing.style)) for crossing in self.vector_map.crossings]
        digest = hashlib.sha256(b"".join(np.ascontiguousarray(part).tobytes() for part in numbers)).hexdigest()[:10]
        return cache / f"dressed-v{WORLD_VERSION}" / f"{self.name}-{self.look}-{self.rig_name}-{digest}"

    def open(self, cache: Path, step: int = 1, progress: FrameProgress | None = None) -> Scene:
        """Draw what the cache lacks of every ``step``-th frame, and return these frames as a scene."""
        folder = self.folder(cache)
        folder.mkdir(parents=True, exist_ok=True)
        write_rig(folder / CALIBRATION, self.rig)
        write_timed_poses(folder / "poses.csv", TimedPoses(self.trajectory.timestamps, self.trajectory.ego_to_global))
        rows = range(0, len(self.trajectory.timestamps), step)
        self._draw(folder, rows, progress)
        return DressedScene(folder, self.trajectory.timestamps[rows].tolist(), rows, self.truth)

    def _draw(self, folder: Path, rows: range, progress: FrameProgress | None) -> None:
        stamps = self.trajectory.timestamps.tolist()
        lacking = [
            row
            for row in rows
            if not all(image_path(folder, camera.name, stamps[row]).is_file() for camera in self.rig)
        ]
        if not lacking:
            return
        renderer = Renderer(dress(self.vector_map, self.trajectory, self.look, self.seed, self.name))

        def draw(row: int) -> None:
            for name, rendered in renderer.render_frame(self.rig, row).items():
                path = image_path(folder, name, stamps[row])
                path.parent.mkdir(parents=True, exist_ok=True)
                encoded = cv2.imencode(".jpg", rendered.image[:, :, ::-1], [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])[1]
                with write_file(path) as draft:
                    draft.write_bytes(encoded.tobytes())

        threads = int(os.environ.get("OMP_NUM_THREADS") or available_cores())
        with ThreadPoolExecutor(threads) as pool:
            for done, _ in enumerate(pool.map(draw, lacking), start=1):
                if progress is not None:
                    progress(done, len(lacking))


class DressedScene(ChosenFrames):
    """The frames of a drawn log that were asked for, with the truth of the road behind it.

    Args:
        folder: of the log.
        stamps: of the frames, nanoseconds.
        rows: of the frames among the poses of the drive, as the truth counts them.
        truth: along the drive.
    """

    def __init__(self, folder: Path, stamps: Sequence[int], rows: Sequence[int], truth: Truth) -> None:
        log = LogScene(folder, EVERY_IMAGE)
        super().__init__(log, np.searchsorted(log.timestamps, stamps).tolist())
        assert log.timestamps[self.rows].tolist() == stamps, f"{folder} lacks images of the camera that looks ahead"
        self.truth_rows, self.known = list(rows), truth

    def truth(self, index: int, roi: RegionOfInterest) -> FrameTruth | None:
        return self.known.frame(self.truth_rows[index], roi)

    def truths(self, roi: RegionOfInterest, cache: Path | None = None) -> list[FrameTruth] | None:
        """Return the truth of the frames; nothing is kept in ``cache``."""
        return [self.known.frame(row, roi) for row in self.truth_rows]

    def truth_map(self, roi: RegionOfInterest = STANDARD_REGION) -> GlobalMap | None:
        return self.known.whole()


def image_path(folder: Path, camera: str, timestamp: int) -> Path:
    """Where the image of a camera at an instant lies."""
    return folder / "images" / camera / f"{timestamp}.jpg"


def dressed_logs(folder: Path) -> Iterator[DressedDrive]:
    """Yield every log below a folder in both looks, with the demo rig and with its own cameras if they are known.

    Each look comes with a dressing of its own: other wear, other styles of crossings, other traffic.

    The truth is the official one of Argoverse 2. Only the demo rig's ego origin lies on the road.
    """
    for log in sorted(path.parent for path in folder.glob("*/city_SE3_egovehicle.feather")):
        yield from dressed_log(log)


def dressed_log(folder: Path) -> Iterator[DressedDrive]:
    """Yield one log as :func:`dressed_logs` does."""
    logged = read_log(folder)
    truth = Truth(lambda index, roi: _known(logged.log.truth(index, roi)), lambda: _known(logged.log.truth_map()))
    on_road = logged.trajectory.ego_to_global.copy()
    on_road[:, 2, 3] = 0.0
    rigs = [("demo", CENTRED_DEMO_RIG, replace(logged.trajectory, ego_to_global=on_road))]
    if logged.rig is not None:
        rigs.append(("own", tuple(_smaller(camera) for camera in logged.rig), logged.trajectory))
    for rig_name, rig, trajectory in rigs:
        for number, look in enumerate(LOOKS):
            painted, seed = repainted(logged.vector_map, number), _seed(folder.name[:8], number)
            yield DressedDrive(folder.name[:8], look, rig_name, rig, painted, trajectory, truth, seed)


def repainted(vector_map: VectorMap, turn: int) -> VectorMap:
    """Return a map whose crossings are painted in another style each turn: no map says which, and it matters much."""
    styles = list(CrossingStyle)
    crossings = (
        replace(crossing, style=styles[(styles.index(crossing.style) + turn) % len(styles)])
        for crossing in vector_map.crossings
    )
    return replace(vector_map, crossings=tuple(crossings))


def _seed(name: str, turn: int) -> int:
    return zlib.crc32(name.encode()) + turn


def _known(truth: T | None) -> T:
    assert truth is not None, "a log without a map cannot be dressed"
    return truth


def _smaller(camera: Camera) -> Camera:
    width, height = round(camera.width * OWN_SCALE), round(camera.height * OWN_SCALE)
    scale = np.diag([width / camera.width, height / camera.height, 1.0])
    return replace(camera, width=width, height=height, intrinsics=scale @ camera.intrinsics)


def dressed_maps(folder: Path) -> Iterator[DressedDrive]:
    """Yield two drives over each road map of a folder, with the demo rig; truth by the rules of nuScenes."""
    for path in sorted(folder.glob("*.json")):
        painted, paths, true_map = read_road_map(path)
        for number, (trajectory, look) in enumerate(
            zip(drives_along(paths, painted, len(LOOKS)), LOOKS, strict=True), start=1
        ):
            truth = truth_along(true_map, trajectory)
            name = f"{path.stem}-{number}"
            yield DressedDrive(name, look, "demo", CENTRED_DEMO_RIG, painted, trajectory, truth, _seed(name, 0))
