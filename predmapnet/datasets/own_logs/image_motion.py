"""Motion of images against calibration and poses, which shows wrong extrinsics, mirrored and turned images.

Points are followed from an image to a later one. Where the cameras were is known, so each point that stands still has a
place in space. With a right calibration nearly all of them lie in front of the camera and not below the road.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from mapfusion.arrays import Bool, Float
from mapfusion.geometry import inverse_pose
from predmapnet.datasets.images import read_camera_image
from predmapnet.datasets.own_logs.scene import LogScene
from predmapnet.scenes import Camera

PAIRS = 10
"""Pairs of images of each camera that are looked at."""
STEP = (0.4, 2.0)
"""Shortest and longest way between the images of a pair, metres."""
WIDTH = 640
"""Images are looked at in this width, pixels."""
POINTS = 400
"""Points followed in a pair, at most."""
STILL = 1.0
"""Points that move less tell nothing, pixels."""
RETURNING = 0.7
"""Largest distance between the ends of a point that is followed there and back, pixels."""
OFF_LINE, OFF_FAR_POINT = 2.0, 1.0
"""Largest distance of a point from the line on which it must move, and from where it would be if it were far away,
pixels of an image of full width."""
BELOW_ROAD = (0.5, 0.04)
"""Largest depth below the road at which points may seem to lie: metres, and metres for each metre of distance."""


@dataclass(frozen=True)
class Explanation:
    """Best explanation of the motion in images.

    Attributes:
        wrong: what is wrong then; empty if that is nothing.
        share: of the points that fit.
    """

    wrong: str
    share: float


@dataclass(frozen=True)
class _Pair:
    """Points of two images.

    Attributes:
        first, second: ``(n, 2)`` pixels of the scaled images.
        times: of the images, nanoseconds.
    """

    first: Float
    second: Float
    times: tuple[int, int]


class ImageMotion:
    """Points that were followed through images of one camera.

    Attributes:
        points: how many.
    """

    def __init__(self, log: LogScene, camera: Camera) -> None:
        """Follow them. Raises UserError for an image that cannot be read."""
        self._poses = log.poses
        self._camera = _scaled(camera)
        self._pairs = list(_pairs(log, camera, self._camera))
        self.points = sum(len(pair.first) for pair in self._pairs)

    def fitting(self, late: int = 0) -> float:
        """Return the share of points that fit, if the images are ``late`` nanoseconds later than they say."""
        return float(self._shares(_as_it_is, self._camera, late)[0])

    def explanation(self) -> Explanation:
        """Return what explains the motion best."""
        shares = {what: self._shares(change, moved) for what, change, moved in _hypotheses(self._camera)}
        # Turned over, a road is a ceiling that moves as well as any: where most points lie on the road is up.
        best = max(shares, key=lambda what: float(shares[what] @ [1.0, 0.1]))
        return Explanation(best, float(shares[best][0]))

    def _shares(self, change: Callable[[_Pair], _Pair], camera: Camera, late: int = 0) -> Float:
        """Return the shares of points that fit, and that lie on the road besides."""
        counts = [
            _fitting_and_on_road(change(pair), camera, *(self._poses.at(time + late) for time in pair.times))
            for pair in self._pairs
        ]
        return np.asarray(np.sum(counts, axis=0) / max(self.points, 1), dtype=np.float64)


def _as_it_is(pair: _Pair) -> _Pair:
    return pair


def _hypotheses(camera: Camera) -> list[tuple[str, Callable[[_Pair], _Pair], Camera]]:
    """Possible fault: its name, how points are then moved in the image, and the camera as it then sits."""
    width, height = camera.width, camera.height

    def flipped(x: bool, y: bool) -> Callable[[_Pair], _Pair]:
        scale, shift = np.where([x, y], -1.0, 1.0), np.where([x, y], [width, height], 0.0)
        return lambda pair: replace(pair, first=pair.first * scale + shift, second=pair.second * scale + shift)

    turned = camera.camera_to_ego.copy()
    turned[:2, :3] *= -1.0
    return [
        ("", _as_it_is, camera),
        ("the images are mirrored left to right", flipped(True, False), camera),
        ("the images stand on their heads", flipped(True, True), camera),
        ("the camera looks the other way", _as_it_is, replace(camera, camera_to_ego=turned)),
        (
            "camera_to_ego is the way from the car to the camera, and must be inverted",
            _as_it_is,
            replace(camera, camera_to_ego=inverse_pose(camera.camera_to_ego)),
        ),
    ]


def _scaled(camera: Camera) -> Camera:
    scale = min(1.0, WIDTH / camera.width)
    intrinsics = np.diag([scale, scale, 1.0]) @ camera.intrinsics
    return replace(
        camera, width=round(camera.width * scale), height=round(camera.height * scale), intrinsics=intrinsics
    )


def _pairs(log: LogScene, camera: Camera, small: Camera) -> Iterator[_Pair]:
    times, files = log.images[camera.name]
    rows = np.flatnonzero(log.poses.cover(times))
    if len(rows) < 2:
        return
    poses = np.array([log.poses.at(int(times[row])) for row in rows.tolist()])
    way = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1))])
    second = np.searchsorted(way, way + STEP[0])
    usable = np.flatnonzero(second < len(rows))
    usable = usable[way[second[usable]] - way[usable] <= STEP[1]]
    for start in usable[np.unique(np.linspace(0, len(usable) - 1, PAIRS).round().astype(int))] if len(usable) else []:
        ends = [int(start), int(second[start])]
        images = [_grey(read_camera_image(files[rows[end]], camera), small) for end in ends]
        first, later = _followed(*images)
        if len(first):
            yield _Pair(first, later, (int(times[rows[ends[0]]]), int(times[rows[ends[1]]])))


def _grey(image: NDArray[np.uint8], small: Camera) -> NDArray[np.uint8]:
    grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    return np.asarray(cv2.resize(grey, (small.width, small.height), interpolation=cv2.INTER_AREA), dtype=np.uint8)


def _followed(first: NDArray[np.uint8], second: NDArray[np.uint8]) -> tuple[Float, Float]:
    """Return where points of the first image are in the second, there and back; those that stand still left out."""
    seen = cv2.erode((first > 0).astype(np.uint8), np.ones((15, 15), np.uint8))  # Black is what no lens saw.
    corners = cv2.goodFeaturesToTrack(first, POINTS, 0.01, 6, mask=seen)
    start = np.zeros((0, 2)) if corners is None else np.asarray(corners, dtype=np.float64).reshape(-1, 2)
    if not len(start):
        return start, start
    end, there = _flow(first, second, start)
    again, back = _flow(second, first, end)
    kept = there & back & (np.linalg.norm(again - start, axis=1) < RETURNING)
    kept &= np.linalg.norm(end - start, axis=1) > STILL
    # OpenCV's pixels have their centres at whole numbers.
    return start[kept] + 0.5, end[kept] + 0.5


def _flow(first: NDArray[np.uint8], second: NDArray[np.uint8], start: Float) -> tuple[Float, Bool]:
    """Return where points ``(n, 2)`` of an image are in another, and which were found."""
    points = start.astype(np.float32).reshape(-1, 1, 2)
    end, found, _ = cv2.calcOpticalFlowPyrLK(first, second, points, points.copy(), winSize=(17, 17), maxLevel=4)
    return np.asarray(end, dtype=np.float64).reshape(-1, 2), np.asarray(found).ravel() > 0


def _fitting_and_on_road(pair: _Pair, camera: Camera, earlier: Float, later: Float) -> tuple[int, int]:
    """Count the points that can be ones that stand still, in front of the camera and not below the road.

    Args:
        pair: the points.
        camera: of the images.
        earlier, later: ``ego_to_global`` at their instants.

    Returns:
        How many, and how many of these lie about on the road.
    """
    to_first, to_second = earlier @ camera.camera_to_ego, later @ camera.camera_to_ego
    moved = inverse_pose(to_second) @ to_first
    to_ray = np.linalg.inv(camera.intrinsics).T
    rays, goal = (np.column_stack([points, np.ones(len(points))]) @ to_ray for points in (pair.first, pair.second))
    turned = rays @ moved[:3, :3].T
    off_axis, offset = np.cross(goal, turned), np.cross(goal, moved[:3, 3])
    depth = -(off_axis * offset).sum(axis=1) / np.maximum((off_axis**2).sum(axis=1), 1e-12)
    places = depth[:, None] * rays
    near = _pixels(turned * depth[:, None] + moved[:3, 3], camera)
    height = places @ camera.camera_to_ego[2, :3] + camera.camera_to_ego[2, 3] - camera.ground_height
    slack = BELOW_ROAD[0] + BELOW_ROAD[1] * np.linalg.norm(places, axis=1)
    scale = max(camera.width / WIDTH, 0.35)
    standing = (depth > 0.5) & (height > -slack) & (np.linalg.norm(near - pair.second, axis=1) < OFF_LINE * scale)
    far = np.linalg.norm(_pixels(turned, camera) - pair.second, axis=1) < OFF_FAR_POINT * scale
    return int((standing | far).sum()), int((standing & (np.abs(height) < slack)).sum())


def _pixels(points: Float, camera: Camera) -> Float:
    """Project points ``(n, 3)`` of the camera's frame; what lies behind it goes far away."""
    ahead = points[:, 2] > 1e-6
    projected = points @ camera.intrinsics.T
    return np.where(ahead[:, None], projected[:, :2] / np.where(ahead, points[:, 2], 1.0)[:, None], 1e9)
