"""The single-frame stage: independent frames, no memory; teaches the network to see."""

from __future__ import annotations

from collections.abc import Iterator

import torch
from torch import Tensor

from predmapnet.config import PredMapNetConfig
from predmapnet.network.image_input import normalise_images
from predmapnet.network.predmapnet import PredMapNet
from predmapnet.network.state import FrameInputs
from predmapnet.training.data.batches import Batch
from predmapnet.training.data.draws import CROSSING_WEIGHT, Clips, TrainingScenes, step_loader
from predmapnet.training.losses.lite import frame_losses
from predmapnet.training.process_group import ProcessGroup
from predmapnet.training.settings import TrainingSettings


def frame_inputs(batch: Batch, config: PredMapNetConfig) -> FrameInputs:
    """Turn a batch of stored frames into what the network takes."""
    images = normalise_images(batch.images, config.image)
    return FrameInputs(images, batch.camera_valid, batch.ego_to_global, batch.calibration)


def roi_size(config: PredMapNetConfig) -> Tensor:
    """Length and width of the ROI, ``(2,)``, metres."""
    return torch.tensor([config.roi_length, config.roi_width])


class SingleFrameStage:
    """Losses of random frames.

    Attributes:
        name: of the stage.
        frames_per_step: frames that this process sees in one step.
    """

    name = "single"

    def __init__(
        self,
        network: PredMapNet,
        scenes: TrainingScenes,
        settings: TrainingSettings,
        processes: ProcessGroup,
    ) -> None:
        self.frames_per_step = max(1, settings.batch // processes.size)
        self._network = network
        self._settings = settings
        self._size = roi_size(network.config).to(network.device)
        self._frames = Clips(scenes, settings.augmentation, (settings.seed, 1), crossing_weight=CROSSING_WEIGHT)
        self._processes = processes

    def batches(self, first: int) -> Iterator[Batch]:
        """Yield the frames of one step after the other."""
        rank, size = self._processes.rank, self._processes.size
        for segment in step_loader(self._frames, self.frames_per_step * size, first, rank, size):
            yield segment.instants[0]

    def begin(self) -> None:
        """Train everything."""
        self._network.requires_grad_(True)

    def losses(self, step: int, batch: Batch) -> dict[str, Tensor]:
        """Return the weighted losses of one batch."""
        batch = batch.to(self._network.device)
        outputs = self._network(frame_inputs(batch, self._network.config))
        settings = self._settings
        return frame_losses(outputs, batch.targets, self._size, settings.weights, settings.costs).terms

    def state(self) -> dict[str, Tensor]:
        """Nothing is carried from step to step."""
        return {}

    def restore(self, tensors: dict[str, Tensor]) -> None:
        """Nothing to restore."""
