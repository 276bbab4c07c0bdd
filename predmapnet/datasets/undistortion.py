"""Lenses with distortion: Brown-Conrady and fisheye images become images of a pinhole when they are read.

The network, the truth and the recordings know pinholes alone. A camera with a lens is described by the pinhole that its
images are turned into, and keeps the lens. Cameras without distortion have none, and cost nothing.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from mapfusion.arrays import Bool, Float
from predmapnet.errors import UserError
from predmapnet.scenes import Camera, Image

BROWN_CONRADY, KANNALA_BRANDT = "Brown-Conrady", "Kannala-Brandt"
COEFFICIENTS = {BROWN_CONRADY: (4, 5, 8, 12, 14), KANNALA_BRANDT: (4,)}
"""Numbers of coefficients that each model may have, in OpenCV's order: k1, k2, p1, p2, k3, ... and k1, k2, k3, k4."""

WIDEST = np.array([np.tan(np.radians(60.0)), np.tan(np.radians(45.0))])
"""Largest angle of a pinhole to each side, and up and down: as wide as networks have learned to see."""
MOST_PITCH = np.radians(12.0)
"""A pinhole behind a fisheye looks down by no more than this, radians, nor is it tilted to a side."""
PIXELS_AT_A_TIME = 1 << 20
"""Rays of so many pixels are held at a time."""
NARROWEST = 0.02
"""Tangent that a pinhole has at least from side to side."""


@dataclass(frozen=True, eq=False)
class Lens:
    """Lens in front of the images that are stored.

    Attributes:
        model: ``Brown-Conrady`` or ``Kannala-Brandt``.
        width, height: pixels of the stored images.
        intrinsics: ``(3, 3) float64`` of the stored images; the centre of their first pixel is at (0.5, 0.5).
        distortion: ``(k,) float64``, OpenCV's coefficients.
        turn: ``(3, 3) float64``: from the camera's own axes to those of the pinhole.
    """

    model: str
    width: int
    height: int
    intrinsics: Float
    distortion: Float
    turn: Float

    def project(self, rays: Float) -> tuple[Float, Bool]:
        """Project rays ``(n, 3)`` of the camera's own axes.

        Returns:
            ``(n, 2)`` pixels of the stored image, and which rays the lens can see at all.
        """
        matrix, nothing = self.intrinsics, np.zeros((1, 3))
        if self.model == KANNALA_BRANDT:
            # OpenCV's own function takes no ray from the side or behind.
            sine = np.linalg.norm(rays[:, :2], axis=1)
            angle = np.arctan2(sine, rays[:, 2])
            scale = _angular(angle, self.distortion) / np.maximum(sine, 1e-12)
            pixels = rays[:, :2] * scale[:, None] * matrix[[0, 1], [0, 1]] + matrix[:2, 2]
            return pixels, np.asarray(angle <= self._bending[0][-1])
        ahead = rays[:, 2] > 1e-6
        seen = np.where(ahead[:, None], rays, [0.0, 0.0, 1.0])
        pixels = cv2.projectPoints(seen, nothing, nothing, matrix, self.distortion)[0].reshape(-1, 2)
        radius = np.linalg.norm(seen[:, :2], axis=1) / seen[:, 2]
        return np.asarray(pixels, dtype=np.float64), np.asarray(ahead & (radius <= self._bending[0][-1]))

    @property
    def _bending(self) -> tuple[Float, Float]:
        """Distances from the axis at which rays enter (a fisheye: angle, else tangent) and leave, up to the fold."""
        fisheye = self.model == KANNALA_BRANDT
        offset = np.linspace(0.0, np.pi if fisheye else 5.0, 4097)
        bent = _angular(offset, self.distortion) if fisheye else _radial(offset, self.distortion)
        folded = np.flatnonzero(np.diff(bent) <= 0.0)
        end = int(folded[0]) + 1 if len(folded) else len(offset)
        return offset[:end], bent[:end]

    def unproject(self, pixels: Float) -> Float:
        """Return the rays ``(n, 3)`` of the camera's own axes that pixels ``(n, 2)`` of the stored image come from.

        They are good to some pixels: decentring is left out. Pixels that no ray reaches get the nearest one.
        """
        points = (pixels - self.intrinsics[:2, 2]) / self.intrinsics[[0, 1], [0, 1]]
        radius = np.linalg.norm(points, axis=1)
        entering, leaving = self._bending
        offset = np.interp(radius, leaving, entering)
        fisheye = self.model == KANNALA_BRANDT
        across, along = (np.sin(offset), np.cos(offset)) if fisheye else (offset, np.ones(len(offset)))
        return np.column_stack([points * (across / np.maximum(radius, 1e-12))[:, None], along])


def _angular(angle: Float, coefficients: Float) -> Float:
    """Distance from the principal point, in focal lengths, of a ray at an angle from the axis (Kannala-Brandt)."""
    square = angle**2
    k1, k2, k3, k4 = coefficients
    return np.asarray(angle * (1 + square * (k1 + square * (k2 + square * (k3 + square * k4)))))


def _radial(radius: Float, coefficients: Float) -> Float:
    """Distance from the principal point, in focal lengths, of a ray at the tangent ``radius`` (Brown-Conrady)."""
    square = radius**2
    k1, k2, _, _, k3, k4, k5, k6 = np.pad(coefficients[:8], (0, 8 - len(coefficients[:8])))
    above = 1 + square * (k1 + square * (k2 + square * k3))
    return np.asarray(radius * above / (1 + square * (k4 + square * (k5 + square * k6))))


def undistorted_camera(camera: Camera, model: str, distortion: Float, where: str) -> Camera:
    """Return the pinhole that shows what a camera with a lens sees, at most 120 degrees wide and 90 degrees high.

    It is as wide in pixels as the stored image. Behind a fisheye that looks down steeply (to park by, for example) it
    looks ahead more levelly than the lens does, as the cameras do that networks learn from.

    Args:
        camera: as it is mounted; size and intrinsics are those of the stored images.
        model, distortion: as of :class:`Lens`.
        where: file and camera, for messages.

    Raises:
        UserError: the coefficients are not those of such an image.
    """
    turn = _levelling(camera.camera_to_ego[:3, :3]) if model == KANNALA_BRANDT else np.eye(3)
    width, height = camera.width, camera.height
    lens = Lens(model, width, height, camera.intrinsics, distortion, turn)
    edges = np.array([[0, height / 2], [width, height / 2], [width / 2, 0], [width / 2, height]])
    rays = lens.unproject(edges)
    again, seen = lens.project(rays)
    if model == BROWN_CONRADY and not (seen.all() and np.abs(again - edges).max() < 0.05 * width):
        raise UserError(
            f"{where}: the distortion {distortion.tolist()} folds an image of {width} x {height} pixels before its "
            "edges. Are the coefficients those of this model, in OpenCV's order, and of images of this size?"
        )
    low, high = _extent(rays @ turn.T)
    focal = width / (high[0] - low[0])
    intrinsics = np.array([[focal, 0.0, -low[0] * focal], [0.0, focal, -low[1] * focal], [0.0, 0.0, 1.0]])
    pose = camera.camera_to_ego.copy()
    pose[:3, :3] = pose[:3, :3] @ turn.T
    height = max(1, round(focal * (high[1] - low[1])))
    return replace(camera, height=height, intrinsics=intrinsics, camera_to_ego=pose, lens=lens)


def _extent(rays: Float) -> tuple[Float, Float]:
    """Return the tangents to the left and up, and to the right and down, that the rays of the four edges leave."""
    ahead = np.maximum(rays[:, 2], 1e-9)
    tangents = rays[:, :2] / ahead[:, None]
    low = np.clip([tangents[0, 0], tangents[2, 1]], -WIDEST, WIDEST - NARROWEST)
    high = np.clip([tangents[1, 0], tangents[3, 1]], low + NARROWEST, WIDEST)
    return low, high


def _levelling(camera_to_ego: Float) -> Float:
    """Return the rotation ``(3, 3)`` from a camera's axes to those of a level camera of the same heading.

    It looks down by at most 12 degrees; a camera that looks straight down keeps its axes.
    """
    axis = camera_to_ego[:, 2]
    flat = float(np.hypot(axis[0], axis[1]))
    if flat < 0.2:
        return np.eye(3)
    pitch = np.clip(np.arctan2(-axis[2], flat), -MOST_PITCH, MOST_PITCH)
    ahead = np.array([*(axis[:2] / flat * np.cos(pitch)), -np.sin(pitch)])
    right = np.cross(ahead, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    level = np.stack([right, np.cross(ahead, right), ahead], axis=1)
    return np.asarray(level.T @ camera_to_ego)


def undistorted(image: Image, camera: Camera) -> Image:
    """Turn the stored image of a camera into that of its pinhole; what the lens does not see is black."""
    if camera.lens is None:
        return image
    table = _table(camera.lens, camera.intrinsics.tobytes(), camera.width, camera.height)
    return np.asarray(cv2.remap(image, *table, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT), dtype=np.uint8)


@lru_cache(maxsize=16)
def _table(lens: Lens, pinhole: bytes, width: int, height: int) -> tuple[NDArray[np.int16], NDArray[np.uint16]]:
    """Return where each pixel of the pinhole's image comes from, as ``cv2.remap`` takes it; made once per camera."""
    to_ray = np.linalg.inv(np.frombuffer(pinhole).reshape(3, 3))
    maps = np.empty((height, width, 2), dtype=np.float32)
    band = max(1, PIXELS_AT_A_TIME // width)
    for top in range(0, height, band):
        column, row = np.meshgrid(np.arange(width) + 0.5, np.arange(top, min(top + band, height)) + 0.5)
        rays = np.column_stack([column.ravel(), row.ravel(), np.ones(column.size)]) @ to_ray.T
        pixels, seen = lens.project(rays @ lens.turn)
        # OpenCV's pixels have their centres at whole numbers; far outside stands for unseen.
        pixels = np.where(seen[:, None], pixels - 0.5, -1e4).clip(-1e4, 3e4)
        maps[top : top + band] = pixels.reshape(*column.shape, 2)
    coarse, fine = cv2.convertMaps(maps[..., 0], maps[..., 1], cv2.CV_16SC2)
    return np.asarray(coarse, dtype=np.int16), np.asarray(fine, dtype=np.uint16)
