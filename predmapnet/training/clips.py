"""Training in clips: short, strided pieces of a drive, every frame of which runs the whole network (MapTracker's)."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from predmapnet.config import BevFormerConfig, PredMapNetConfig
from predmapnet.network.calibration import collate_calibrations, pad_cameras
from predmapnet.network.image_input import input_size
from predmapnet.network.maptracker.reference_points import LEVEL_STRIDES
from predmapnet.network.predmapnet import PredMapNet
from predmapnet.network.small.backbone import STRIDE
from predmapnet.scenes import Rig
from predmapnet.training.clip_losses import ClipFrame, clip_losses
from predmapnet.training.data.augmentation import change_light, drop_camera
from predmapnet.training.data.batches import RASTER_GRID, Batch, TrainingScenes
from predmapnet.training.data.depth_targets import UNKNOWN, depth_targets
from predmapnet.training.data.fill_cache import window_camera
from predmapnet.training.data.targets import truth_targets
from predmapnet.training.process_group import ProcessGroup
from predmapnet.training.settings import ClipStage, TrainingSettings
from predmapnet.training.single_frame import frame_inputs


class ImageClips:
    """Draws clips: a random frame, and others from the frames before it."""

    def __init__(
        self,
        scenes: TrainingScenes,
        config: PredMapNetConfig,
        settings: TrainingSettings,
        clips: int,
        seed: tuple[int, ...],
    ) -> None:
        self._scenes = scenes
        self._config = config
        self._settings = settings
        self._clips = clips
        self._seed = seed

    def __call__(self, step: int) -> list[Batch]:
        """Return the clips of one step, instant by instant."""
        generator = np.random.default_rng([*self._seed, step])
        chosen = generator.integers(len(self._scenes.frame_index), size=self._clips)
        clips = [self._frames(int(scene), int(frame), generator) for scene, frame in self._scenes.frame_index[chosen]]
        return [self._instant(frames, generator) for frames in zip(*clips, strict=True)]

    def _frames(self, scene: int, last: int, generator: np.random.Generator) -> list[tuple[int, int]]:
        """Scene and number of each frame of a clip; before the first frame of a scene the first one stands in."""
        clip = self._settings.clips
        back = generator.choice(np.arange(1, clip.span + 1), clip.frames - 1, replace=False)
        return [(scene, max(0, last - int(steps))) for steps in sorted(back, reverse=True)] + [(scene, last)]

    def _instant(self, frames: tuple[tuple[int, int], ...], generator: np.random.Generator) -> Batch:
        augmentation, config = self._settings.augmentation, self._config
        loaded = [self._scenes.load(scene, frame, mirrored=False) for scene, frame in frames]
        images = [change_light(frame.images, augmentation, generator) for frame in loaded]
        valid = [drop_camera(len(frame.images), augmentation, generator) for frame in loaded]
        depth = None
        if config.depth.enabled:
            depth = pad_cameras([self._depth(scene, frame) for scene, frame in frames])
        return Batch(
            images=pad_cameras(images),
            camera_valid=pad_cameras(valid),
            ego_to_global=torch.from_numpy(np.stack([frame.ego_to_global for frame in loaded])),
            calibration=collate_calibrations([frame.calibration for frame in loaded]),
            targets=truth_targets([frame.truth for frame in loaded], config.roi, config.decoder.points, RASTER_GRID),
            depth=depth,
        )

    def _depth(self, scene: int, frame: int) -> np.ndarray:
        """Depth targets of one frame; cells of padding are unknown."""
        stored, config = self._scenes.scenes[scene], self._config
        assert stored.lidar is not None, "the cache of a network that learns depth holds lidar"
        rig: Rig = tuple(window_camera(camera, config) for camera in stored.rig)
        stride = LEVEL_STRIDES[0] if isinstance(config.bev, BevFormerConfig) else STRIDE
        targets = depth_targets(stored.lidar[frame].astype(np.float64), rig, stride, config.depth)
        missing = [
            -(-size // stride) - cells for size, cells in zip(input_size(config.image), targets.shape[1:], strict=True)
        ]
        return np.pad(targets, ((0, 0), (0, missing[0]), (0, missing[1])), constant_values=UNKNOWN)


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
        self.make_batch = ImageClips(scenes, network.config, settings, clips, (settings.seed, processes.rank))

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
