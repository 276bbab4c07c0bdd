"""From BEV features to polylines: the paper's modules, the map decoder, and MapTracker's oddities."""

from __future__ import annotations

from typing import Annotated, Literal, Self

from pydantic import Field, Tag, model_validator

from predmapnet.config.section import Distances, Fraction, Positive, Section, kind_of


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
    kind_of("points"),
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
