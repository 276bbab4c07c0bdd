"""Settings of a training run: stages and their budgets, clips, streams, optimisers."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Literal

from predmapnet.config import MapTrackerDecoderConfig, PredMapNetConfig
from predmapnet.errors import UserError
from predmapnet.training.data.augmentation import AugmentationSettings
from predmapnet.training.losses.lite import LossWeights
from predmapnet.training.losses.matching import MatchingCosts
from predmapnet.training.optimiser import OptimiserSettings

Report = Callable[[str], None]
"""Where lines for the user go."""

BEV_PARTS = ("image_backbone", "bev_encoder", "segmentation_head", "depth_head")


@dataclass(frozen=True)
class Budget:
    """How long a stage trains: until either limit is reached; progress is the larger part.

    Attributes:
        minutes: wall time, or None.
        steps: optimiser steps, or None.
    """

    minutes: float | None = None
    steps: int | None = None

    def progress(self, steps: int, seconds: float) -> float:
        """Return the part that is used up, 1 and more when it is over."""
        of_time = seconds / (self.minutes * 60) if self.minutes else 0.0
        of_steps = steps / self.steps if self.steps else 0.0
        return max(of_time, of_steps)


@dataclass(frozen=True)
class StreamSettings:
    """The temporal stage: streams that carry their state across optimiser steps.

    Attributes:
        streams: streams side by side in one process.
        frames: consecutive frames that share a gradient.
        longest: longest stream, frames; it grows from ``frames`` to this over ``growth_steps`` steps.
        growth_steps: see above.
        score: rows above it become tracks.
        track_dropout: probability that a track is forgotten.
        state_dropout: probability that a stream forgets everything.
        false_tracks: at most this many unassigned detections per frame become tracks.
        refresh: probability that a better-scored detection replaces its track's query and points.
        capacity: most tracks of a stream.
    """

    streams: int = 4
    frames: int = 2
    longest: int = 40
    growth_steps: int = 400
    score: float = 0.3
    track_dropout: float = 0.12
    state_dropout: float = 0.03
    false_tracks: int = 3
    refresh: float = 0.3
    capacity: int = 40


@dataclass(frozen=True)
class ClipSettings:
    """Clips, noise and weights. Those of the baseline's own losses are constants of its module.

    Attributes:
        frames: of a clip.
        span: the others are drawn from so many frames before the last one.
        track_score: rows above it after a frame are the tracks of the next.
        angle_noise: deviation of the Euler angles of the ego motion, radians.
        distance_noise: deviation of its x and y, metres.
        mask_dice, mask_entropy: lambda_dice and lambda_bce of Sec. 3.6.
        forecast: weight of L_pred, per metre; the paper names none.
        depth: weight of L_depth, as MapTRv2 has it.
    """

    frames: int = 5
    span: int = 10
    track_score: float = 0.4
    angle_noise: float = 0.08
    distance_noise: float = 0.25
    mask_dice: float = 2.0
    mask_entropy: float = 1.0
    forecast: float = 1.0
    depth: float = 3.0


@dataclass(frozen=True)
class ClipStage:
    """What one stage trains.

    Attributes:
        name: of the stage.
        epochs: of the paper on nuScenes (Sec. 4.1); they share out the time of a run.
        vectors: polylines, tracks and all of the paper's modules; otherwise segmentation and depth only.
        images: frames of a clip whose images are trained on; the others go through the image backbone without
            gradient, to save memory.
        frozen: parts of the network that do not change.
        memory_from_step: the vector memory is not used before.
        rates: factors of the learning rate, by the beginning of the parameters' names; the longest counts.
        final_rate: part of the learning rate that is left at the end.
    """

    name: str
    epochs: int
    vectors: bool = True
    images: Literal["first and last", "last", "none"] = "last"
    frozen: tuple[str, ...] = ()
    memory_from_step: int = 0
    rates: Mapping[str, float] = field(default_factory=dict)
    final_rate: float = 0.05

    def trains_images(self, number: int, frames: int) -> bool:
        """Whether the images of frame ``number`` of a clip are trained on."""
        first, last = self.images == "first and last" and number == 0, number == frames - 1
        return self.images != "none" and (first or last)


SLOW_IMAGES = {"image_backbone.resnet": 0.1}
CLIP_STAGES = (
    ClipStage("bev", 18, vectors=False, images="first and last", rates=SLOW_IMAGES),
    ClipStage("warmup", 6, images="none", frozen=BEV_PARTS, memory_from_step=500, rates=SLOW_IMAGES, final_rate=0.95),
    ClipStage(
        "joint",
        48,
        rates={**SLOW_IMAGES, "image_backbone": 0.5, "bev_encoder": 0.5, "bev_encoder.queries": 1.0}
        | {"segmentation_head": 0.5},
        final_rate=3e-3,
    ),
)
CLIP_OPTIMISER = OptimiserSettings(
    learning_rate=5e-4,
    betas=(0.9, 0.999),
    weight_decay=0.01,
    decay_all=True,
    warmup_steps=500,
    warmup_start=1 / 3,
    clip_norm=35.0,
    average_decay=0.0,
)
"""MapTracker's, which averages no weights; rates and the end come from the stage."""
SINGLE_SHARE = 2 / 3
"""Of the time of a lite run, for its single-frame stage."""


@dataclass(frozen=True)
class TrainingSettings:
    """Settings of one run.

    Attributes:
        batch: frames of one optimiser step of the single-frame stage, or clips of one step, over all processes.
        seed: of weights, draws and augmentation.
        single, temporal: budgets of the two stages of the lite network; None skips a stage.
        clip_stages: the stages of a network that trains in clips, each with its budget.
        validation_minutes, checkpoint_minutes: intervals.
        log_steps: steps between two lines of metrics.
        weights: of the losses of the lite network.
        costs: of the assignment of predictions to truth in the lite network.
        optimiser: of the single-frame stage.
        temporal_optimiser: of the temporal stage.
        augmentation: changes to the images of all stages that read images; only the single-frame stage mirrors.
        streams: of the temporal stage.
        clips: clips, noise and loss weights of the clip stages.
        clip_optimiser: of the clip stages; each stage adds its rates and its end.
    """

    batch: int = 6
    seed: int = 0
    single: Budget | None = field(default_factory=Budget)
    temporal: Budget | None = None
    clip_stages: tuple[tuple[ClipStage, Budget], ...] = ()
    validation_minutes: float = 8.0
    checkpoint_minutes: float = 3.0
    log_steps: int = 20
    weights: LossWeights = field(default_factory=LossWeights)
    costs: MatchingCosts = field(default_factory=MatchingCosts)
    optimiser: OptimiserSettings = field(default_factory=OptimiserSettings)
    temporal_optimiser: OptimiserSettings = field(default_factory=lambda: OptimiserSettings(learning_rate=5e-4))
    augmentation: AugmentationSettings = field(default_factory=AugmentationSettings)
    streams: StreamSettings = field(default_factory=StreamSettings)
    clips: ClipSettings = field(default_factory=ClipSettings)
    clip_optimiser: OptimiserSettings = CLIP_OPTIMISER


def plan_run(
    config: PredMapNetConfig,
    stage: str,
    minutes: float,
    steps: int | None,
    batch: int | None = None,
    learning_rate: float | None = None,
    seed: int = 0,
) -> TrainingSettings:
    """Share out the time of a run over the stages of a network.

    Args:
        config: of the network.
        stage: name of one, or ``all``.
        minutes: of all stages together.
        steps: limit of optimiser steps per stage, or None.
        batch: see :class:`TrainingSettings`; 6 frames or 1 clip by default.
        learning_rate: peak of the clip stages or of the single-frame stage; None takes the default.
        seed: of weights and draws.

    Raises:
        UserError: the network has no such stage.
    """
    settings = TrainingSettings(seed=seed)
    if trains_in_clips(config):
        stages = choose_clip_stages(stage)
        epochs = sum(chosen.epochs for chosen in stages)
        return replace(
            settings,
            batch=batch or 1,
            single=None,
            clip_stages=tuple((chosen, Budget(minutes * chosen.epochs / epochs, steps)) for chosen in stages),
            clip_optimiser=_with_rate(settings.clip_optimiser, learning_rate),
        )
    if stage not in ("single", "temporal", "all"):
        raise UserError(f"There is no stage '{stage}' for this network. Choose: single, temporal, all.")
    share = SINGLE_SHARE if stage == "all" else 1.0
    rest = 1 - SINGLE_SHARE if stage == "all" else 1.0
    return replace(
        settings,
        batch=batch or settings.batch,
        single=Budget(minutes * share, steps) if stage != "temporal" else None,
        temporal=Budget(minutes * rest, steps) if stage != "single" else None,
        optimiser=_with_rate(settings.optimiser, learning_rate),
    )


def _with_rate(settings: OptimiserSettings, rate: float | None) -> OptimiserSettings:
    return settings if rate is None else replace(settings, learning_rate=rate)


def trains_in_clips(config: PredMapNetConfig) -> bool:
    """Whether a network is trained in clips (MapTracker's decoder) or in the two stages of ``lite``."""
    return isinstance(config.decoder, MapTrackerDecoderConfig)


def choose_clip_stages(name: str) -> tuple[ClipStage, ...]:
    """Return one stage by name, or all of them for ``all``. Raises UserError for another name."""
    names = [stage.name for stage in CLIP_STAGES]
    if name != "all" and name not in names:
        raise UserError(f"There is no stage '{name}' for this network. Choose: {', '.join(names)}, all.")
    return tuple(stage for stage in CLIP_STAGES if name in ("all", stage.name))
