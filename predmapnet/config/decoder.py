"""From BEV features to polylines: the paper's modules and the map decoder."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, Tag

from predmapnet.config.section import AttentionSection, Distances, Few, Fraction, Positive, Quirks, Section, kind_of


class SemanticQueriesConfig(Section):
    """Semantic-Aware Query Generator, Sec. 3.2; switched off, detection queries are learned only."""

    enabled: bool = True
    layers: Few = 2
    """L of the paper."""
    mask_threshold: Fraction = 0.5
    """tau_L of eq. 1."""


class MaskConfig(Section):
    """Instance masks (eq. 3 ff.): width of the dot product."""

    channels: Positive = 64


class HistoryMapConfig(Section):
    """History Rasterized Map Memory (Sec. 3.3) and History-Map Guidance (Sec. 3.4), which reads it: none without it."""

    memory: bool = True
    guidance: bool = True
    beta: Fraction = 0.9
    threshold: Fraction = 0.5
    """theta of Sec. 3.4."""
    masks: Literal["decoded", "generated"] = "decoded"
    """Masks that are remembered: of the queries as the map decoder is given them (``generated``, M_L of the paper) or
    as it returns them."""

    @property
    def guides(self) -> bool:
        """Whether tracks look again where they have been."""
        return self.memory and self.guidance


class FutureConfig(Section):
    """Short-Term Future Guidance, Sec. 3.5."""

    enabled: bool = True
    histories: Few = 4
    """n of the paper."""
    hidden: Positive = 256
    steady_motion: bool = False
    """The forecast starts from the last step of the car, taken once more; off, the polylines alone tell (the paper)."""


class PointDecoderConfig(AttentionSection):
    """N_q queries of width C with N_p points each, refined by layers that move every point.

    Attributes:
        query_assignment: ``one_way``: detection queries never see tracks and are trained on all of the truth;
            ``suppress``: tracks take their truth away from the detections (the paper's and MapTracker's scheme).
    """

    kind: Literal["points"] = "points"
    query_assignment: Literal["one_way", "suppress"] = "one_way"
    queries: Positive = 40
    points: Annotated[int, Field(ge=2, le=1_000)] = 20
    width: Positive = 128
    heads: Few = 8
    layers: Few = 4
    point_width: Positive = 64
    sampling_offsets: Few = 2
    classes: Literal[3] = 3


class DecoderQuirks(Quirks):
    """Oddities of the decoder and the propagation of the official MapTracker.

    Attributes:
        tracks_moved_from_chosen_history: tracks are moved by the motion since the nearest BEV map that was chosen
            (at least 1 m back), although they stem from the frame before.
        norm_before_cross_attention: the decoder's second norm is fed the input of the BEV attention, not its output,
            and is left out in the first frame of a scene.
        single_precision_memory_poses: the vector memory keeps global poses in 32 bits.
    """

    tracks_moved_from_chosen_history: bool = False
    norm_before_cross_attention: bool = False
    single_precision_memory_poses: bool = False


class MapTrackerDecoderConfig(AttentionSection):
    """MapTracker's decoder: N_q queries of width C whose lines of N_p points are predicted anew by every layer.

    Each track also attends to those of its own queries, of the last ``memory_capacity`` frames, that lie about
    ``memory_distances`` metres back (the vector memory).
    """

    kind: Literal["maptracker"] = "maptracker"
    query_assignment: Literal["suppress"] = "suppress"
    queries: Positive = 100
    points: Annotated[int, Field(ge=2, le=1_000)] = 20
    width: Annotated[int, Field(gt=0, le=65_536, multiple_of=4)] = 512
    heads: Few = 8
    layers: Few = 6
    hidden: Positive = 1024
    dropout: Fraction = 0.1
    classes: Literal[3] = 3
    memory_distances: Distances = (1.0, 5.0, 10.0, 15.0)
    memory_capacity: Positive = 20
    quirks: DecoderQuirks = DecoderQuirks()


DecoderConfig = Annotated[
    Annotated[PointDecoderConfig, Tag("points")] | Annotated[MapTrackerDecoderConfig, Tag("maptracker")],
    kind_of("points"),
]
"""From queries to polylines."""
