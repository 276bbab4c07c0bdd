"""Streams: consecutive frames that go on from optimiser step to optimiser step, as BEV features computed once."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from torch.utils.data import Dataset

from predmapnet.augmentation.frames import disturb_pose, load_frame
from predmapnet.frame_cache.scene_cache import CachedFrame, TrainingScenes
from predmapnet.network.calibration import Calibration
from predmapnet.scenes import FrameTruth
from predmapnet.training.data.batches import StreamSegment, collate_frames
from predmapnet.training.data.draws import EpochOrder
from predmapnet.training.data.targets import truth_targets
from predmapnet.training.features import FeatureStore
from predmapnet.training.settings import Stage

NO_TRUTH = FrameTruth(np.zeros(0, np.int64), (), np.zeros(0, np.int64))


class Streams(Dataset[StreamSegment]):
    """Drives through scenes, some side by side, cut into steps; scenes come in shuffled epochs.

    Where the streams stand at a step is counted from the first step on, so any step can be the first that is asked for.
    """

    def __init__(
        self,
        scenes: TrainingScenes,
        store: FeatureStore,
        stage: Stage,
        streams: int,
        seed: tuple[int, ...],
        rank: int = 0,
        size: int = 1,
    ) -> None:
        """Choose scenes, their features, and which process of how many this is; each has so many streams of its own.

        Of the augmentation only that of the poses counts.
        """
        self._scenes, self._store, self._stage, self._seed = scenes, store, stage, seed
        self._own = slice(rank * streams, (rank + 1) * streams)
        long_enough = np.array([len(scene) >= stage.frames for scene in scenes.scenes])
        self._order = EpochOrder(np.array(scenes.weights) * long_enough, (*seed, 0))
        self._begun = 0
        # Scene, next frame, frame after the drive, and whether it begins here, of all streams at each step so far.
        self._stands = [np.zeros((4, streams * size), np.int64)]

    def __getitem__(self, step: int) -> StreamSegment:
        """Return the next frames of all streams."""
        while len(self._stands) < step + 2:
            self._go_on()
        scenes, frames, ends, fresh = self._stands[step + 1][:, self._own]
        count = self._stage.frames
        generator = np.random.default_rng([*self._seed, 2, step, self._own.start])
        instants, features = [], []
        for offset in range(count):
            loaded = [self._load(scene, frame + offset) for scene, frame in zip(scenes, frames, strict=True)]
            poses = [disturb_pose(each.ego_to_global, self._stage.augmentation, generator) for each in loaded]
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
        count, step = self._stage.frames, len(self._stands) - 1
        scene, frame, end, _ = self._stands[-1].copy()
        frame += count if step else 0
        fresh = frame + count > end
        generator = np.random.default_rng([*self._seed, 1, step])
        grown = count + (self._stage.longest - count) * min(1.0, step / self._stage.growth_steps)
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
        loaded = load_frame(self._scenes, scene, frame, self._store.mirrored(scene), images=False)
        return replace(loaded, calibration=Calibration.empty(1))
