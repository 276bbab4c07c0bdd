"""Training in clips: short, strided pieces of a drive, every frame of which runs the whole network (MapTracker's)."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import torch
from torch import Tensor

from predmapnet.network.predmapnet import PredMapNet
from predmapnet.training.clip_losses import ClipFrame, clip_losses
from predmapnet.training.data.batches import Batch
from predmapnet.training.data.draws import Clips, TrainingScenes, step_loader
from predmapnet.training.process_group import ProcessGroup
from predmapnet.training.settings import CLIP_STAGES, ClipStage, TrainingSettings
from predmapnet.training.single_frame import frame_inputs


class ClipTraining:
    """One stage of :data:`~predmapnet.training.settings.CLIP_STAGES` for the training loop.

    Attributes:
        name: of the stage.
        frames_per_step: frames that this process sees in one step.
    """

    def __init__(
        self,
        stage: ClipStage,
        network: PredMapNet,
        scenes: TrainingScenes,
        settings: TrainingSettings,
        processes: ProcessGroup,
    ) -> None:
        clips = max(1, settings.batch // processes.size)
        self.name = stage.name
        self.frames_per_step = clips * settings.clips.frames
        self._stage = stage
        self._network = network
        self._settings = settings
        self._rank = processes.rank
        seed, shape = (settings.seed, 3 + CLIP_STAGES.index(stage)), settings.clips
        self._clips = Clips(scenes, settings.augmentation, seed, shape.frames, shape.span)
        self._batch, self._processes = clips * processes.size, processes

    def batches(self, first: int) -> Iterator[list[Batch]]:
        """Yield the clips of one step after the other, instant by instant."""
        for segment in step_loader(self._clips, self._batch, first, self._processes.rank, self._processes.size):
            yield segment.instants

    def begin(self) -> None:
        """Freeze what the stage leaves as it is."""
        self._network.requires_grad_(True)
        for part in self._stage.frozen:
            module = getattr(self._network, part)
            if module is not None:
                module.requires_grad_(False)

    def losses(self, step: int, batch: list[Batch]) -> dict[str, Tensor]:
        """Return the weighted losses of some clips."""
        seed = np.random.default_rng([self._settings.seed, self._rank, 3, step]).integers(2**62)
        generator = torch.Generator().manual_seed(int(seed))
        clip = [clip_frame(instant, self._network) for instant in batch]
        return clip_losses(self._network, clip, self._stage, self._settings.clips, step, generator)

    def state(self) -> dict[str, Tensor]:
        """Nothing is carried from step to step."""
        return {}

    def restore(self, tensors: dict[str, Tensor]) -> None:
        """Nothing to restore."""


def clip_frame(instant: Batch, network: PredMapNet) -> ClipFrame:
    """Bring one instant to where the network is, and turn it into what it takes."""
    instant = instant.to(network.device)
    return ClipFrame(frame_inputs(instant, network.config), instant.targets, instant.depth)
