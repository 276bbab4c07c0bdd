"""Streams of the temporal stage: consecutive frames that go on from optimiser step to optimiser step."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from mapfusion.elements import RegionOfInterest
from predmapnet.network.calibration import Calibration
from predmapnet.network.state import BevFeatures
from predmapnet.scenes import FrameTruth
from predmapnet.training.data.batches import RASTER_GRID, Batch, LoadedFrame, TrainingScenes
from predmapnet.training.data.targets import Targets, truth_targets
from predmapnet.training.settings import StreamSettings

NO_TRUTH = FrameTruth(np.zeros(0, np.int64), (), np.zeros(0, np.int64))


@dataclass(frozen=True)
class StreamPlan:
    """Where each stream stands, as arrays ``(B,) int64``.

    Attributes:
        scene: index of the scene.
        frame: next frame.
        end: first frame after the clip; equal to ``frame`` when the clip is over.
    """

    scene: NDArray[np.int64]
    frame: NDArray[np.int64]
    end: NDArray[np.int64]

    @classmethod
    def start(cls, streams: int) -> StreamPlan:
        """Return a plan whose streams all begin a clip next."""
        return cls(*np.zeros((3, streams), dtype=np.int64))

    def tensors(self) -> dict[str, Tensor]:
        """Return the arrays for a checkpoint."""
        return {name: torch.from_numpy(value.copy()) for name, value in vars(self).items()}


@dataclass
class StreamSegment:
    """A few consecutive frames of every stream.

    Attributes:
        instants: the frames, one batch per instant; images are absent, features stand in :attr:`features`.
        features: BEV features of each instant.
        fresh: ``(B,) bool``, streams that begin here and must forget what was before.
        after: truth of the instant after the last one; nothing for streams that end.
        plan: where the streams stand afterwards.
    """

    instants: list[Batch]
    features: list[BevFeatures]
    fresh: Tensor
    after: Targets
    plan: StreamPlan

    def to(self, device: torch.device) -> StreamSegment:
        """Move every tensor to ``device``."""
        return StreamSegment(
            instants=[instant.to(device) for instant in self.instants],
            features=[BevFeatures([level.to(device) for level in one.levels]) for one in self.features],
            fresh=self.fresh.to(device),
            after=self.after.to(device),
            plan=self.plan,
        )


class FeatureStore:
    """BEV features of all frames in half precision, one memory-mapped file per scene.

    Every other scene is stored mirrored, so that both hands of the world are seen.
    """

    def __init__(self, folder: Path, shapes: tuple[tuple[int, ...], ...]) -> None:
        self._folder = folder
        self._shapes = shapes
        self._sizes = [int(np.prod(shape)) for shape in shapes]
        self._open: dict[int, NDArray[np.float16]] = {}
        folder.mkdir(parents=True, exist_ok=True)

    @staticmethod
    def mirrored(scene: int) -> bool:
        """Whether a scene is stored mirrored."""
        return scene % 2 == 1

    def has(self, scene: int) -> bool:
        """Whether a scene is complete."""
        return self._path(scene).exists()

    @contextmanager
    def writing(self, scene: int, frames: int) -> Iterator[NDArray[np.float16]]:
        """Yield ``(frames, values)`` to fill; the file gets its name when the block succeeds."""
        partial = self._path(scene).with_suffix(".partial")
        shape = (frames, sum(self._sizes))
        values = np.lib.format.open_memmap(partial, mode="w+", dtype=np.float16, shape=shape)
        yield values
        values.flush()
        partial.rename(self._path(scene))

    def pack(self, features: BevFeatures) -> NDArray[np.float16]:
        """Flatten the features of ``B`` frames to ``(B, values)``."""
        packed: NDArray[np.float16] = torch.cat([level.flatten(1) for level in features.levels], 1).half().cpu().numpy()
        return packed

    def read(self, scenes: NDArray[np.int64], frames: NDArray[np.int64]) -> BevFeatures:
        """Return the features of one frame of each of several scenes."""
        rows = np.stack([self._scene(int(scene))[frame] for scene, frame in zip(scenes, frames, strict=True)])
        parts = torch.from_numpy(rows).split(self._sizes, 1)
        levels = [part.float().reshape(-1, *shape) for part, shape in zip(parts, self._shapes, strict=True)]
        return BevFeatures([level.contiguous(memory_format=torch.channels_last) for level in levels])

    def _scene(self, scene: int) -> NDArray[np.float16]:
        if scene not in self._open:
            self._open[scene] = np.load(self._path(scene), mmap_mode="r")
        return self._open[scene]

    def _path(self, scene: int) -> Path:
        return self._folder / f"{scene:05d}.npy"


class StreamSegments:
    """Draws clips and cuts them into steps. Must be called step after step, since streams go on."""

    def __init__(
        self,
        scenes: TrainingScenes,
        store: FeatureStore,
        settings: StreamSettings,
        roi: RegionOfInterest,
        points: int,
        seed: tuple[int, ...],
    ) -> None:
        self._scenes = scenes
        self._store = store
        self._settings = settings
        self._roi = roi
        self._points = points
        self._seed = seed
        self.plan = StreamPlan.start(settings.streams)

    def __call__(self, step: int) -> StreamSegment:
        """Return the next frames of all streams."""
        plan, fresh = self._renewed(step)
        count = self._settings.frames
        instants = [self._instant(plan, offset) for offset in range(count)]
        features = [self._store.read(plan.scene, plan.frame + offset) for offset in range(count)]
        following = [
            self._load(int(scene), int(frame) + count).truth if frame + count < end else NO_TRUTH
            for scene, frame, end in zip(plan.scene, plan.frame, plan.end, strict=True)
        ]
        self.plan = StreamPlan(plan.scene, plan.frame + count, plan.end)
        after = truth_targets(following, self._roi, self._points, None)
        return StreamSegment(instants, features, torch.from_numpy(fresh), after, self.plan)

    def _renewed(self, step: int) -> tuple[StreamPlan, NDArray[np.bool_]]:
        """Begin new clips where the old ones are over."""
        generator = np.random.default_rng([*self._seed, step])
        count = self._settings.frames
        fresh = self.plan.frame + count > self.plan.end
        scene, frame, end = self.plan.scene.copy(), self.plan.frame.copy(), self.plan.end.copy()
        for stream in np.flatnonzero(fresh):
            scene[stream] = generator.integers(len(self._scenes.scenes))
            available = len(self._scenes.scenes[scene[stream]])
            grown = count + (self._settings.longest - count) * min(1.0, step / self._settings.growth_steps)
            length = min(available, int(generator.integers(count, int(grown) + 1)))
            frame[stream] = generator.integers(0, available - length + 1)
            end[stream] = frame[stream] + length
        return StreamPlan(scene, frame, end), fresh

    def _instant(self, plan: StreamPlan, offset: int) -> Batch:
        loaded = [self._load(int(s), int(f) + offset) for s, f in zip(plan.scene, plan.frame, strict=True)]
        return Batch(
            images=torch.zeros((len(loaded), 0, 0, 0, 3), dtype=torch.uint8),
            camera_valid=torch.ones((len(loaded), 0), dtype=torch.bool),
            ego_to_global=torch.from_numpy(np.stack([frame.ego_to_global for frame in loaded])),
            calibration=Calibration.empty(len(loaded)),
            targets=truth_targets([frame.truth for frame in loaded], self._roi, self._points, RASTER_GRID),
        )

    def _load(self, scene: int, frame: int) -> LoadedFrame:
        return self._scenes.load(scene, frame, self._store.mirrored(scene), images=False)
