"""Pictures of each camera with the road as calibration and poses have it: a wrong extrinsic is seen at once."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from mapfusion.arrays import Float
from mapfusion.geometry import inverse_pose
from predmapnet.datasets.images import read_camera_image
from predmapnet.datasets.own_logs.scene import LogScene
from predmapnet.errors import UserError
from predmapnet.files import write_file
from predmapnet.scenes import Camera, Frame

REACH = (30.0, 15.0)
"""The grid lies this far ahead and behind, and to each side, metres: the region that is mapped."""
SPACING = 5.0
"""Between lines of the grid, metres."""
DRIVEN = 40.0
"""The way of the car is drawn this far ahead and behind, metres."""
NEAREST = 0.5
"""Least depth of what is drawn, metres from the plane of the camera."""
GRID, AXES, WAY, HORIZON = (70, 200, 90), (40, 110, 255), (255, 210, 0), (255, 80, 200)
"""RGB of the grid, of its lines through the origin, of the car's way and of the horizon."""


def write_pictures(log: LogScene, folder: Path, problems: list[str]) -> list[Path]:
    """Write a picture of each camera that has an image in the middle of the way.

    Args:
        log: whose cameras.
        folder: to write to.
        problems: receives which images cannot be read.

    Returns:
        The files.
    """
    frame = _middle(log)
    folder.mkdir(parents=True, exist_ok=True)
    written = []
    for camera in frame.rig:
        if camera.name in frame.images:
            try:
                picture = ground_picture(log, frame, camera)
            except UserError as error:
                if str(error) not in problems:
                    problems.append(str(error))
                continue
            path = folder / f"{camera.name}.png"
            with write_file(path) as draft:
                draft.write_bytes(cv2.imencode(".png", picture[:, :, ::-1])[1].tobytes())
            written.append(path)
    return written


def _middle(log: LogScene) -> Frame:
    """Return the frame in the middle of the way, of those with the most images."""
    poses = np.array([log.instant(index).ego_to_global for index in range(len(log))])
    way = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(poses[:, :2, 3], axis=0), axis=1))])
    images = np.array([len(log.frame(index).images) for index in range(len(log))])
    fullest = np.flatnonzero(images == images.max())
    return log.frame(int(fullest[np.argmin(np.abs(way[fullest] - way[-1] / 2))]))


def ground_picture(log: LogScene, frame: Frame, camera: Camera) -> NDArray[np.uint8]:
    """Return an image of a frame, undistorted, with the grid, the way of the car and the horizon drawn in."""
    picture = np.ascontiguousarray(read_camera_image(frame.images[camera.name], camera))
    thickness = max(1, camera.width // 640)
    for line, colour in (*_grid(camera.ground_height), *((way, WAY) for way in _ways(log, frame))):
        _draw(picture, camera, line, colour, thickness)
    turn = np.radians(np.arange(0.0, 361.0, 2.0))
    far = 1e5 * np.column_stack([np.cos(turn), np.sin(turn), np.zeros(len(turn))])
    _draw(picture, camera, far, HORIZON, thickness)
    for metres in np.arange(SPACING, REACH[0] + 1, SPACING):
        for x, y in ((metres, 0.0), (-metres, 0.0), (0.0, metres), (0.0, -metres)):
            pixels = _projected(camera, np.array([[x, y, camera.ground_height]]))
            if len(pixels) and abs(y) <= REACH[1]:
                place = tuple(pixels[0].round().astype(int).tolist())
                cv2.putText(picture, f"{metres:.0f}", place, cv2.FONT_HERSHEY_SIMPLEX, 0.5 * thickness, AXES, thickness)
    return picture


def _grid(height: float) -> Iterator[tuple[Float, tuple[int, int, int]]]:
    """Yield lines ``(n, 3)`` of the ego frame on the road, and the colour of each."""
    steps = np.linspace(-1.0, 1.0, 121)
    for along, across in ((0, 1), (1, 0)):
        for offset in np.arange(-REACH[across], REACH[across] + 0.1, SPACING):
            line = np.full((len(steps), 3), height)
            line[:, along], line[:, across] = REACH[along] * steps, offset
            yield line, AXES if offset == 0.0 else GRID


def _ways(log: LogScene, frame: Frame) -> Iterator[Float]:
    """Yield where the car's own origin drove over the road, behind the frame and ahead of it, ego frame."""
    poses = log.poses.ego_to_global
    on_road = poses[:, :3, 3] + poses[:, :3, 2] * log.rig[0].ground_height
    seen = on_road @ inverse_pose(frame.ego_to_global)[:3, :3].T + inverse_pose(frame.ego_to_global)[:3, 3]
    now = int(np.searchsorted(log.poses.timestamps, frame.timestamp))
    for part in (seen[:now], seen[now:]):
        near = part[np.linalg.norm(part[:, :2], axis=1) < DRIVEN]
        if len(near) >= 2:
            yield near


def _draw(
    picture: NDArray[np.uint8], camera: Camera, line: Float, colour: tuple[int, int, int], thickness: int
) -> None:
    """Draw a line ``(n, 3)`` of the ego frame where it is seen."""
    for start, stop in pairwise(line):
        ends = _projected(camera, np.stack([start, stop]))
        if len(ends) == 2 and np.abs(ends).max() < 1e4:
            first, second = (tuple(end) for end in (16 * ends).round().astype(int).tolist())
            cv2.line(picture, first, second, colour, thickness, cv2.LINE_AA, shift=4)


def _projected(camera: Camera, points: Float) -> Float:
    """Project points ``(n, 3)`` of the ego frame to OpenCV's pixels; those that are not seen are left out."""
    rays = (points - camera.camera_to_ego[:3, 3]) @ camera.camera_to_ego[:3, :3] @ camera.intrinsics.T
    rays = rays[rays[:, 2] > NEAREST]
    return np.asarray(rays[:, :2] / rays[:, 2:] - 0.5)
