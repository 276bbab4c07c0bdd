"""Streams: consecutive frames that go on from optimiser step to optimiser step, as BEV features computed once."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch.utils.data import Dataset

from predmapnet.files import write_file
from predmapnet.frame_cache.scene_cache import CachedFrame, CachedScene
from predmapnet.network.calibration import Calibration
from predmapnet.network.state import BevFeatures
from predmapnet.scenes import FrameTruth
from predmapnet.training.data.augmentation import AugmentationSettings, disturb_pose
from predmapnet.training.data.batches import StreamSegment, collate_frames
from predmapnet.training.data.draws import EpochOrder, TrainingScenes
from predmapnet.training.data.targets import truth_targets
from predmapnet.training.settings import StreamSettings

NO_TRUTH = FrameTruth(np.zeros(0, np.int64), (), np.zeros(0, np.int64))


class FeatureStore:
    """BEV features of all frames in half precision, one file per scene, named after what is in the scene.

    Every other scene is stored mirrored, so that both hands of the world are seen.
    """

    def __init__(self, folder: Path, shapes: tuple[tuple[int, ...], ...], scenes: Sequence[CachedScene]) -> None:
        """Use a folder that belongs to the encoders, the shapes ``(C, H, W)`` of the levels, and the scenes."""
        self._shapes = shapes
        named = (f"{scene.digest()}{'-mirrored' * self.mirrored(at)}.npy" for at, scene in enumerate(scenes))
        self._paths = [folder / name for name in named]
        folder.mkdir(parents=True, exist_ok=True)

    @staticmethod
    def mirrored(scene: int) -> bool:
        """Whether a scene is stored mirrored."""
        return scene % 2 == 1

    def has(self, scene: int) -> bool:
        """Whether a scene is complete."""
        return self._paths[scene].exists()

    def write(self, scene: int, features: Sequence[BevFeatures]) -> None:
        """Store the features of all frames of a scene, in batches in their order."""
        rows = [torch.cat([level.flatten(1) for level in each.levels], 1).half().cpu() for each in features]
        with write_file(self._paths[scene]) as temporary:
            np.save(temporary, torch.cat(rows).numpy())

    def read(self, scenes: NDArray[np.int64], frames: NDArray[np.int64]) -> BevFeatures:
        """Return the features of one frame of each of several scenes."""
        files = (np.load(self._paths[scene], mmap_mode="r") for scene in scenes)
        rows = torch.from_numpy(np.stack([file[frame] for file, frame in zip(files, frames, strict=True)]))
        parts = rows.float().split([int(np.prod(shape)) for shape in self._shapes], 1)
        levels = [part.reshape(-1, *shape) for part, shape in zip(parts, self._shapes, strict=True)]
        return BevFeatures([level.contiguous(memory_format=torch.channels_last) for level in levels])


class Streams(Dataset[StreamSegment]):
    """Drives through scenes, some side by side, cut into steps; scenes come in shuffled epochs.

    Where the streams stand at a step is counted from the first step on, so any step can be the first that is asked for.
    """

    def __init__(
        self,
        scenes: TrainingScenes,
        store: FeatureStore,
        settings: StreamSettings,
        augmentation: AugmentationSettings,
        seed: tuple[int, ...],
        rank: int = 0,
        size: int = 1,
    ) -> None:
        """Choose scenes, their features, and which process of how many this is; each has streams of its own.

        ``settings`` says how many streams a process has. Of the augmentation only that of the poses counts.
        """
        self._scenes, self._store, self._settings, self._augmentation = scenes, store, settings, augmentation
        self._seed = seed
        self._own = slice(rank * settings.streams, (rank + 1) * settings.streams)
        long_enough = np.array([len(scene) >= settings.frames for scene in scenes.scenes])
        self._order = EpochOrder(np.array(scenes.weights) * long_enough, (*seed, 0))
        self._begun = 0
        # Scene, next frame, frame after the drive, and whether it begins here, of all streams at each step so far.
        self._stands = [np.zeros((4, settings.streams * size), np.int64)]

    def __getitem__(self, step: int) -> StreamSegment:
        """Return the next frames of all streams."""
        while len(self._stands) < step + 2:
            self._go_on()
        scenes, frames, ends, fresh = self._stands[step + 1][:, self._own]
        count = self._settings.frames
        generator = np.random.default_rng([*self._seed, 2, step, self._own.start])
        instants, features = [], []
        for offset in range(count):
            loaded = [self._load(scene, frame + offset) for scene, frame in zip(scenes, frames, strict=True)]
            poses = [disturb_pose(each.ego_to_global, self._augmentation, generator) for each in loaded]
            moved = [replace(each, ego_to_global=pose) for each, pose in zip(loaded, poses, strict=True)]
            instants.append(collate_frames(moved, self._scenes.config))
            features.append(self._store.read(scenes, frames + offset))
        following = [
            self._load(scene, frame + count).truth if frame + count < end else NO_TRUTH
            for scene, frame, end in zip(scenes, frames, ends, strict=True)
        ]
        config = self._scenes.config
        after = truth_targets(following, config.roi, config.decoder.points, None)
        return StreamSegment(instants, features, torch.from_numpy(fresh > 0), after)

    def name(self, step: int) -> str:
        """Say with which frames the streams of a step begin."""
        scenes, frames = self._stands[step + 1][:2, self._own].tolist()
        named = [self._scenes.scenes[scene].folder.name for scene in scenes]
        return ", ".join(f"{name} frame {frame}" for name, frame in zip(named, frames, strict=True))

    def _go_on(self) -> None:
        """Add where the streams stand a step later; where a drive is over, a new one begins."""
        count, step = self._settings.frames, len(self._stands) - 1
        scene, frame, end, _ = self._stands[-1].copy()
        frame += count if step else 0
        fresh = frame + count > end
        generator = np.random.default_rng([*self._seed, 1, step])
        grown = count + (self._settings.longest - count) * min(1.0, step / self._settings.growth_steps)
        for stream in np.flatnonzero(fresh):
            scene[stream] = self._order[self._begun]
            available = len(self._scenes.scenes[scene[stream]])
            length = min(available, int(generator.integers(count, int(grown) + 1)))
            frame[stream] = generator.integers(0, available - length + 1)
            end[stream] = frame[stream] + length
            self._begun += 1
        self._stands.append(np.stack([scene, frame, end, fresh]))

    def _load(self, scene: int, frame: int) -> CachedFrame:
        """Read a frame without images and without cameras."""
        loaded = self._scenes.load(scene, frame, self._store.mirrored(scene), images=False)
        return replace(loaded, calibration=Calibration.empty(1))
