"""Draws of a stage, step by step: shuffled epochs of clips, made from the number of the draw alone.

Nothing depends on what was drawn before, on the number of processes, or on the workers that load: a resumed run goes
on with the same frames, and two processes see what one would have seen with the same whole batch.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import count
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch.utils.data import DataLoader, Dataset

from mapfusion.arrays import Float
from predmapnet.augmentation.frames import AugmentationSettings, augment, load_frame
from predmapnet.errors import UserError
from predmapnet.frame_cache.scene_cache import CachedFrame, TrainingScenes
from predmapnet.machine import begin_loading
from predmapnet.training.data.batches import StreamSegment, collate_frames

CROSSING_WEIGHT = 2.5
"""Times that a frame with a crossing is seen in an epoch of single frames, since crossings are rare: all of them twice,
and a random half of them a third time."""
PARTS_OF_WEIGHTS = 1024
"""Weights are multiples of one of these parts, so that their sums are exact."""


class EpochOrder:
    """Shuffled epochs without replacement, one after the other.

    An item of weight 2.5 comes twice or three times in each epoch.

    Attributes:
        draws: in an epoch.
    """

    def __init__(self, weights: Float, seed: tuple[int, ...]) -> None:
        """Choose weights ``(n,)`` of the items, and a seed. Raises UserError where an epoch would hold nothing."""
        self._weights = np.round(weights * PARTS_OF_WEIGHTS) / PARTS_OF_WEIGHTS
        self._seed = seed
        self.draws = int(self._weights.sum())
        if self.draws < 1:
            raise UserError("An epoch holds no frame. Give larger weights in --data, or more data.")
        self._last = (-1, np.zeros(0, np.int64))

    def __getitem__(self, draw: int) -> int:
        """Return the item of a draw; draws are counted over all epochs."""
        epoch, place = divmod(draw, self.draws)
        if self._last[0] != epoch:
            self._last = (epoch, self._shuffled(epoch))
        return int(self._last[1][place])

    def _shuffled(self, epoch: int) -> NDArray[np.int64]:
        generator = np.random.default_rng([*self._seed, epoch])
        items = generator.permutation(len(self._weights))
        ends = np.cumsum(self._weights[items])
        # Each item comes as often as whole numbers lie in its stretch of a line as long as all weights.
        start = generator.uniform(0.0, 1.0 - ends[-1] % 1.0)
        times = np.diff(np.floor(ends + start), prepend=0.0).astype(np.int64)
        return generator.permutation(np.repeat(items, times))


class Clips(Dataset[list[CachedFrame]]):
    """Clips of some frames, augmented: the last one comes from a shuffled epoch, the others lie before it.

    Single frames are clips of one. A clip is mirrored as a whole and has one error of the calibration; light and lost
    cameras change from frame to frame.
    """

    def __init__(
        self,
        scenes: TrainingScenes,
        augmentation: AugmentationSettings,
        seed: tuple[int, ...],
        frames: int = 1,
        span: int = 1,
        crossing_weight: float = 1.0,
    ) -> None:
        """Choose what to draw.

        Args:
            scenes, augmentation: of the frames.
            seed: of the run and of the stage.
            frames: of a clip.
            span: the others are drawn from so many frames before the last one; before the first frame of a scene, the
                first one stands in.
            crossing_weight: factor of the weight of clips that end with a crossing in sight.
        """
        self._scenes, self._augmentation, self._seed = scenes, augmentation, seed
        self._frames, self._span = frames, span
        self._index = np.array([(s, f) for s, scene in enumerate(scenes.scenes) for f in range(len(scene))])
        crossings = np.concatenate([scene.with_crossing for scene in scenes.scenes])
        weights = np.array(scenes.weights)[self._index[:, 0]] * np.where(crossings, crossing_weight, 1.0)
        self._order = EpochOrder(weights, (*seed, 0))

    def __len__(self) -> int:
        """Draws in an epoch; later draws belong to the epochs after it."""
        return self._order.draws

    def __getitem__(self, draw: int) -> list[CachedFrame]:
        """Return the frames of one clip, in time order."""
        generator = np.random.default_rng([*self._seed, 1, draw])
        scene, last = self._index[self._order[draw]].tolist()
        mirrored = bool(generator.random() < self._augmentation.mirror)
        back = generator.choice(np.arange(1, self._span + 1), self._frames - 1, replace=False)
        bump = int(generator.integers(2**32))
        numbers = sorted(max(0, last - steps) for steps in [*back.tolist(), 0])
        loaded = (load_frame(self._scenes, scene, number, mirrored) for number in numbers)
        return [augment(frame, self._augmentation, self._scenes.config.image, generator, bump) for frame in loaded]

    def name(self, draw: int) -> str:
        """Say which frame a clip ends with."""
        scene, last = self._index[self._order[draw]].tolist()
        return f"{self._scenes.scenes[scene].folder.name} frame {last}"

    def collate(self, clips: Sequence[Sequence[CachedFrame]]) -> StreamSegment:
        """Put clips side by side."""
        return StreamSegment([collate_frames(frames, self._scenes.config) for frames in zip(*clips, strict=True)])


def step_loader(
    clips: Clips, batch: int, first: int = 0, rank: int = 0, size: int = 1, workers: int = 0
) -> DataLoader[Any]:
    """Return what yields one optimiser step after the other as :class:`StreamSegment`, from step ``first`` on.

    A step has ``batch`` clips over all processes, of which this is number ``rank`` of ``size``. So many ``workers``
    load; 0 for none.
    """
    own = batch // size
    starts = (step * batch + rank * own for step in count(first))
    draws = ([*range(start, start + own)] for start in starts)
    # A generator of its own: the loader draws a seed from it, which must not change what dropout draws.
    return DataLoader(
        clips,
        batch_sampler=draws,
        collate_fn=clips.collate,
        num_workers=workers,
        # A forked one may wait for ever for what a thread of its parent (TensorBoard, torch) held just then.
        multiprocessing_context="spawn" if workers else None,
        worker_init_fn=begin_loading,
        generator=torch.Generator(),
    )
