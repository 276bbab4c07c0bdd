"""Reads MapTracker's official checkpoints; nothing in the file is executed."""

from __future__ import annotations

import pickle
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import torch
from torch import Tensor

from predmapnet.config import BevFormerConfig, PredMapNetConfig, preset
from predmapnet.errors import UserError
from predmapnet.network.predmapnet import PredMapNet
from predmapnet.weights.maptracker_names import name_here, original_of_alias

BEGINNINGS = (b"PK", b"\x80\x02", b"\x80\x04", b"\x80\x05")
"""Of files that torch or pickle have written."""

CAMERA_CODE = "bev_encoder.camera_code"
_SHOWN_NAMES = 4


@dataclass
class ImportReport:
    """What became of the entries of an official state dict.

    Attributes:
        mapped: official name to name here.
        ignored: official name to the reason.
        missing: names here that the file does not fill, and which can do without.
    """

    mapped: dict[str, str] = field(default_factory=dict)
    ignored: dict[str, str] = field(default_factory=dict)
    missing: list[str] = field(default_factory=list)


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
    try:
        content = torch.load(path, map_location="cpu", weights_only=True)
    except pickle.UnpicklingError as error:
        if _beginning(path) in BEGINNINGS:
            raise UserError(_not_only_tensors(path, error)) from None
        raise UserError(f"{path} is not a whole PyTorch checkpoint. Fetch it again.") from None
    except (RuntimeError, EOFError, OSError, ValueError, KeyError) as error:
        raise UserError(f"{path} is not a whole PyTorch checkpoint ({_first_line(error)}). Fetch it again.") from None
    state = content.get("state_dict", content) if isinstance(content, Mapping) else None
    if not isinstance(state, Mapping) or not state or not all(isinstance(value, Tensor) for value in state.values()):
        raise UserError(f"{path} holds no state dict: a mapping from names to tensors, or one under 'state_dict'.")
    return {str(name).removeprefix("module."): value for name, value in state.items()}


def import_maptracker(official: Mapping[str, Tensor]) -> tuple[PredMapNet, ImportReport]:
    """Make a network of an official state dict.

    Args:
        official: names and tensors.

    Returns:
        The network in evaluation mode, and what became of each entry.

    Raises:
        UserError: entries are unknown, missing or of another shape, or constants differ from what the network does.
    """
    report, found = ImportReport(), {}
    unknown, faults = [], []
    for name, tensor in official.items():
        here, original = name_here(name), original_of_alias(name)
        if original is not None:
            if original not in official or not torch.equal(tensor, official[original]):
                faults.append(f"{name} differs from {original}, although all layers share one branch")
            report.ignored[name] = f"repeats {original}"
        elif here is not None:
            found[here] = tensor
            report.mapped[name] = here
        elif name in ("plane", "head.roi_size", "head.origin"):
            report.ignored[name] = "a constant that follows from the configuration; it was compared"
        else:
            unknown.append(name)
    if unknown:
        faults.append(f"{len(unknown)} unknown: {_some(unknown)}")
    network = PredMapNet(_configuration(found)).eval()
    faults += _differing_constants(official, network.config)
    faults += _unfit(found, network, report)
    if faults:
        raise UserError(f"This is not a state dict of MapTracker as released: {'; '.join(faults)}.")
    network.load_state_dict(found, strict=False)
    return network, report


def _configuration(found: Mapping[str, Tensor]) -> PredMapNetConfig:
    """Return the preset that the number of cameras tells."""
    code = found.get(CAMERA_CODE)
    by_cameras = {
        config.bev.cameras: config
        for config in map(preset, ("maptracker-nuscenes", "maptracker-av2"))
        if isinstance(config.bev, BevFormerConfig)
    }
    return preset("maptracker-nuscenes") if code is None else by_cameras.get(len(code), preset("maptracker-nuscenes"))


def _unfit(found: Mapping[str, Tensor], network: PredMapNet, report: ImportReport) -> list[str]:
    """Compare names and shapes with the network's; counters of batches are the only ones that may be missing."""
    wanted = network.state_dict()
    absent = [name for name in wanted if name not in found]
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


def _not_only_tensors(path: Path, error: Exception) -> str:
    return (
        f"{path} holds more than tensors and plain values; reading the rest would execute code from the file, which is "
        f"not done ({_first_line(error)}). If you trust its source, write its 'state_dict' alone to a new file with "
        "the program that made it."
    )


def _beginning(path: Path) -> bytes:
    with path.open("rb") as file:
        return file.read(2)


def _first_line(error: Exception) -> str:
    return next(iter(str(error).splitlines()), type(error).__name__)


def _some(names: list[str]) -> str:
    return f"{', '.join(names[:_SHOWN_NAMES])}{' ...' if len(names) > _SHOWN_NAMES else ''}"
