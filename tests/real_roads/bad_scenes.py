"""Scenes on a bad day: the same drive and the same truth, but worse images, cameras, clocks or poses.

The images are changed after decoding and handed on as files without loss, so that all that a mapper does with images
is under test. What a mapper is told (rig, poses) is wrong here; ``truths`` stays what is true.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from mapfusion.arrays import Float
from mapfusion.geometry import inverse_pose
from predmapnet.datasets.images import read_image
from predmapnet.datasets.own_logs.timed_poses import TimedPoses
from predmapnet.mapping import FRAMES_AHEAD
from predmapnet.scenes import Camera, Frame, Instant, Rig, Scene
from tests.real_roads.image_faults import Fault, Shot
from tests.real_roads.scene_views import ChosenFrames, SceneView, moved_rig

KEPT = FRAMES_AHEAD + 2
"""Frames whose images are kept: while one is read, others are asked for."""


def chance(scene: Scene, what: str, seed: int) -> np.random.Generator:
    """Chance that belongs to a scene and a purpose."""
    return np.random.default_rng([seed, zlib.crc32(f"{scene.info.name}/{what}".encode())])


class FaultyImages(SceneView):
    """Images that went through a fault of :mod:`tests.real_roads.image_faults`."""

    def __init__(self, scene: Scene, fault: Fault, severity: float, folder: Path, seed: int = 0) -> None:
        super().__init__(scene)
        self.fault, self.severity, self.folder, self.seed = fault, severity, folder, seed

    def frame(self, index: int) -> Frame:
        """Return the frame; its images lie in ``folder`` while those that a mapper sees ahead are asked for."""
        frame = self.scene.frame(index)
        cameras = {camera.name: camera for camera in frame.rig}
        images = {}
        for name, stored in frame.images.items():
            shot = Shot(frame.scene, index, cameras[name], self.seed)
            images[name] = self.folder / f"{name}-{index % KEPT}.png"
            image = read_image(stored) if isinstance(stored, Path) else stored
            faulty = self.fault(image, shot, self.severity)
            cv2.imwrite(str(images[name]), faulty[:, :, ::-1], [cv2.IMWRITE_PNG_COMPRESSION, 0])
        return replace(frame, images=images)


class LostCameras(SceneView):
    """Some cameras have no image at all."""

    def __init__(self, scene: Scene, cameras: tuple[str, ...]) -> None:
        super().__init__(scene)
        self.cameras = cameras

    def frame(self, index: int) -> Frame:
        frame = self.scene.frame(index)
        return replace(frame, images={name: path for name, path in frame.images.items() if name not in self.cameras})


class LostImages(SceneView):
    """A share of all images is lost at random; at least one of each frame stays."""

    def __init__(self, scene: Scene, share: float, seed: int = 0) -> None:
        super().__init__(scene)
        self.draws = chance(scene, "images", seed).uniform(size=(len(scene), len(scene.rig)))
        self.share = share

    def frame(self, index: int) -> Frame:
        frame = self.scene.frame(index)
        draws = self.draws[index]
        kept = {
            camera.name
            for camera, draw in zip(frame.rig, draws, strict=True)
            if draw >= self.share or draw == draws.max()
        }
        return replace(frame, images={name: path for name, path in frame.images.items() if name in kept})


def lost_frames(scene: Scene, share: float, seed: int = 0) -> Scene:
    """Return the scene without a share of its frames, chosen at random; the first stays."""
    draws = chance(scene, "frames", seed).uniform(size=len(scene))
    draws[0] = 1.0
    return ChosenFrames(scene, np.flatnonzero(draws >= share).tolist())


class MovedCameras(SceneView):
    """A rig that is told wrongly, in each frame as a function says: of index and rig."""

    def __init__(self, scene: Scene, told: Callable[[int, Rig], Rig]) -> None:
        super().__init__(scene)
        self.told = told

    def frame(self, index: int) -> Frame:
        frame = self.scene.frame(index)
        return replace(frame, rig=self.told(index, frame.rig))


def off_calibration(scene: Scene, degrees: float, seed: int = 0) -> Scene:
    """Return the scene with each camera told to be turned by an angle about an axis of its own, all along."""
    axes = chance(scene, "calibration", seed).normal(size=(len(scene.rig), 3))
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    turns = Rotation.from_rotvec(np.radians(degrees) * axes).as_matrix()
    of_camera = {camera.name: turn for camera, turn in zip(scene.rig, turns, strict=True)}

    def turned(camera: Camera) -> Float:
        pose = camera.camera_to_ego.copy()
        pose[:3, :3] = pose[:3, :3] @ of_camera[camera.name]
        return pose

    return MovedCameras(scene, lambda _, rig: moved_rig(rig, turned))


def late_cameras(scene: Scene, seconds: float) -> Scene:
    """Return the scene with images that are older than they are told to be.

    The car moves on by some way between exposure and time stamp, so the cameras are told to stand that way ahead of
    where they took their images. The way is that of the real drive, between key frames along a straight line.
    """
    poses = TimedPoses(
        np.array([scene.instant(index).timestamp for index in range(len(scene))], dtype=np.int64),
        np.array([scene.instant(index).ego_to_global for index in range(len(scene))]),
    )
    delay = round(seconds * 1e9)

    def told(index: int, rig: Rig) -> Rig:
        now = int(poses.timestamps[index])
        # The last frame has no successor: the way before it stands for the way after it.
        before, after = (now, now + delay) if index + 1 < len(scene) else (now - delay, now)
        ahead = inverse_pose(poses.at(before)) @ poses.at(after)
        return moved_rig(rig, lambda camera: np.asarray(ahead @ camera.camera_to_ego))

    return MovedCameras(scene, told)


class ShiftedPoses(SceneView):
    """Poses that are off by ``offsets`` ``(n, 2)`` metres, global frame."""

    def __init__(self, scene: Scene, offsets: Float) -> None:
        super().__init__(scene)
        self.offsets = offsets

    def _shifted(self, index: int, pose: Float) -> Float:
        shifted = pose.copy()
        shifted[:2, 3] += self.offsets[index]
        return shifted

    def frame(self, index: int) -> Frame:
        frame = self.scene.frame(index)
        return replace(frame, ego_to_global=self._shifted(index, frame.ego_to_global))

    def instant(self, index: int) -> Instant:
        instant = self.scene.instant(index)
        return replace(instant, ego_to_global=self._shifted(index, instant.ego_to_global))


def noisy_poses(scene: Scene, metres: float, seed: int = 0) -> Scene:
    """Return the scene with poses off by a standard deviation in each direction, every frame anew."""
    return ShiftedPoses(scene, metres * chance(scene, "poses", seed).normal(size=(len(scene), 2)))


def jumping_poses(scene: Scene, metres: float, every: int = 10, seed: int = 0) -> Scene:
    """Return the scene with poses that jump by a distance every so many frames, and stay there until the next jump."""
    random = chance(scene, "jumps", seed)
    headings = random.uniform(0.0, 2.0 * np.pi, size=len(scene) // every + 1)
    steps = np.stack([np.cos(headings), np.sin(headings)], axis=1)
    steps[0] = 0.0
    return ShiftedPoses(scene, metres * np.cumsum(steps, axis=0)[np.arange(len(scene)) // every])
