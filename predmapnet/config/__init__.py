"""Typed configuration of the network, the tracker and the image input; the sections have a file per subject."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Self

from pydantic import model_validator

from mapfusion.elements import RegionOfInterest
from predmapnet.config.decoder import (
    ALL_QUIRKS,
    QUIRKS_OF_BOTH,
    QUIRKS_OF_DECODER,
    QUIRKS_OF_ENCODER,
    DecoderConfig,
    FutureConfig,
    HistoryMapConfig,
    MapTrackerDecoderConfig,
    MapTrackerQuirks,
    MaskConfig,
    PointDecoderConfig,
    SemanticQueriesConfig,
)
from predmapnet.config.encoder import (
    PILLAR_SAMPLES,
    BackboneConfig,
    BevConfig,
    BevFormerConfig,
    BevMemoryConfig,
    DepthConfig,
    EncoderBevMemoryConfig,
    ImageConfig,
    ImageWindowConfig,
    LookupBevConfig,
    ResidualBevMemoryConfig,
    ResNet50Config,
    SegmentationConfig,
    SmallBackboneConfig,
    WholeImageConfig,
)
from predmapnet.config.section import Metres, Section
from predmapnet.config.tracking import RevivalConfig, TrackingConfig

__all__ = [
    "ALL_QUIRKS",
    "PILLAR_SAMPLES",
    "BackboneConfig",
    "BevConfig",
    "BevFormerConfig",
    "BevMemoryConfig",
    "DecoderConfig",
    "DepthConfig",
    "EncoderBevMemoryConfig",
    "FutureConfig",
    "HistoryMapConfig",
    "ImageConfig",
    "ImageWindowConfig",
    "LookupBevConfig",
    "MapTrackerDecoderConfig",
    "MapTrackerQuirks",
    "MaskConfig",
    "PointDecoderConfig",
    "PredMapNetConfig",
    "ResNet50Config",
    "ResidualBevMemoryConfig",
    "RevivalConfig",
    "SegmentationConfig",
    "SemanticQueriesConfig",
    "SmallBackboneConfig",
    "TrackingConfig",
    "WholeImageConfig",
]


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
