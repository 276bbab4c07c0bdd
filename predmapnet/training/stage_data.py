"""Data of a stage as one process sees them, step after step."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import count
from zlib import crc32

from predmapnet.frame_cache.scene_cache import TrainingScenes
from predmapnet.training.data.batches import StreamSegment
from predmapnet.training.data.draws import CROSSING_WEIGHT, Clips, step_loader
from predmapnet.training.data.streams import Streams
from predmapnet.training.features import FeatureStore
from predmapnet.training.plan import PlannedStage


class StageData:
    """Segments of frames, each of which is seen at once; a step takes as many as it has parts."""

    def __init__(
        self,
        planned: PlannedStage,
        scenes: TrainingScenes,
        seed: int,
        rank: int = 0,
        size: int = 1,
        workers: int = 0,
        store: FeatureStore | None = None,
    ) -> None:
        """Choose a stage, its scenes, which process of how many, and for streams where their features are."""
        stage, seeds = planned.stage, (seed, crc32(planned.stage.name.encode()))
        self._batch, self._place, self._workers = planned.batch // planned.parts, (rank, size), workers
        if store is not None:
            self._drawn: Streams | Clips = Streams(scenes, store, stage, planned.share, seeds, rank, size)
        else:
            crossings = CROSSING_WEIGHT if stage.data == "frames" else 1.0
            self._drawn = Clips(scenes, stage.augmentation, seeds, stage.frames, stage.span, crossings)

    def segments(self, first: int) -> Iterator[StreamSegment]:
        """Yield them without an end, from number ``first`` on."""
        if isinstance(self._drawn, Streams):
            return map(self._drawn.__getitem__, count(first))
        return iter(step_loader(self._drawn, self._batch, first, *self._place, self._workers))

    def name(self, number: int) -> str:
        """Say which frames a segment holds."""
        if isinstance(self._drawn, Streams):
            return self._drawn.name(number)
        rank, size = self._place
        own = self._batch // size
        first = number * self._batch + rank * own
        return ", ".join(self._drawn.name(draw) for draw in range(first, first + own))
