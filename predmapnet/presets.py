"""The configurations that are used, by name, and configurations in files."""

from __future__ import annotations

from pathlib import Path

from pydantic import ValidationError

from predmapnet.config import (
    BevFormerConfig,
    DecoderQuirks,
    DepthConfig,
    EncoderQuirks,
    FutureConfig,
    HistoryMapConfig,
    ImageWindowConfig,
    LookupBevConfig,
    MapTrackerDecoderConfig,
    MaskConfig,
    PredMapNetConfig,
    RevivalConfig,
    SegmentationConfig,
    SemanticQueriesConfig,
    TrackingConfig,
    WholeImageConfig,
)
from predmapnet.datasets.argoverse2_files import ARGOVERSE2_CAMERAS
from predmapnet.datasets.nuscenes_tables import NUSCENES_CAMERAS
from predmapnet.errors import UserError


def _maptracker(name: str, image: WholeImageConfig, cameras: tuple[str, ...]) -> PredMapNetConfig:
    """Return the baseline: none of the paper's modules, and the sizes and thresholds of the released weights."""
    return PredMapNetConfig(
        name=name,
        image=image,
        bev=BevFormerConfig(cameras=cameras, quirks=EncoderQuirks.official()),
        segmentation=SegmentationConfig(kind="upsampling"),
        semantic_queries=SemanticQueriesConfig(enabled=False),
        masks=MaskConfig(channels=256),
        history_map=HistoryMapConfig(memory=False, guidance=False),
        future=FutureConfig(enabled=False),
        decoder=MapTrackerDecoderConfig(quirks=DecoderQuirks.official()),
        revival=RevivalConfig(enabled=False),
        tracking=TrackingConfig(
            tau_d=0.6,
            first_tau_d=0.4,
            tau_t=0.5,
            misses_allowed=0,
            merge=False,
            report_threshold=0.0,
        ),
    )


def _paper(name: str, baseline: PredMapNetConfig) -> PredMapNetConfig:
    """Return the whole network of the paper on a baseline, with the hyperparameters of Sec. 4.1.

    The paper does not tell L; three layers visit each BEV level once. The quirks stay, since the network starts from
    the baseline's weights.
    """
    changes = {
        "name": name,
        "semantic_queries": SemanticQueriesConfig(layers=3),
        "history_map": HistoryMapConfig(masks="generated"),
        "future": FutureConfig(hidden=512),
        "tracking": baseline.tracking.model_copy(update={"tau_d": 0.4, "first_tau_d": None}),
        "depth": DepthConfig(enabled=True, bins=68, far=35.0),
    }
    return baseline.model_copy(update=changes)


_NUSCENES = _maptracker("maptracker-nuscenes", WholeImageConfig(), NUSCENES_CAMERAS)
_ARGOVERSE2 = _maptracker("maptracker-av2", WholeImageConfig(width=608, height=608), ARGOVERSE2_CAMERAS)
PRESETS = {
    config.name: config
    for config in (
        PredMapNetConfig(
            name="lite",
            image=ImageWindowConfig(width=384, height=144),
            bev=LookupBevConfig(further_heights=(-0.5, 0.5)),
            future=FutureConfig(steady_motion=True),
        ),
        _paper("paper-nuscenes", _NUSCENES),
        _paper("paper-av2", _ARGOVERSE2),
        _NUSCENES,
        _ARGOVERSE2,
    )
}


def preset(name: str) -> PredMapNetConfig:
    """Return a named configuration; raises UserError where there is none of that name."""
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
        faults = "; ".join(_said(_place(fault["loc"]), fault["msg"]) for fault in error.errors())
        raise UserError(f"the configuration in {origin} does not fit: {faults}") from error


def _said(place: str, message: str) -> str:
    message = message.removeprefix("Value error, ")
    return f"{place}: {message}" if place else message


def _place(location: tuple[int | str, ...]) -> str:
    """Name a key as the file has it: pydantic puts a section's kind behind the section's name."""
    kinds = {"image", "bev", "decoder"}
    return ".".join(str(part) for at, part in enumerate(location) if at != 1 or location[0] not in kinds)


def load_config(name_or_path: str | Path) -> PredMapNetConfig:
    """Return a preset by name, or read a ``.json`` file; raises UserError where there is none, or it does not fit."""
    path = Path(name_or_path)
    if path.suffix.lower() != ".json":
        return preset(str(name_or_path))
    if not path.is_file():
        raise UserError(f"there is no configuration file {path}")
    return parse_config(path.read_bytes(), str(path))
