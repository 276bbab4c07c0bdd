"""How the paper's network is trained in clips: MapTracker's three stages (its Sec. 4 and configuration)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

from predmapnet.config import MapTrackerDecoderConfig, PredMapNetConfig
from predmapnet.errors import UserError

BEV_PARTS = ("image_backbone", "bev_encoder", "segmentation_head", "depth_head")


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


def trains_in_clips(config: PredMapNetConfig) -> bool:
    """Whether a network is trained in clips (MapTracker's decoder) or in the two stages of ``lite``."""
    return isinstance(config.decoder, MapTrackerDecoderConfig)


def choose_clip_stages(name: str) -> tuple[ClipStage, ...]:
    """Return one stage by name, or all of them for ``all``. Raises UserError for another name."""
    names = [stage.name for stage in CLIP_STAGES]
    if name != "all" and name not in names:
        raise UserError(f"There is no stage '{name}' for this network. Choose: {', '.join(names)}, all.")
    return tuple(stage for stage in CLIP_STAGES if name in ("all", stage.name))
