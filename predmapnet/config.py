"""One typed configuration for the network, the tracker and the image input; presets name the ones that are used."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Literal, Self

from pydantic import BaseModel, ConfigDict, Discriminator, Field, Tag, ValidationError, model_validator

from mapfusion.elements import RegionOfInterest
from predmapnet.errors import UserError

Positive = Annotated[int, Field(gt=0)]
Fraction = Annotated[float, Field(ge=0.0, le=1.0)]
Metres = Annotated[float, Field(gt=0.0)]


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


def _image_kind(value: object) -> str:
    """Tell the kind of image input; files that were written before there were two have none."""
    kind = value.get("kind", "window") if isinstance(value, Mapping) else getattr(value, "kind", "")
    return str(kind)


ImageConfig = Annotated[
    Annotated[ImageWindowConfig, Tag("window")] | Annotated[WholeImageConfig, Tag("whole")],
    Discriminator(_image_kind),
]
"""What the network sees of each camera."""


class BackboneConfig(Section):
    """A small residual network with a feature pyramid to stride 4."""

    stem: tuple[Positive, Positive] = (16, 32)
    widths: tuple[Positive, Positive, Positive] = (32, 48, 96)
    blocks: tuple[Positive, Positive, Positive] = (1, 2, 2)
    channels: Positive = 32


class BevConfig(Section):
    """The BEV grid (``rows`` x ``columns`` cells of ``H x W``) and the widths of its three levels, fine to coarse.

    The view transform looks up twice as many cells in each direction.
    """

    rows: Positive = 50
    columns: Positive = 100
    widths: tuple[Positive, Positive, Positive] = (48, 80, 128)


class TemporalBevConfig(Section):
    """Memory of past BEV maps (MapTracker's strided selection, with validity masks).

    Attributes:
        enabled: switch.
        channels: width of a stored map.
        distances: metres back; for each, the nearest stored map is used.
        capacity: number of stored maps.
        spacing: the newest map is replaced until the car has moved this far, metres.
    """

    enabled: bool = True
    channels: Positive = 16
    distances: tuple[Metres, ...] = (1.0, 5.0, 10.0, 15.0)
    capacity: Positive = 8
    spacing: Annotated[float, Field(ge=0.0)] = 2.0


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


class DecoderConfig(Section):
    """Map decoder: N_q queries of width C, N_p points each, refined by point layers."""

    queries: Positive = 40
    points: Annotated[int, Field(ge=2)] = 20
    width: Positive = 128
    heads: Positive = 8
    layers: Positive = 4
    point_width: Positive = 64
    sampling_offsets: Positive = 2
    classes: Positive = 3


class TrackingConfig(Section):
    """Which rows live on (Sec. 3.1) and how tracks and detections of one instance become one row.

    Attributes:
        query_assignment: ``one_way``: detection queries never see tracks and are trained on all of the truth;
            ``suppress``: tracks take their truth away from the detections (the paper's and MapTracker's scheme).
        tau_d: a detection scored above it is born as a track.
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


class DepthConfig(Section):
    """Auxiliary depth head (training only): depth bins over ``[near, far]`` metres."""

    enabled: bool = False
    bins: Positive = 32
    near: Metres = 1.0
    far: Metres = 45.0


class PredMapNetConfig(Section):
    """Everything that decides what the network computes.

    Example:
        >>> preset("lite").decoder.queries
        40
    """

    name: str = "lite"
    roi_length: Metres = 60.0
    roi_width: Metres = 30.0
    image: ImageConfig = ImageWindowConfig()
    backbone: BackboneConfig = BackboneConfig()
    bev: BevConfig = BevConfig()
    temporal_bev: TemporalBevConfig = TemporalBevConfig()
    semantic_queries: SemanticQueriesConfig = SemanticQueriesConfig()
    masks: MaskConfig = MaskConfig()
    history_map: HistoryMapConfig = HistoryMapConfig()
    future: FutureConfig = FutureConfig()
    decoder: DecoderConfig = DecoderConfig()
    tracking: TrackingConfig = TrackingConfig()
    revival: RevivalConfig = RevivalConfig()
    depth: DepthConfig = DepthConfig()

    @property
    def roi(self) -> RegionOfInterest:
        """The region that is mapped at one instant."""
        return RegionOfInterest(self.roi_length, self.roi_width)

    @property
    def mask_size(self) -> tuple[int, int]:
        """Rows and columns of instance masks and history maps."""
        return self.bev.rows // self.masks.stride, self.bev.columns // self.masks.stride

    def to_json(self) -> str:
        """Return the configuration as JSON, for provenance; :func:`parse_config` reads it back."""
        return self.model_dump_json()


PRESETS = {"lite": PredMapNetConfig(name="lite", future=FutureConfig(steady_motion=True))}


def preset(name: str) -> PredMapNetConfig:
    """Return a named configuration.

    Raises:
        UserError: there is no such preset.
    """
    if name not in PRESETS:
        raise UserError(f"there is no preset '{name}'; choose one of: {', '.join(sorted(PRESETS))}")
    return PRESETS[name]


def parse_config(text: str | bytes, origin: str) -> PredMapNetConfig:
    """Read a configuration from JSON.

    Args:
        text: as written by :meth:`PredMapNetConfig.to_json`; keys that are absent keep their defaults.
        origin: where the text came from, for the message.

    Raises:
        UserError: unknown keys, wrong types or values out of range, each named.
    """
    try:
        return PredMapNetConfig.model_validate_json(text)
    except ValidationError as error:
        faults = "; ".join(f"{'.'.join(map(str, fault['loc'])) or 'file'}: {fault['msg']}" for fault in error.errors())
        raise UserError(f"the configuration in {origin} does not fit: {faults}") from error


def load_config(name_or_path: str | Path) -> PredMapNetConfig:
    """Return a preset by name, or read a ``.json`` file.

    Raises:
        UserError: no such preset or file, or the file does not fit.
    """
    path = Path(name_or_path)
    if path.suffix != ".json":
        return preset(str(name_or_path))
    if not path.is_file():
        raise UserError(f"there is no configuration file {path}")
    return parse_config(path.read_bytes(), str(path))
