"""Batches of one optimiser step. Every draw depends on seed, process and step only, so a resumed run repeats it."""

from __future__ import annotations

import queue
import threading
from collections.abc import Callable, Generator, Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from mapfusion.elements import ElementKind, RegionOfInterest
from predmapnet.config import PredMapNetConfig
from predmapnet.errors import UserError
from predmapnet.network.calibration import Calibration, calibrate, collate_calibrations, pad_cameras
from predmapnet.network.image_input import mirror_rig
from predmapnet.scenes import FrameTruth
from predmapnet.training.data.augmentation import (
    AugmentationSettings,
    change_light,
    drop_camera,
    mirror_images,
    mirror_pose,
    mirror_truth,
)
from predmapnet.training.data.calibration_noise import perturb_calibration
from predmapnet.training.data.scene_cache import CachedScene
from predmapnet.training.data.targets import Targets, truth_targets

Item = TypeVar("Item")

RASTER_GRID = (100, 200)
"""Rows and columns at which truth is drawn; the losses bring it to the size of what they compare."""
CROSSING_WEIGHT = 2.5
"""How much likelier a frame with a crossing is drawn: crossings are rare."""


@dataclass
class Batch:
    """Frames of ``B`` streams at one instant, of any cars; ``N`` is the largest number of cameras.

    Attributes:
        images: ``(B, N, h, w, 3) uint8``; without cameras where features are cached.
        camera_valid: ``(B, N) bool``; False for missing cameras and in padding.
        ego_to_global: ``(B, 4, 4) float64``.
        calibration: of the cameras.
        targets: truth of these frames.
        depth: ``(B, N, h', w') int64`` of :func:`~predmapnet.training.data.depth_targets.depth_targets`, or None.
    """

    images: Tensor
    camera_valid: Tensor
    ego_to_global: Tensor
    calibration: Calibration
    targets: Targets
    depth: Tensor | None = None

    def to(self, device: torch.device) -> Batch:
        """Move every tensor to ``device``."""
        return Batch(
            images=self.images.to(device),
            camera_valid=self.camera_valid.to(device),
            ego_to_global=self.ego_to_global.to(device),
            calibration=self.calibration.to(device),
            targets=self.targets.to(device),
            depth=None if self.depth is None else self.depth.to(device),
        )


@dataclass(frozen=True)
class LoadedFrame:
    """One frame of the cache after the exact augmentations.

    Attributes:
        images: ``(N, h, w, 3) uint8``; without cameras where nobody asked for them.
        ego_to_global: ``(4, 4) float64``.
        calibration: of the cameras, as a batch of one.
        truth: of the frame.
    """

    images: NDArray[np.uint8]
    ego_to_global: NDArray[np.float64]
    calibration: Calibration
    truth: FrameTruth


class TrainingScenes:
    """Cached scenes of any cars, with mirroring.

    Attributes:
        scenes: all of them; each has a rig of its own.
        frame_index: ``(n, 2) int64``: scene and frame of every frame.
        frame_probability: ``(n,)``, how often each is drawn.
    """

    def __init__(self, scenes: Sequence[CachedScene], config: PredMapNetConfig) -> None:
        if not scenes:
            raise UserError("There is no scene to train on. Choose another data set or more towns.")
        self.scenes = tuple(scenes)
        self._calibrations = [
            (calibrate(scene.rig, config), calibrate(mirror_rig(scene.rig), config)) for scene in scenes
        ]
        self.frame_index = np.array([(s, f) for s, scene in enumerate(scenes) for f in range(len(scene))])
        crossings = [ElementKind.PED_CROSSING in truth.kinds for scene in scenes for truth in scene.truths]
        weights = np.where(crossings, CROSSING_WEIGHT, 1.0)
        self.frame_probability = weights / weights.sum()

    def load(self, scene: int, frame: int, mirrored: bool, images: bool = True) -> LoadedFrame:
        """Read one frame; ``images=False`` returns an empty array in their place."""
        source, calibration = self.scenes[scene], self._calibrations[scene][int(mirrored)]
        pixels = np.array(source.images[frame]) if images else np.zeros((0, 0, 0, 3), np.uint8)
        pose, truth = source.ego_to_global[frame], source.truths[frame]
        if mirrored:
            pixels, pose, truth = mirror_images(pixels), mirror_pose(pose), mirror_truth(truth)
        return LoadedFrame(pixels, pose, calibration, truth)


class SingleFrameBatches:
    """Random frames for the single-frame stage; those with crossings come more often."""

    def __init__(
        self,
        scenes: TrainingScenes,
        batch: int,
        roi: RegionOfInterest,
        points: int,
        augmentation: AugmentationSettings,
        seed: tuple[int, ...],
    ) -> None:
        self._scenes = scenes
        self._batch = batch
        self._roi = roi
        self._points = points
        self._augmentation = augmentation
        self._seed = seed

    def __call__(self, step: int) -> Batch:
        """Return the batch of one step."""
        generator = np.random.default_rng([*self._seed, step])
        drawn = generator.choice(len(self._scenes.frame_index), self._batch, p=self._scenes.frame_probability)
        frames, images, valid, calibrations = [], [], [], []
        for scene, frame in self._scenes.frame_index[drawn]:
            mirrored = bool(generator.random() < self._augmentation.mirror)
            loaded = self._scenes.load(scene, frame, mirrored)
            frames.append(loaded)
            images.append(change_light(loaded.images, self._augmentation, generator))
            valid.append(drop_camera(len(loaded.images), self._augmentation, generator))
            calibrations.append(perturb_calibration(loaded.calibration, self._augmentation.calibration, generator))
        return Batch(
            images=pad_cameras(images),
            camera_valid=pad_cameras(valid),
            ego_to_global=torch.from_numpy(np.stack([frame.ego_to_global for frame in frames])),
            calibration=collate_calibrations(calibrations),
            targets=truth_targets([frame.truth for frame in frames], self._roi, self._points, RASTER_GRID),
        )


def prefetch(make: Callable[[int], Item], first: int, depth: int = 2) -> Generator[Item]:
    """Yield ``make(first)``, ``make(first + 1)``, ... with a thread working ahead.

    Close the iterator to stop the thread. An exception in the thread is raised here.
    """
    ready: queue.Queue[Item | BaseException] = queue.Queue(depth)
    stop = threading.Event()

    def hand_over(item: Item | BaseException) -> None:
        while not stop.is_set():
            try:
                return ready.put(item, timeout=0.2)
            except queue.Full:
                continue

    def work() -> None:
        try:
            step = first
            while not stop.is_set():
                hand_over(make(step))
                step += 1
        except BaseException as error:
            hand_over(error)

    thread = threading.Thread(target=work, daemon=True)
    thread.start()
    try:
        while True:
            item = ready.get()
            if isinstance(item, BaseException):
                raise item
            yield item
    finally:
        stop.set()
        thread.join()
