"""From images to BEV features: image input, image backbone, BEV encoder and its memory of past maps."""

from __future__ import annotations

from typing import Annotated, Literal, Self

from pydantic import Field, Tag, model_validator

from predmapnet.config.section import (
    AttentionSection,
    Cells,
    Distances,
    Few,
    Fraction,
    Metres,
    Positive,
    Quirks,
    Section,
    kind_of,
)
from predmapnet.datasets.nuscenes_tables import NUSCENES_CAMERAS


class ImageWindowConfig(Section):
    """The rows of each image that show the road.

    Stored images are scaled to ``width`` and a window of ``height`` rows is cut out, so that the projected horizon
    lies at ``horizon`` of the window's height (negative: above its top row); the window stays inside the image where
    the image is tall enough.

    Attributes:
        mean, deviation: of red, green and blue in the training data, 0 to 1.
    """

    kind: Literal["window"] = "window"
    width: Positive = 256
    height: Positive = 96
    horizon: float = 0.32
    mean: tuple[float, float, float] = (0.485, 0.456, 0.406)
    deviation: tuple[float, float, float] = (0.229, 0.224, 0.225)


class WholeImageConfig(Section):
    """Whole images, as MapTracker sees them; the defaults are those of its nuScenes weights.

    Each image is stretched to ``width`` x ``height``, whatever its shape (on Argoverse 2 to 608 x 608, the upright
    front camera as well), and zeros are added at the right and at the bottom to multiples of ``multiple``.

    Attributes:
        mean: of blue, green and red, 0 to 255: the order that the backbone takes. It is only subtracted.
    """

    kind: Literal["whole"] = "whole"
    width: Positive = 800
    height: Positive = 480
    multiple: Positive = 32
    mean: tuple[float, float, float] = (103.530, 116.280, 123.675)


ImageConfig = Annotated[
    Annotated[ImageWindowConfig, Tag("window")] | Annotated[WholeImageConfig, Tag("whole")], kind_of("window")
]
"""Part of each image that the network sees, and its size."""


class SmallBackboneConfig(Section):
    """A small residual network with a feature pyramid to stride 4."""

    stem: tuple[Positive, Positive] = (16, 32)
    widths: tuple[Positive, Positive, Positive] = (32, 48, 96)
    blocks: tuple[Few, Few, Few] = (1, 2, 2)
    channels: Positive = 32


class ResidualBevMemoryConfig(Section):
    """Past BEV maps, compressed, enter the finished BEV features as a residual.

    Attributes:
        enabled: switch.
        channels: width of a stored map.
        distances: metres back; for each, the nearest stored map is used.
        capacity: number of stored maps.
        spacing: the newest map is replaced until the car has moved this far, metres.
    """

    enabled: bool = True
    channels: Positive = 16
    distances: Distances = (1.0, 5.0, 10.0, 15.0)
    capacity: Positive = 8
    spacing: Annotated[float, Field(ge=0.0)] = 2.0


class EncoderBevMemoryConfig(Section):
    """Past BEV maps enter the BEV encoder after each of its layers (MapTracker's BEV memory fusion).

    Of the last ``capacity`` frames, those are chosen that lie about so many metres back.
    """

    distances: Distances = (1.0, 5.0, 10.0, 15.0)
    capacity: Positive = 20


class LookupBevConfig(Section):
    """A small image backbone, a look-up of its features on the ground, and a U-Net.

    On the road, the look-up finds twice as many cells in each direction as the grid has.

    Attributes:
        rows: of the BEV grid, along y.
        columns: of the BEV grid, along x.
        widths: channels of the three BEV levels, fine to coarse.
        further_heights: metres above the road at which each cell of the grid looks into the images once more, for
            roads that are not flat.
        mask_stride: cells of the grid per cell of the instance masks.
    """

    kind: Literal["lookup"] = "lookup"
    rows: Cells = 50
    columns: Cells = 100
    widths: tuple[Positive, Positive, Positive] = (48, 80, 128)
    further_heights: tuple[float, ...] = ()
    backbone: SmallBackboneConfig = SmallBackboneConfig()
    memory: ResidualBevMemoryConfig = ResidualBevMemoryConfig()
    mask_stride: Literal[1, 2] = 2


class EncoderQuirks(Quirks):
    """Oddities of the BEV encoder of the official MapTracker.

    Attributes:
        mirrored_self_attention: the BEV self-attention looks around the cell mirrored in y, since its reference
            points count rows from the right-hand side while the map counts them from the left.
        propagate_where_sum_is_positive: a warped history cell replaces the learned BEV query only where the sum of
            its channels is above zero, instead of everywhere where history reaches.
        endpoint_warp_grid: history is warped on a grid whose first and last cells lie on the border of the ROI, but
            sampled as if cells had their centres inside: a slight zoom at every frame.
    """

    mirrored_self_attention: bool = False
    propagate_where_sum_is_positive: bool = False
    endpoint_warp_grid: bool = False


class BevFormerConfig(AttentionSection):
    """ResNet-50, and learned queries of the ground cells that look into its three levels (BEVFormer).

    Attributes:
        rows: of the BEV grid, along y.
        columns: of the BEV grid, along x.
        width: channels of the image and of the BEV features.
        cameras: their names; each has a learned code, so that a rig is put into this order.
        pillar_low: lowest of the heights at which a cell looks into the images, metres in the ego frame.
        pillar_high: highest of them.
        pillar_points: number of heights; each head's samples take them in turns.
    """

    kind: Literal["bevformer"] = "bevformer"
    rows: Cells = 50
    columns: Cells = 100
    width: Annotated[int, Field(gt=0, le=65_536, multiple_of=2)] = 256
    heads: Few = 8
    layers: Few = 2
    hidden: Positive = 512
    dropout: Fraction = 0.1
    cameras: Annotated[tuple[str, ...], Field(min_length=1)] = NUSCENES_CAMERAS
    pillar_low: float = -2.5
    pillar_high: float = 4.5
    pillar_points: Literal[1, 2, 4, 8] = 4
    memory: EncoderBevMemoryConfig = EncoderBevMemoryConfig()
    mask_stride: Literal[1] = 1
    quirks: EncoderQuirks = EncoderQuirks()

    @model_validator(mode="after")
    def _pillars_stand_upright(self) -> Self:
        if self.pillar_low >= self.pillar_high:
            raise ValueError("pillar_low has to be below pillar_high")
        return self

    @property
    def widths(self) -> tuple[int, int, int]:
        """Channels of the three BEV levels, fine to coarse."""
        return self.width, self.width, self.width


BevConfig = Annotated[
    Annotated[LookupBevConfig, Tag("lookup")] | Annotated[BevFormerConfig, Tag("bevformer")], kind_of("lookup")
]
"""From images to the BEV grid (``rows`` x ``columns`` cells of ``H x W``), past BEV maps included."""


class SegmentationConfig(Section):
    """The segmentation of the ground at twice the resolution of the BEV grid.

    ``pixel_shuffle`` computes on the BEV grid, ``upsampling`` (MapTracker) on the finer one.
    """

    kind: Literal["pixel_shuffle", "upsampling"] = "pixel_shuffle"


class DepthConfig(Section):
    """Auxiliary depth head (training only): depth bins over ``[near, far]`` metres."""

    enabled: bool = False
    bins: Positive = 32
    near: Metres = 1.0
    far: Metres = 45.0

    @model_validator(mode="after")
    def _near_is_before_far(self) -> Self:
        if self.near >= self.far:
            raise ValueError("near has to be less than far")
        return self
