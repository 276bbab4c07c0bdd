"""One typed configuration for the network, the tracker and the image input."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from itertools import pairwise
from typing import Annotated, Literal, Self

from pydantic import AfterValidator, BaseModel, ConfigDict, Discriminator, Field, Tag, model_validator

from mapfusion.elements import RegionOfInterest
from predmapnet.datasets.nuscenes_tables import NUSCENES_CAMERAS

Positive = Annotated[int, Field(gt=0)]
Fraction = Annotated[float, Field(ge=0.0, le=1.0)]
Metres = Annotated[float, Field(gt=0.0)]


def _increasing(values: tuple[float, ...]) -> tuple[float, ...]:
    if any(far <= near for near, far in pairwise(values)):
        raise ValueError("should increase")
    return values


Distances = Annotated[tuple[Metres, ...], Field(min_length=1), AfterValidator(_increasing)]
"""Metres back, the nearest first."""

PILLAR_SAMPLES = 8
"""Samples of each head per camera and image level (BEVFormer); they take the points of a pillar in turns."""


class Section(BaseModel):
    """Base of all sections: unknown keys are refused and values do not change after construction."""

    model_config = ConfigDict(extra="forbid", frozen=True)


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


def _kind(default: str) -> Discriminator:
    """Tell sections of one name apart by their ``kind``; files that were written before there were two have none."""

    def kind(value: object) -> str:
        return str(value.get("kind", default) if isinstance(value, Mapping) else getattr(value, "kind", ""))

    return Discriminator(kind)


ImageConfig = Annotated[
    Annotated[ImageWindowConfig, Tag("window")] | Annotated[WholeImageConfig, Tag("whole")], _kind("window")
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
    Annotated[SmallBackboneConfig, Tag("small")] | Annotated[ResNet50Config, Tag("resnet50")], _kind("small")
]
"""What makes features of the images."""


class LookupBevConfig(Section):
    """A look-up of the image features on the ground, then a U-Net.

    The look-up finds twice as many cells in each direction as the grid has.

    Attributes:
        rows: of the BEV grid, along y.
        columns: of the BEV grid, along x.
        widths: channels of the three BEV levels, fine to coarse.
    """

    kind: Literal["lookup"] = "lookup"
    rows: Positive = 50
    columns: Positive = 100
    widths: tuple[Positive, Positive, Positive] = (48, 80, 128)


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
    Annotated[LookupBevConfig, Tag("lookup")] | Annotated[BevFormerConfig, Tag("bevformer")], _kind("lookup")
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
    _kind("residual"),
]
"""How past BEV maps are used."""


class SemanticQueriesConfig(Section):
    """Semantic-Aware Query Generator, Sec. 3.2; switched off, detection queries are learned only."""

    enabled: bool = True
    layers: Positive = 2
    """L of the paper."""
    mask_threshold: Fraction = 0.5
    """tau_L of eq. 1."""


class MaskConfig(Section):
    """Instance masks (eq. 3 ff.): cells per mask cell, and width of the dot product."""

    stride: Literal[1, 2] = 2
    channels: Positive = 64


class HistoryMapConfig(Section):
    """History Rasterized Map Memory (Sec. 3.3) and History-Map Guidance (Sec. 3.4)."""

    memory: bool = True
    guidance: bool = True
    beta: Fraction = 0.9
    threshold: Fraction = 0.5
    """theta of Sec. 3.4."""
    masks: Literal["decoded", "generated"] = "decoded"
    """Masks that are remembered: of the queries as the map decoder is given them (``generated``, M_L of the paper) or
    as it returns them."""

    @model_validator(mode="after")
    def _guidance_needs_memory(self) -> Self:
        if self.guidance and not self.memory:
            raise ValueError("guidance reads the memory: switch memory on, or guidance off as well")
        return self


class FutureConfig(Section):
    """Short-Term Future Guidance, Sec. 3.5."""

    enabled: bool = True
    histories: Positive = 4
    """n of the paper."""
    hidden: Positive = 256
    steady_motion: bool = False
    """The forecast starts from the last step of the car, taken once more; off, the polylines alone tell (the paper)."""


class PointDecoderConfig(Section):
    """N_q queries of width C with N_p points each, refined by layers that move every point."""

    kind: Literal["points"] = "points"
    queries: Positive = 40
    points: Annotated[int, Field(ge=2)] = 20
    width: Positive = 128
    heads: Positive = 8
    layers: Positive = 4
    point_width: Positive = 64
    sampling_offsets: Positive = 2
    classes: Literal[3] = 3


class MapTrackerDecoderConfig(Section):
    """MapTracker's decoder: N_q queries of width C whose lines of N_p points are predicted anew by every layer.

    Each track also attends to its own queries of past frames (the vector memory).

    Attributes:
        memory_distances: metres back at which past queries are chosen.
        memory_capacity: frames that are remembered.
    """

    kind: Literal["maptracker"] = "maptracker"
    queries: Positive = 100
    points: Annotated[int, Field(ge=2)] = 20
    width: Positive = 512
    heads: Positive = 8
    layers: Positive = 6
    hidden: Positive = 1024
    dropout: Fraction = 0.1
    classes: Literal[3] = 3
    memory_distances: Distances = (1.0, 5.0, 10.0, 15.0)
    memory_capacity: Positive = 20


DecoderConfig = Annotated[
    Annotated[PointDecoderConfig, Tag("points")] | Annotated[MapTrackerDecoderConfig, Tag("maptracker")],
    _kind("points"),
]
"""From queries to polylines."""


class MapTrackerQuirks(Section):
    """What the official code does oddly. Its released weights need all of it; a network trained from scratch does not.

    Attributes:
        mirrored_self_attention: the BEV self-attention looks around the cell mirrored in y, since its reference
            points count rows from the right-hand side while the map counts them from the left.
        propagate_where_sum_is_positive: a warped history cell replaces the learned BEV query only where the sum of
            its channels is above zero, instead of everywhere where history reaches.
        endpoint_warp_grid: history is warped on a grid whose first and last cells lie on the border of the ROI, but
            sampled as if cells had their centres inside: a slight zoom at every frame.
        tracks_moved_from_chosen_history: tracks are moved by the motion since the nearest BEV map that was chosen
            (at least 1 m back), although they stem from the frame before.
        norm_before_cross_attention: the decoder's second norm is fed the input of the BEV attention, not its output,
            and is left out in the first frame of a scene.
        single_precision_memory_poses: the vector memory keeps global poses in 32 bits.
    """

    mirrored_self_attention: bool = False
    propagate_where_sum_is_positive: bool = False
    endpoint_warp_grid: bool = False
    tracks_moved_from_chosen_history: bool = False
    norm_before_cross_attention: bool = False
    single_precision_memory_poses: bool = False


QUIRKS_OF_ENCODER = {"mirrored_self_attention", "propagate_where_sum_is_positive", "endpoint_warp_grid"}
QUIRKS_OF_DECODER = {"norm_before_cross_attention", "single_precision_memory_poses"}
QUIRKS_OF_BOTH = {"tracks_moved_from_chosen_history"}
ALL_QUIRKS = MapTrackerQuirks(**dict.fromkeys(MapTrackerQuirks.model_fields, True))


class TrackingConfig(Section):
    """Which rows live on (Sec. 3.1) and how tracks and detections of one instance become one row.

    Attributes:
        query_assignment: ``one_way``: detection queries never see tracks and are trained on all of the truth;
            ``suppress``: tracks take their truth away from the detections (the paper's and MapTracker's scheme).
        tau_d: a detection scored above it is born as a track.
        first_tau_d: the same in the first frame of a stream; ``tau_d`` by default.
        tau_t: a track scored above it is supported; others count a miss.
        misses_allowed: consecutive misses after which a track ends is one more than this; 0 is the paper's scheme.
        merge: merge tracks with detections and with each other.
        merge_distance: chamfer distance in metres of a track and a detection of one instance.
        duplicate_distance: chamfer distance in metres of two tracks of one instance; the older id stays.
        merge_samples: points per line for these distances.
        report_threshold: rows scored below are not reported at all.
    """

    query_assignment: Literal["one_way", "suppress"] = "one_way"
    tau_d: Fraction = 0.5
    first_tau_d: Fraction | None = None
    tau_t: Fraction = 0.3
    misses_allowed: Annotated[int, Field(ge=0)] = 6
    merge: bool = True
    merge_distance: Metres = 2.0
    duplicate_distance: Metres = 1.5
    merge_samples: Annotated[int, Field(ge=2)] = 50
    report_threshold: Fraction = 0.05


class RevivalConfig(Section):
    """Lost tracks that may come back, which the paper does not have.

    Attributes:
        enabled: switch.
        frames: k; how many frames a track may go unseen and still get its id back.
        distance: chamfer distance in metres of a lost track and a newborn one, where both could be seen.
        capacity: lost tracks remembered per stream; those that are missing for longest make room.
    """

    enabled: bool = True
    frames: Positive = 10
    distance: Metres = 2.5
    capacity: Positive = 32


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


class PredMapNetConfig(Section):
    """Everything that decides what the network computes.

    Example:
        >>> PredMapNetConfig().decoder.queries
        40
    """

    name: str = "lite"
    roi_length: Metres = 60.0
    roi_width: Metres = 30.0
    image: ImageConfig = ImageWindowConfig()
    backbone: BackboneConfig = SmallBackboneConfig()
    bev: BevConfig = LookupBevConfig()
    temporal_bev: BevMemoryConfig = ResidualBevMemoryConfig()
    segmentation: SegmentationConfig = SegmentationConfig()
    semantic_queries: SemanticQueriesConfig = SemanticQueriesConfig()
    masks: MaskConfig = MaskConfig()
    history_map: HistoryMapConfig = HistoryMapConfig()
    future: FutureConfig = FutureConfig()
    decoder: DecoderConfig = PointDecoderConfig()
    tracking: TrackingConfig = TrackingConfig()
    revival: RevivalConfig = RevivalConfig()
    depth: DepthConfig = DepthConfig()
    quirks: MapTrackerQuirks = MapTrackerQuirks()

    @model_validator(mode="after")
    def _parts_fit_together(self) -> Self:
        """Refuse parts that cannot work on each other."""
        faults = "; ".join((*_faults(self), *_bad_sizes(self)))
        if faults:
            raise ValueError(faults)
        return self

    @property
    def roi(self) -> RegionOfInterest:
        """The region that is mapped at one instant."""
        return RegionOfInterest(self.roi_length, self.roi_width)

    @property
    def mask_size(self) -> tuple[int, int]:
        """Rows and columns of instance masks and history maps."""
        return self.bev.rows // self.masks.stride, self.bev.columns // self.masks.stride

    def to_json(self) -> str:
        """Return the configuration as JSON, for provenance; :func:`predmapnet.presets.parse_config` reads it back."""
        return self.model_dump_json()


def _faults(config: PredMapNetConfig) -> Iterator[str]:
    """Name the parts that cannot work on each other."""
    bevformer = isinstance(config.bev, BevFormerConfig)
    maptracker = isinstance(config.decoder, MapTrackerDecoderConfig)
    if bevformer != isinstance(config.backbone, ResNet50Config):
        yield "bev 'bevformer' reads the three levels of backbone 'resnet50', and 'lookup' the one of 'small'"
    if bevformer != isinstance(config.temporal_bev, EncoderBevMemoryConfig):
        yield "bev 'bevformer' needs temporal_bev 'encoder', and 'lookup' needs 'residual'"
    if bevformer and config.backbone.channels != config.bev.widths[0]:
        yield "bev 'bevformer' is as wide as the image features: bev.width and backbone.channels differ"
    if bevformer and config.masks.stride != 1:
        yield "bev 'bevformer' has masks on its own grid only: set masks.stride to 1"
    if maptracker and config.tracking.query_assignment != "suppress":
        yield "decoder 'maptracker' lets detections see tracks: set tracking.query_assignment to 'suppress'"
    on = {name for name, value in config.quirks if value}
    for quirks, needed, present in (
        (QUIRKS_OF_ENCODER, "bev 'bevformer'", bevformer),
        (QUIRKS_OF_DECODER, "decoder 'maptracker'", maptracker),
        (QUIRKS_OF_BOTH, "bev 'bevformer' and decoder 'maptracker'", bevformer and maptracker),
    ):
        if on & quirks and not present:
            yield f"quirks without what they are quirks of, {needed}: {', '.join(sorted(on & quirks))}"


def _bad_sizes(config: PredMapNetConfig) -> Iterator[str]:
    """Name the sizes that no layer can be built with."""
    bev, decoder, depth = config.bev, config.decoder, config.depth
    if decoder.width % decoder.heads:
        yield "decoder.width has to be a multiple of decoder.heads"
    if isinstance(decoder, MapTrackerDecoderConfig) and decoder.width % 4:
        yield "decoder.width has to be a multiple of 4, for the code of positions"
    if isinstance(bev, BevFormerConfig):
        if bev.width % bev.heads or bev.width % 2:
            yield "bev.width has to be even and a multiple of bev.heads"
        if PILLAR_SAMPLES % bev.pillar_points:
            yield f"bev.pillar_points has to divide {PILLAR_SAMPLES}, the samples of each head"
        if bev.pillar_low >= bev.pillar_high:
            yield "bev.pillar_low has to be below bev.pillar_high"
    if depth.near >= depth.far:
        yield "depth.near has to be less than depth.far"
