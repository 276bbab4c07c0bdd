"""Logs of cars unlike the demo car, drawn, mapped from their folders, and what that costs over a long drive.

    python -m tests.benchmarks.log_drives --car front --frames 2000 --rate 20
    python -m tests.benchmarks.log_drives --car seven-fisheyes --frames 40 --rate 2

The drive through the town of a demo scene is drawn at the rate, and driven on lap after lap, each from where the one
before ended. The folder is what docs/own-logs.md describes, and the path is that of ``predmapnet infer FOLDER``.
Memory is that of the process; CPU seconds are those of all threads.
"""

from __future__ import annotations

import argparse
import json
import os
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

from predmapnet.machine import use_threads

if __name__ == "__main__":  # Before torch is imported.
    arguments = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    arguments.add_argument("--car", choices=("front", "seven-fisheyes"), default="front")
    arguments.add_argument("--frames", type=int, default=2000)
    arguments.add_argument("--rate", type=float, default=20.0)
    arguments.add_argument("--every", type=int, default=200, help="frames per line that is printed")
    arguments.add_argument("--threads", type=int, default=0, help="0: all cores")
    options = arguments.parse_args()
    use_threads(options.threads)

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from mapfusion.arrays import Float
from mapfusion.geometry import inverse_pose
from predmapnet.datasets.own_logs.calibration import CALIBRATION, write_calibration
from predmapnet.datasets.own_logs.timed_poses import TimedPoses, write_timed_poses
from predmapnet.datasets.undistortion import KANNALA_BRANDT, Lens
from predmapnet.demo_world.catalogue import build_world
from predmapnet.demo_world.render.renderer import Renderer
from predmapnet.demo_world.world import Trajectory
from predmapnet.machine import NetworkOptions
from predmapnet.runs.infer import MappingPipeline, SceneReport
from predmapnet.runs.outputs import Outputs
from predmapnet.scenes import Camera, Image
from tests.benchmarks.endless_drive import SCENE, resident_megabytes
from tests.real_roads.road_maps import truth_along

LEVEL = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
"""Columns: the axes of a level camera that looks along ego x."""
LENS = np.array([0.03, -0.008, 0.001, 0.0])
WIDE = 1.9
"""Tangent of half the field of the pinhole that a fisheye's image is taken from."""
LATE = 3_000_000
"""Each camera of a car takes its image so much later than the one before it, nanoseconds."""


@dataclass(frozen=True)
class DrawnCamera:
    """A camera to draw: the pinhole that the renderer draws, and the fisheye whose image is made of it, if it is one.

    Attributes:
        pinhole: as it is drawn.
        lens: of the stored images; None stores what is drawn.
    """

    pinhole: Camera
    lens: Lens | None = None

    def entry(self) -> dict[str, object]:
        """Return the entry of ``calibration.json``."""
        stored = self.lens or self.pinhole
        x, y, z, w = Rotation.from_matrix(self.pinhole.camera_to_ego[:3, :3]).as_quat().tolist()
        k = stored.intrinsics
        entry: dict[str, object] = {
            "width": stored.width,
            "height": stored.height,
            "model": "pinhole" if self.lens is None else "fisheye",
            "intrinsics": {"fx": k[0, 0], "fy": k[1, 1], "cx": k[0, 2] - 0.5, "cy": k[1, 2] - 0.5},
            "camera_to_ego": {
                "translation_m": self.pinhole.camera_to_ego[:3, 3].tolist(),
                "rotation_wxyz": [w, x, y, z],
            },
        }
        return entry if self.lens is None else entry | {"distortion": self.lens.distortion.tolist()}

    def stored(self, image: Image) -> Image:
        """Return the image that is stored of what was drawn."""
        if self.lens is None:
            return image
        row, column = np.mgrid[: self.lens.height, : self.lens.width] + 0.5
        rays = self.lens.unproject(np.column_stack([column.ravel(), row.ravel()]))
        ahead = np.where(rays[:, 2:] > 0.05, rays, [1e3, 1e3, 1.0])
        pixels = (ahead / ahead[:, 2:] @ self.pinhole.intrinsics.T)[:, :2] - 0.5
        places = pixels.reshape(self.lens.height, self.lens.width, 2).astype(np.float32)
        x, y = places[..., 0], places[..., 1]
        return np.asarray(cv2.remap(image, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT), np.uint8)


def camera(name: str, place: tuple[float, float, float], yaw: float, pitch: float, fisheye: bool) -> DrawnCamera:
    """Return a camera ``yaw`` degrees to the left and ``pitch`` degrees down; a fisheye sees 180 degrees."""
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_euler("ZY", [yaw, pitch], degrees=True).as_matrix() @ LEVEL
    pose[:3, 3] = place
    if not fisheye:
        return DrawnCamera(Camera(name, 448, 252, intrinsics(448, 252, 340.0), pose))
    stored = intrinsics(480, 360, 480 / np.pi)
    lens = Lens(KANNALA_BRANDT, 480, 360, stored, LENS, np.eye(3))
    return DrawnCamera(Camera(name, 640, 640, intrinsics(640, 640, 320 / WIDE), pose), lens)


def intrinsics(width: int, height: int, focal: float) -> Float:
    """Return the matrix of a camera whose axis meets the middle of its image."""
    return np.array([[focal, 0.0, width / 2], [0.0, focal, height / 2], [0.0, 0.0, 1.0]])


CARS: dict[str, tuple[DrawnCamera, ...]] = {
    "front": (camera("front", (1.7, 0.0, 1.5), 0.0, 0.0, False),),
    "seven-fisheyes": (
        camera("front", (1.9, 0.0, 1.4), 0.0, 10.0, True),
        camera("front_left", (1.5, 0.5, 1.5), 50.0, 15.0, True),
        camera("front_right", (1.5, -0.5, 1.5), -50.0, 15.0, True),
        camera("left", (0.8, 0.9, 1.1), 95.0, 30.0, True),
        camera("right", (0.8, -0.9, 1.1), -95.0, 30.0, True),
        camera("rear_left", (-0.5, 0.5, 1.4), 140.0, 15.0, True),
        camera("rear", (-0.9, 0.0, 1.3), 180.0, 10.0, True),
    ),
}
"""Cars by name; their frame lies on the road below the rear axle."""


def write_log(folder: Path, car: tuple[DrawnCamera, ...], frames: int, rate: float) -> Path:
    """Draw a log of so many frames at a rate, frames a second; laps after the first are hard links."""
    folder.mkdir(parents=True)
    world = build_world(SCENE)
    known = TimedPoses(world.trajectory.timestamps, world.trajectory.ego_to_global)
    first, step = int(known.timestamps[0]), round(1e9 / rate)
    steps = int((known.timestamps[-1] - first) // step)
    lap = frames if frames <= steps + 1 else steps
    times = first + step * np.arange(lap)[:, None] + LATE * np.arange(len(car))
    instants = np.unique(times)
    poses = np.array([known.at(int(instant)) for instant in instants])
    drive = Trajectory(instants, poses)
    if lap == frames:
        true = [{"kind": element.kind.label, "points": element.points.tolist()}
                for element in truth_along(world.map, drive).whole()]  # fmt: skip
        (folder / "truth.json").write_text(json.dumps({"elements": true}))
    renderer = Renderer(replace(world, trajectory=drive))
    for number, one in enumerate(car):
        target = folder / "images" / one.pinhole.name
        target.mkdir(parents=True)
        for row, taken in enumerate(times[:, number].tolist()):
            drawn = renderer.render(one.pinhole, int(np.searchsorted(instants, taken))).image
            path = target / f"{taken}.jpg"
            cv2.imwrite(str(path), one.stored(drawn)[:, :, ::-1])
            for later in range(row + lap, frames, lap):
                os.link(path, target / f"{taken + (later - row) * step}.jpg")
    onward = known.at(first + lap * step) @ inverse_pose(poses[0])
    laps = range(-(-frames // lap))
    stamps = np.concatenate([instants + number * lap * step for number in laps])
    driven = np.concatenate([np.linalg.matrix_power(onward, number) @ poses for number in laps])
    write_calibration(folder / CALIBRATION, {one.pinhole.name: one.entry() for one in car}, 0.0)
    write_timed_poses(folder / "poses.csv", TimedPoses(stamps, driven))
    return folder


def mapped(folder: Path, rate: float, every: int, say: Callable[[str], None]) -> SceneReport:
    """Map a log as ``predmapnet infer`` does; say frame, CPU milliseconds per frame and megabytes on the way."""
    began = time.process_time()

    def watch(done: int, total: int) -> None:
        nonlocal began
        if done and done % every == 0:
            now = time.process_time()
            say(f"{done:10d}{1e3 * (now - began) / every:12.1f}{resident_megabytes():12.0f}")
            began = now

    pipeline = MappingPipeline.open("log", folder, NetworkOptions(), rate=rate)
    return pipeline.run(None, Outputs(map=folder.parent / "map.geojson"), progress=watch).report


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as temporary:
        log = write_log(Path(temporary) / options.car, CARS[options.car], options.frames, options.rate)
        print(f"{'frame':>10s}{'CPU ms':>12s}{'memory MB':>12s}", flush=True)
        told = mapped(log, options.rate, options.every, partial(print, flush=True))
        print(told.elements, told.metres)
        if told.accuracy is not None:
            print(told.accuracy)
