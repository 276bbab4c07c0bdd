"""Import of MapTracker's official checkpoints; nothing in the file is executed."""

from __future__ import annotations

import pickle
import zipfile
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path

import torch
from torch import Tensor

from predmapnet.config import BevFormerConfig, MapTrackerDecoderConfig, PredMapNetConfig
from predmapnet.datasets.argoverse2_files import ARGOVERSE2_CAMERAS
from predmapnet.datasets.nuscenes_tables import NUSCENES_CAMERAS
from predmapnet.errors import UserError
from predmapnet.network.predmapnet import PredMapNet
from predmapnet.presets import PRESETS, preset
from predmapnet.weights.fit import is_finite
from predmapnet.weights.maptracker_names import name_here, original_of_alias

BEGINNINGS = (b"PK", b"\x80\x02", b"\x80\x04", b"\x80\x05")
"""Of files that torch or pickle have written."""

BASELINES = {
    len(NUSCENES_CAMERAS): preset("maptracker-nuscenes"),
    len(ARGOVERSE2_CAMERAS): preset("maptracker-av2"),
}
"""MapTracker as released, by its number of cameras."""

CAMERA_CODE = "bev_encoder.camera_code"
_SHOWN_NAMES = 4


@dataclass
class ImportReport:
    """Treatment of each entry of an official state dict.

    Attributes:
        mapped: official name to name here.
        ignored: official name to the reason.
        missing: names here that the file does not fill, and which can do without.
        fresh: names of the paper's modules, which MapTracker does not have: initialised at random.
    """

    mapped: dict[str, str] = field(default_factory=dict)
    ignored: dict[str, str] = field(default_factory=dict)
    missing: list[str] = field(default_factory=list)
    fresh: list[str] = field(default_factory=list)

    def remarks(self) -> list[str]:
        """Say what was ignored and what is missing, a line per reason."""
        repetitions = "repetitions of a branch that all decoder layers share"
        reasons = Counter(repetitions if reason.startswith("repeats") else reason for reason in self.ignored.values())
        lines = [f"{count} ignored: {reason}" for reason, count in reasons.items()]
        if self.missing:
            lines.append(f"{len(self.missing)} missing that inference does without (counters of batches)")
        return lines


def read_official_checkpoint(path: Path) -> dict[str, Tensor]:
    """Read the state dict of an official checkpoint.

    Args:
        path: ``.pth`` as mmcv writes it (with the entry ``state_dict``), or a bare state dict.

    Raises:
        UserError: there is no such file, it is damaged, it holds no state dict, or it holds objects that would have
            to be executed to be read.
    """
    if not path.is_file():
        raise UserError(f"There is no file {path}.")
    _check_packing(path)
    try:
        content = torch.load(path, map_location="cpu", weights_only=True)
    except pickle.UnpicklingError:
        if _beginning(path) in BEGINNINGS:
            raise UserError(_not_only_tensors(path)) from None
        raise UserError(f"{path} is not a whole PyTorch checkpoint. Fetch it again.") from None
    except Exception as error:  # a damaged file may raise anything while its objects are put together
        raise UserError(f"{path} is not a whole PyTorch checkpoint ({_first_line(error)}). Fetch it again.") from None
    state = content.get("state_dict", content) if isinstance(content, Mapping) else None
    if not isinstance(state, Mapping) or not state or not all(isinstance(value, Tensor) for value in state.values()):
        raise UserError(f"{path} holds no state dict: a mapping from names to tensors, or one under 'state_dict'.")
    odd = [str(name) for name, value in state.items() if not _is_plain(value)]
    if odd:
        raise UserError(f"{path}: not plain tensors of finite numbers: {_some(odd)}.")
    return {str(name).removeprefix("module."): value for name, value in state.items()}


def _check_packing(path: Path) -> None:
    """Raise UserError for an archive whose members would fill the memory; torch packs none of them."""
    try:
        with zipfile.ZipFile(path) as archive:
            unpacked = sum(member.file_size for member in archive.infolist())
    except (zipfile.BadZipFile, ValueError, NotImplementedError):
        return  # the former layout, or damaged, which torch tells
    if unpacked > 4 * path.stat().st_size + (1 << 20):
        raise UserError(f"{path} holds {unpacked:,} bytes packed into far fewer, as torch does not write them.")


def _is_plain(value: Tensor) -> bool:
    """Whether a tensor is one of numbers that are all in the file; one that is stretched may be of any size."""
    plain = value.layout is torch.strided and value.device.type == "cpu" and not value.is_quantized
    stored = plain and value.numel() * value.element_size() <= value.untyped_storage().nbytes()
    return stored and not value.is_complex() and is_finite(value)


def import_maptracker(
    official: Mapping[str, Tensor], config: PredMapNetConfig | None = None, seed: int = 0
) -> tuple[PredMapNet, ImportReport]:
    """Make a network of an official state dict.

    Args:
        official: names and tensors.
        config: MapTracker's baseline, with or without the paper's modules; None for MapTracker as it is, with the
            cameras that the file tells. The region of interest is always the file's.
        seed: of the parameters that only the paper's modules have.

    Returns:
        The network in evaluation mode, and what became of each entry.

    Raises:
        UserError: entries are unknown, missing or of another shape, constants differ from what the network does, or
            the configuration is not one of MapTracker's baseline.
    """
    report, found = ImportReport(), {}
    unknown, differing = [], []
    for name, tensor in official.items():
        here, original = name_here(name), original_of_alias(name)
        if original is not None:
            if original not in official or not torch.equal(tensor, official[original]):
                differing.append(f"{name} differs from {original}")
            report.ignored[name] = f"repeats {original}"
        elif here is not None:
            found[here] = tensor
            report.mapped[name] = here
        elif name in ("plane", "head.roi_size", "head.origin"):
            report.ignored[name] = "a constant that follows from the configuration; it was compared"
        else:
            unknown.append(name)
    faults = [f"{len(unknown)} unknown: {_some(unknown)}"] if unknown else []
    if differing:
        faults.append(f"{len(differing)} of a branch that all layers share are not the same: {_some(differing)}")
    config = _configuration(official, found, config)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        network = PredMapNet(config).eval()
    faults += _differing_constants(official, network.config)
    faults += _unfit(found, network, report)
    if faults:
        raise UserError(f"This is not a state dict of MapTracker as released: {'; '.join(faults)}.")
    network.load_state_dict(found, strict=False)
    return network, report


def _configuration(
    official: Mapping[str, Tensor], found: Mapping[str, Tensor], config: PredMapNetConfig | None
) -> PredMapNetConfig:
    """Return the configuration that was asked for, or the baseline's for as many cameras; with the file's region."""
    cameras = found[CAMERA_CODE].shape[0] if CAMERA_CODE in found and found[CAMERA_CODE].ndim else 0
    if config is None:
        config = BASELINES.get(cameras, BASELINES[len(NUSCENES_CAMERAS)])
    if not isinstance(config.bev, BevFormerConfig) or not isinstance(config.decoder, MapTrackerDecoderConfig):
        raise UserError(
            f"{config.name} is not built on MapTracker's network, so its weights do not fit. "
            f"Choose one of: {', '.join(name for name, known in PRESETS.items() if known.bev.kind == 'bevformer')}."
        )
    if cameras and cameras != len(config.bev.cameras):
        raise UserError(
            f"The checkpoint knows {cameras} cameras, but {config.name} has {len(config.bev.cameras)} "
            f"({', '.join(config.bev.cameras)})."
        )
    size = official.get("head.roi_size")
    if size is None or size.shape != (2,) or not bool(((size > 0) & size.isfinite()).all()):
        return config  # What is wrong with a region that is there is told where constants are compared.
    return config.model_copy(update={"roi_length": float(size[0]), "roi_width": float(size[1])})


@cache
def _names_of_baseline() -> frozenset[str]:
    """Return the names of all that MapTracker itself has."""
    with torch.device("meta"):
        return frozenset(PredMapNet(BASELINES[len(NUSCENES_CAMERAS)]).state_dict())


def _unfit(found: Mapping[str, Tensor], network: PredMapNet, report: ImportReport) -> list[str]:
    """Compare names and shapes with the network's; only counters of batches and the paper's modules may be missing."""
    wanted = network.state_dict()
    report.fresh = [name for name in wanted if name not in found and name not in _names_of_baseline()]
    absent = [name for name in wanted if name not in found and name not in report.fresh]
    report.missing = [name for name in absent if name.endswith(".num_batches_tracked")]
    absent = [name for name in absent if name not in report.missing]
    surplus = [name for name in found if name not in wanted]
    shapes = [
        f"{name} {tuple(tensor.shape)} instead of {tuple(wanted[name].shape)}"
        for name, tensor in found.items()
        if name in wanted and tensor.shape != wanted[name].shape
    ]
    named = {"missing": absent, "not known": surplus, "of another shape": shapes}
    return [f"{len(names)} {what}: {_some(names)}" for what, names in named.items() if names]


def _differing_constants(official: Mapping[str, Tensor], config: PredMapNetConfig) -> list[str]:
    """Compare the region of interest and the warp grid that the file holds with the configuration."""
    x = torch.linspace(-config.roi_length / 2, config.roi_length / 2, config.bev.columns, dtype=torch.float64)
    y = torch.linspace(config.roi_width / 2, -config.roi_width / 2, config.bev.rows, dtype=torch.float64)
    x, y = torch.broadcast_tensors(x[None, :], y[:, None])
    size = torch.tensor([config.roi_length, config.roi_width])
    constants = {
        "plane": torch.stack([x, y, torch.zeros_like(x), torch.ones_like(x)], dim=-1),
        "head.roi_size": size,
        "head.origin": -size / 2,
    }
    return [
        f"{name} is not what a region of {config.roi_length:g} m x {config.roi_width:g} m needs"
        for name, value in constants.items()
        if name in official and not _close(official[name], value)
    ]


def _close(first: Tensor, second: Tensor) -> bool:
    return first.shape == second.shape and torch.allclose(first.double(), second.double(), rtol=0.0, atol=1e-4)


def _not_only_tensors(path: Path) -> str:
    # Not torch's own words: they recommend to read the file in the way that executes it.
    return (
        f"{path} holds more than tensors and plain values; reading the rest would execute code from the file, which is "
        "not done. If you trust its source, write its 'state_dict' alone to a new file with the program that made it."
    )


def _beginning(path: Path) -> bytes:
    with path.open("rb") as file:
        return file.read(2)


def _first_line(error: Exception) -> str:
    return next(iter(str(error).splitlines()), type(error).__name__)


def _some(names: list[str]) -> str:
    return f"{', '.join(names[:_SHOWN_NAMES])}{' ...' if len(names) > _SHOWN_NAMES else ''}"
