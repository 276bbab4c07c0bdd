"""From images to BEV features: image input, image backbone, BEV encoder and its memory of past maps."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, Tag

from predmapnet.config.section import Distances, Fraction, Metres, Positive, Section, kind_of
from predmapnet.datasets.nuscenes_tables import NUSCENES_CAMERAS

PILLAR_SAMPLES = 8
"""Samples of each head per camera and image level (BEVFormer); they take the points of a pillar in turns."""


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
"""What the network sees of each camera."""


class SmallBackboneConfig(Section):
    """A small residual network with a feature pyramid to stride 4."""

    kind: Literal["small"] = "small"
    stem: tuple[Positive, Positive] = (16, 32)
    widths: tuple[Positive, Positive, Positive] = (32, 48, 96)
    blocks: tuple[Positive, Positive, Positive] = (1, 2, 2)
    channels: Positive = 32


class ResNet50Config(Section):
    """ResNet-50 with deformable convolutions, and a feature pyramid at strides 8, 16 and 32.

    Attributes:
        channels: of each level of the pyramid.
    """

    kind: Literal["resnet50"] = "resnet50"
    channels: Positive = 256


BackboneConfig = Annotated[
    Annotated[SmallBackboneConfig, Tag("small")] | Annotated[ResNet50Config, Tag("resnet50")], kind_of("small")
]
"""What makes features of the images."""


class LookupBevConfig(Section):
    """A look-up of the image features on the ground, then a U-Net.

    On the road, the look-up finds twice as many cells in each direction as the grid has.

    Attributes:
        rows: of the BEV grid, along y.
        columns: of the BEV grid, along x.
        widths: channels of the three BEV levels, fine to coarse.
        further_heights: metres above the road at which each cell of the grid looks into the images once more, for
            roads that are not flat.
    """

    kind: Literal["lookup"] = "lookup"
    rows: Positive = 50
    columns: Positive = 100
    widths: tuple[Positive, Positive, Positive] = (48, 80, 128)
    further_heights: tuple[float, ...] = ()


class BevFormerConfig(Section):
    """Learned queries of the ground cells that look into the images (BEVFormer), past BEV maps included.

    Attributes:
        rows: of the BEV grid, along y.
        columns: of the BEV grid, along x.
        width: channels of the BEV features.
        cameras: their names; each has a learned code, so that a rig is put into this order.
        pillar_low: lowest of the heights at which a cell looks into the images, metres in the ego frame.
        pillar_high: highest of them.
        pillar_points: number of heights.
    """

    kind: Literal["bevformer"] = "bevformer"
    rows: Positive = 50
    columns: Positive = 100
    width: Positive = 256
    heads: Positive = 8
    layers: Positive = 2
    hidden: Positive = 512
    dropout: Fraction = 0.1
    cameras: Annotated[tuple[str, ...], Field(min_length=1)] = NUSCENES_CAMERAS
    pillar_low: float = -2.5
    pillar_high: float = 4.5
    pillar_points: Positive = 4

    @property
    def widths(self) -> tuple[int, int, int]:
        """Channels of the three BEV levels, fine to coarse."""
        return self.width, self.width, self.width


BevConfig = Annotated[
    Annotated[LookupBevConfig, Tag("lookup")] | Annotated[BevFormerConfig, Tag("bevformer")], kind_of("lookup")
]
"""The BEV grid (``rows`` x ``columns`` cells of ``H x W``) and what fills it."""


class ResidualBevMemoryConfig(Section):
    """Past BEV maps, compressed, enter the finished BEV features as a residual.

    Attributes:
        enabled: switch.
        channels: width of a stored map.
        distances: metres back; for each, the nearest stored map is used.
        capacity: number of stored maps.
        spacing: the newest map is replaced until the car has moved this far, metres.
    """

    kind: Literal["residual"] = "residual"
    enabled: bool = True
    channels: Positive = 16
    distances: Distances = (1.0, 5.0, 10.0, 15.0)
    capacity: Positive = 8
    spacing: Annotated[float, Field(ge=0.0)] = 2.0


class EncoderBevMemoryConfig(Section):
    """Past BEV maps enter the BEV encoder after each of its layers (MapTracker's BEV memory fusion).

    Attributes:
        distances: metres back at which maps are chosen.
        capacity: frames that are remembered.
    """

    kind: Literal["encoder"] = "encoder"
    distances: Distances = (1.0, 5.0, 10.0, 15.0)
    capacity: Positive = 20


BevMemoryConfig = Annotated[
    Annotated[ResidualBevMemoryConfig, Tag("residual")] | Annotated[EncoderBevMemoryConfig, Tag("encoder")],
    kind_of("residual"),
]
"""How past BEV maps are used."""


class SegmentationConfig(Section):
    """The segmentation of the ground at twice the resolution of the BEV grid.

    Attributes:
        kind: ``pixel_shuffle`` computes on the BEV grid, ``upsampling`` (MapTracker) on the finer one.
    """

    kind: Literal["pixel_shuffle", "upsampling"] = "pixel_shuffle"


class DepthConfig(Section):
    """Auxiliary depth head (training only): depth bins over ``[near, far]`` metres."""

    enabled: bool = False
    bins: Positive = 32
    near: Metres = 1.0
    far: Metres = 45.0
