"""Typed configuration of the network, the tracker and the image input; the sections have a file per subject."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any

from pydantic import Field, model_validator

from mapfusion.elements import LONGEST_SIDE, RegionOfInterest
from predmapnet.config.decoder import (
    DecoderConfig,
    DecoderQuirks,
    FutureConfig,
    HistoryMapConfig,
    MapTrackerDecoderConfig,
    MaskConfig,
    PointDecoderConfig,
    SemanticQueriesConfig,
)
from predmapnet.config.encoder import (
    BevConfig,
    BevFormerConfig,
    DepthConfig,
    EncoderBevMemoryConfig,
    EncoderQuirks,
    ImageConfig,
    ImageWindowConfig,
    LookupBevConfig,
    SegmentationConfig,
    SmallBackboneConfig,
    WholeImageConfig,
)
from predmapnet.config.former_layout import in_present_layout
from predmapnet.config.section import Metres, Section
from predmapnet.config.tracking import RevivalConfig, TrackingConfig

__all__ = [
    "BevFormerConfig",
    "DecoderQuirks",
    "DepthConfig",
    "EncoderBevMemoryConfig",
    "EncoderQuirks",
    "FutureConfig",
    "HistoryMapConfig",
    "ImageConfig",
    "ImageWindowConfig",
    "LookupBevConfig",
    "MapTrackerDecoderConfig",
    "MaskConfig",
    "PointDecoderConfig",
    "PredMapNetConfig",
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
    roi_length: Annotated[Metres, Field(le=LONGEST_SIDE)] = 60.0
    roi_width: Annotated[Metres, Field(le=LONGEST_SIDE)] = 30.0
    image: ImageConfig = ImageWindowConfig()
    bev: BevConfig = LookupBevConfig()
    segmentation: SegmentationConfig = SegmentationConfig()
    semantic_queries: SemanticQueriesConfig = SemanticQueriesConfig()
    masks: MaskConfig = MaskConfig()
    history_map: HistoryMapConfig = HistoryMapConfig()
    future: FutureConfig = FutureConfig()
    decoder: DecoderConfig = PointDecoderConfig()
    tracking: TrackingConfig = TrackingConfig()
    revival: RevivalConfig = RevivalConfig()
    depth: DepthConfig = DepthConfig()

    @model_validator(mode="before")
    @classmethod
    def _read_former_layout(cls, values: Any) -> Any:
        return in_present_layout(values) if isinstance(values, Mapping) else values

    @property
    def roi(self) -> RegionOfInterest:
        """The region that is mapped at one instant."""
        return RegionOfInterest(self.roi_length, self.roi_width)

    @property
    def mask_size(self) -> tuple[int, int]:
        """Rows and columns of instance masks and history maps."""
        return self.bev.rows // self.bev.mask_stride, self.bev.columns // self.bev.mask_stride

    @property
    def mask_level(self) -> int:
        """Index of the BEV level, fine to coarse, that has the cells of the masks."""
        return self.bev.mask_stride - 1

    def to_json(self) -> str:
        """Return the configuration as JSON, for provenance; :func:`predmapnet.presets.parse_config` reads it back."""
        return self.model_dump_json()
