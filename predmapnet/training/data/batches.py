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
from predmapnet.errors import UserError
from predmapnet.network.image_input import mirror_order
from predmapnet.scenes import FrameTruth
from predmapnet.training.data.augmentation import (
    AugmentationSettings,
    change_light,
    drop_camera,
    mirror_images,
    mirror_pose,
    mirror_truth,
)
from predmapnet.training.data.scene_cache import CachedScene, same_rig
from predmapnet.training.data.targets import Targets, truth_targets

Item = TypeVar("Item")

RASTER_GRID = (100, 200)
"""Rows and columns at which truth is drawn; the losses bring it to the size of what they compare."""
CROSSING_WEIGHT = 2.5
"""How much likelier a frame with a crossing is drawn: crossings are rare."""


@dataclass
class Batch:
    """Frames of ``B`` streams at one instant.

    Attributes:
        images: ``(B, N, h, w, 3) uint8``, or without rows where features are cached.
        camera_valid: ``(B, N) bool``.
        ego_to_global: ``(B, 4, 4) float64``.
        targets: truth of these frames.
        depth: ``(B, N, h', w') int64`` of :func:`~predmapnet.training.data.depth_targets.depth_targets`, or None.
    """

    images: Tensor
    camera_valid: Tensor
    ego_to_global: Tensor
    targets: Targets
    depth: Tensor | None = None

    def to(self, device: torch.device) -> Batch:
        """Move every tensor to ``device``."""
        return Batch(
            images=self.images.to(device),
            camera_valid=self.camera_valid.to(device),
            ego_to_global=self.ego_to_global.to(device),
            targets=self.targets.to(device),
            depth=None if self.depth is None else self.depth.to(device),
        )


@dataclass(frozen=True)
class LoadedFrame:
    """One frame of the cache after the exact augmentations."""

    images: NDArray[np.uint8]
    ego_to_global: NDArray[np.float64]
    truth: FrameTruth


class TrainingScenes:
    """The cached scenes of one data set and rig, with mirroring.

    Attributes:
        scenes: all of one rig.
        can_mirror: whether the rig is symmetric.
    """

    def __init__(self, scenes: Sequence[CachedScene]) -> None:
        if not scenes:
            raise UserError("There is no scene to train on. Choose another data set or more towns.")
        other = next((scene for scene in scenes if not same_rig(scene.rig, scenes[0].rig)), None)
        if other is not None:
            raise UserError(
                f"Scenes {scenes[0].name} and {other.name} have different cameras; a run trains on one rig at a time."
            )
        self.scenes = tuple(scenes)
        self._mirror_order = mirror_order(scenes[0].rig)
        self.can_mirror = self._mirror_order is not None
        self.frame_index = np.array([(s, f) for s, scene in enumerate(scenes) for f in range(len(scene))])
        crossings = [ElementKind.PED_CROSSING in truth.kinds for scene in scenes for truth in scene.truths]
        weights = np.where(crossings, CROSSING_WEIGHT, 1.0)
        self.frame_probability = weights / weights.sum()

    def load(self, scene: int, frame: int, mirrored: bool, images: bool = True) -> LoadedFrame:
        """Read one frame; ``images=False`` returns an empty array in their place."""
        source = self.scenes[scene]
        pixels = np.array(source.images[frame]) if images else np.zeros((0, 0, 0, 3), np.uint8)
        if not mirrored or self._mirror_order is None:
            return LoadedFrame(pixels, source.ego_to_global[frame], source.truths[frame])
        pixels = mirror_images(pixels, self._mirror_order) if images else pixels
        return LoadedFrame(pixels, mirror_pose(source.ego_to_global[frame]), mirror_truth(source.truths[frame]))


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
        frames, images, valid = [], [], []
        for scene, frame in self._scenes.frame_index[drawn]:
            mirrored = self._scenes.can_mirror and generator.random() < self._augmentation.mirror
            loaded = self._scenes.load(scene, frame, mirrored)
            frames.append(loaded)
            images.append(change_light(loaded.images, self._augmentation, generator))
            valid.append(drop_camera(len(loaded.images), self._augmentation, generator))
        return Batch(
            images=torch.from_numpy(np.stack(images)),
            camera_valid=torch.from_numpy(np.stack(valid)),
            ego_to_global=torch.from_numpy(np.stack([frame.ego_to_global for frame in frames])),
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
