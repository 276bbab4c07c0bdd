"""The stages of a training as data: the paper's schedule on both data sets, and that of ``lite``.

Where the paper is silent, numbers are MapTracker's.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Literal

from predmapnet.augmentation.frames import AugmentationSettings
from predmapnet.config import BevFormerConfig, MapTrackerDecoderConfig, PredMapNetConfig
from predmapnet.datasets.argoverse2_files import ARGOVERSE2_CAMERAS
from predmapnet.errors import UserError
from predmapnet.training.losses.weights import LITE_LOSSES, PAPER_LOSSES, LossWeights


@dataclass(frozen=True)
class OptimiserSettings:
    """Settings of the optimiser and of the learning rate.

    Attributes:
        learning_rate: its peak, for the whole batch of the stage.
        betas, weight_decay: of AdamW.
        warmup_steps: until the peak is reached, on a line.
        warmup_start: part of the peak at which the line begins.
        clip_norm: largest norm of the gradient.
        decay_all: norms, biases and other single rows are decayed as well.
        average_decay: of the moving average of the weights; 0 for none.
        final_fraction: part of the peak that is left at the end.
        rates: factors of the rate, by the beginning of the parameters' names; the longest counts, and 1 for others.
    """

    learning_rate: float = 1e-3
    betas: tuple[float, float] = (0.9, 0.98)
    weight_decay: float = 0.02
    warmup_steps: int = 150
    warmup_start: float = 0.0
    clip_norm: float = 10.0
    decay_all: bool = False
    average_decay: float = 0.998
    final_fraction: float = 0.02
    rates: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class TrackRules:
    """Rules by which rows of a frame become tracks of the next one.

    Attributes:
        score: rows from it on become tracks.
        track_dropout: probability that a track is forgotten.
        state_dropout: probability that a stream forgets everything.
        false_tracks: at most this many unassigned detections per frame become tracks; None for all.
        refresh: probability that a better-scored detection replaces its track's query and points.
        capacity: most tracks of a stream, or None.
    """

    score: float = 0.4
    track_dropout: float = 0.0
    state_dropout: float = 0.0
    false_tracks: int | None = None
    refresh: float = 0.0
    capacity: int | None = None


@dataclass(frozen=True)
class Stage:
    """One stage of a training: the data, what is frozen, the rates, and the losses.

    Attributes:
        name: of the stage.
        data: single ``frames``; ``clips`` of images; or ``streams`` over BEV features that are computed once.
        epochs: how often each frame is seen; a frame of a clip counts as its last one.
        batch: frames, clips or streams of one step over all processes, for which the learning rate holds.
        frames: of one sample, which share a gradient: 1, those of a clip, or those of a stream in one step.
        per_device: those of one GPU by default; None takes ``batch`` whatever the number of devices.
        share: of a budget of minutes.
        losses: their weights.
        optimiser: rates and schedule.
        tracks: how tracks are chosen; None for a stage without.
        vectors: polylines, tracks and all of the paper's modules; otherwise segmentation and depth only.
        images: frames of a clip whose images are trained on; the others go through the image backbone without
            gradient, to save memory.
        frozen: parts of the network that do not change.
        memory_from_step: the vector memory is not used before.
        angle_noise: deviation of the Euler angles of the ego motion, radians.
        distance_noise: deviation of its x and y, metres.
        augmentation: changes to frames.
        span: the other frames of a clip are drawn from so many before its last one.
        longest: longest stream, frames; it grows from ``frames`` to this over ``growth_steps`` steps.
    """

    name: str
    data: Literal["frames", "clips", "streams"]
    epochs: int
    batch: int
    frames: int
    losses: LossWeights
    optimiser: OptimiserSettings
    per_device: int | None = None
    share: int = 1
    tracks: TrackRules | None = None
    vectors: bool = True
    images: Literal["first and last", "last", "none"] = "last"
    frozen: tuple[str, ...] = ()
    memory_from_step: int = 0
    angle_noise: float = 0.0
    distance_noise: float = 0.0
    augmentation: AugmentationSettings = field(default_factory=AugmentationSettings)
    span: int = 10
    longest: int = 40
    growth_steps: int = 400

    def trains_images(self, number: int, frames: int) -> bool:
        """Whether the images of frame ``number`` of ``frames`` are trained on."""
        first, last = self.images == "first and last" and number == 0, number == frames - 1
        return self.images != "none" and (first or last)


BEV_PARTS = ("image_backbone", "bev_encoder", "segmentation_head", "depth_head")
SLOW_IMAGES = {"image_backbone.resnet": 0.1}
SLOW_BEV = {"image_backbone": 0.5, "bev_encoder": 0.5, "bev_encoder.queries": 1.0, "segmentation_head": 0.5}
MAPTRACKER_GPUS = 8
MAPTRACKER_OPTIMISER = OptimiserSettings(
    learning_rate=5e-4,
    betas=(0.9, 0.999),
    weight_decay=0.01,
    decay_all=True,
    warmup_steps=500,
    warmup_start=1 / 3,
    clip_norm=35.0,
    average_decay=0.0,
    final_fraction=0.05,
    rates=SLOW_IMAGES,
)


MAPTRACKER_AUGMENTATION = AugmentationSettings(
    mirror=0.0,
    grid_mask=0.7,
    camera_dropout=0.0,
    bumped=0.0,
)


def _paper_stages(bev: int, warmup: int, joint: int) -> tuple[Stage, ...]:
    """Return the three stages of Sec. 4.1 with their epochs."""
    optimiser = MAPTRACKER_OPTIMISER
    first = Stage(
        name="bev",
        data="clips",
        epochs=bev,
        batch=MAPTRACKER_GPUS,
        frames=5,
        per_device=1,
        losses=PAPER_LOSSES,
        optimiser=optimiser,
        tracks=TrackRules(score=0.4),
        augmentation=MAPTRACKER_AUGMENTATION,
        angle_noise=0.08,
        distance_noise=0.25,
        vectors=False,
        images="first and last",
    )
    second = replace(first, name="warmup", epochs=warmup, batch=6 * MAPTRACKER_GPUS, per_device=6, vectors=True)
    slow = replace(optimiser, final_fraction=0.95)
    second = replace(second, images="none", frozen=BEV_PARTS, memory_from_step=500, optimiser=slow)
    third = replace(first, name="joint", epochs=joint, batch=2 * MAPTRACKER_GPUS, per_device=2, vectors=True)
    careful = replace(optimiser, final_fraction=0.003, rates={**SLOW_IMAGES, **SLOW_BEV})
    return first, second, replace(third, images="last", optimiser=careful)


NUSCENES_STAGES = _paper_stages(bev=18, warmup=6, joint=48)
ARGOVERSE2_STAGES = _paper_stages(bev=12, warmup=3, joint=20)
LITE_STAGES = (
    Stage("single", "frames", epochs=24, batch=6, frames=1, share=2, losses=LITE_LOSSES, optimiser=OptimiserSettings()),
    Stage(
        "temporal",
        "streams",
        epochs=24,
        batch=8,
        frames=2,
        losses=LITE_LOSSES,
        optimiser=OptimiserSettings(learning_rate=5e-4),
        tracks=TrackRules(0.3, track_dropout=0.12, state_dropout=0.03, false_tracks=3, refresh=0.3, capacity=40),
        frozen=("image_backbone", "bev_encoder", "depth_head"),
    ),
)


def choose_stages(config: PredMapNetConfig, name: str = "all") -> tuple[Stage, ...]:
    """Return the stages of a network in their order, or one of them. Raises UserError for another name."""
    stages: tuple[Stage, ...] = LITE_STAGES
    if isinstance(config.decoder, MapTrackerDecoderConfig):
        argoverse = isinstance(config.bev, BevFormerConfig) and config.bev.cameras == ARGOVERSE2_CAMERAS
        stages = ARGOVERSE2_STAGES if argoverse else NUSCENES_STAGES
    chosen = tuple(stage for stage in stages if name in ("all", stage.name))
    if not chosen:
        names = ", ".join(stage.name for stage in stages)
        raise UserError(f"There is no stage '{name}' for this network. Choose: {names}, all.")
    return chosen
