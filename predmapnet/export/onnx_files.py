"""A folder of ONNX graphs: written from a checkpoint, described by ``network.json``."""

from __future__ import annotations

import json
import logging
import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from mapfusion import json_text
from predmapnet import __version__
from predmapnet.config import BevFormerConfig, PredMapNetConfig
from predmapnet.errors import UserError
from predmapnet.export.graphs import BEV_MEMORY, BevToMap, ImageToBev, geometry_tensors, padded_state
from predmapnet.files import whole_folder
from predmapnet.network.calibration import calibrate
from predmapnet.network.image_input import input_size
from predmapnet.network.kernels.inference import for_inference
from predmapnet.network.predmapnet import PredMapNet
from predmapnet.network.state import StreamState
from predmapnet.presets import parse_config
from predmapnet.scenes import Camera, Rig
from predmapnet.weights.checkpoint import Checkpoint

IMAGE_TO_BEV, BEV_TO_MAP, ABOUT = "image_to_bev.onnx", "bev_to_map.onnx", "network.json"
FORMAT = 1
FEWEST_ROWS = 64
"""Tracks of a stream at once; maps of ``lite`` hold about ten an instant."""
OPSET = 20
MOST_CAMERAS = 8


@dataclass(frozen=True)
class GraphFolder:
    """Content of ``network.json``: a description of the graphs beside it.

    Attributes:
        folder: where they are.
        config: of the network.
        rows: tracks that a stream can hold.
        sha256: of the weights that were exported.
        facts: about their training.
    """

    folder: Path
    config: PredMapNetConfig
    rows: int
    sha256: str
    facts: Mapping[str, Any]


def export_graphs(checkpoint: Checkpoint, folder: Path, rows: int | None = None) -> GraphFolder:
    """Write the two graphs of a network and their description; the folder appears whole or not at all.

    Args:
        checkpoint: the network.
        folder: to be made.
        rows: tracks that a stream can hold; as many as the network has queries, and at least 64, by default.

    Raises:
        UserError: the packages of the extra ``onnx`` are missing.
    """
    _check_packages()
    config = checkpoint.network.config
    network = for_inference(checkpoint.network)
    rows = rows or max(FEWEST_ROWS, config.decoder.queries)
    start = padded_state(network, rows)
    with whole_folder(folder) as draft, torch.no_grad(), _quiet():
        images = image_inputs(network, start)
        traced = ImageToBev(network, start).eval()
        _write(traced, images, draft / IMAGE_TO_BEV, list(traced(images)), _dynamic_axes(images))
        levels = traced(images)
        decoder = BevToMap(network, start).eval()
        state = {f"state.{name}": value for name, value in start.tensors().items() if value.numel()}
        inputs = {**levels, "ego_to_global": start.ego_to_global.clone(), **state}
        outputs = ["segmentation", *(f"detections.{name}" for name in ("valid", "labels", "scores", "points"))]
        _write(decoder, inputs, draft / BEV_TO_MAP, outputs + [f"next.{name}" for name in decoder.names], None)
        about = {
            "format": FORMAT,
            "version": __version__,
            "configuration": config.model_dump(mode="json"),
            "rows": rows,
            "sha256": checkpoint.sha256,
            "facts": dict(checkpoint.facts),
        }
        (draft / ABOUT).write_text(json.dumps(about, indent=1))
    return GraphFolder(folder, config, rows, checkpoint.sha256, checkpoint.facts)


def read_graph_folder(folder: Path) -> GraphFolder:
    """Read the description of exported graphs. Raises UserError where it is missing or damaged."""
    try:
        about = json_text.parse((folder / ABOUT).read_bytes())
        if about["format"] != FORMAT:
            raise UserError(f"{folder} holds graphs of format {about['format']}, not {FORMAT}. Export them again.")
        config = parse_config(json.dumps(about["configuration"]), str(folder / ABOUT))
        return GraphFolder(folder, config, int(about["rows"]), str(about["sha256"]), dict(about["facts"]))
    except (OSError, ValueError, KeyError, TypeError, OverflowError) as error:
        raise UserError(
            f"{folder} is no folder of exported graphs ({error}). Make one: predmapnet weights export --out FOLDER."
        ) from None


def image_inputs(network: PredMapNet, start: StreamState) -> dict[str, Tensor]:
    """Return example inputs of the images' graph, of an imaginary car."""
    config = network.config
    rig = _example_rig(config)
    calibration = calibrate(rig, config)
    named = {
        "images": torch.zeros(1, len(rig), 3, *input_size(config.image)),
        "camera_valid": torch.ones(1, len(rig), dtype=torch.bool),
        **geometry_tensors(network.view_geometry(calibration)),
    }
    if isinstance(config.bev, BevFormerConfig):
        memory = {f"state.{name}": getattr(start, name) for name in BEV_MEMORY}
        named |= {"camera_code": calibration.camera_code, "ego_to_global": start.ego_to_global.clone(), **memory}
    return named


def _example_rig(config: PredMapNetConfig) -> Rig:
    """Cameras all around at 1.5 m; by the names that the network knows."""
    names = config.bev.cameras if isinstance(config.bev, BevFormerConfig) else [f"CAMERA_{n}" for n in range(6)]
    cameras = []
    for number, name in enumerate(names):
        yaw = torch.tensor(2 * torch.pi * number / len(names), dtype=torch.float64)
        pose = torch.eye(4, dtype=torch.float64)
        pose[:3, 0] = torch.stack([yaw.sin(), -yaw.cos(), yaw * 0])
        pose[:3, 1] = torch.tensor([0.0, 0.0, -1.0])
        pose[:3, 2] = torch.stack([yaw.cos(), yaw.sin(), yaw * 0])
        pose[2, 3] = 1.5
        intrinsics = torch.tensor([[630.0, 0, 400], [0, 630, 225], [0, 0, 1]], dtype=torch.float64)
        cameras.append(Camera(name, 800, 450, intrinsics.numpy(), pose.numpy()))
    return tuple(cameras)


def _dynamic_axes(inputs: Mapping[str, Tensor]) -> dict[str, dict[int, Any]]:
    """Axes of the images' graph that vary: the cameras, and what they see."""
    cameras = torch.export.Dim("cameras", min=1, max=MOST_CAMERAS)
    pixels, pairs = torch.export.Dim("pixels", min=2), torch.export.Dim("pairs", min=2)
    axes: dict[str, dict[int, Any]] = {name: {} for name in inputs}
    for name in ("view.columns", "view.weights"):
        axes |= {name: {0: pixels}} if name in inputs else {}
    for name in ("view.camera", "view.cell", "view.positions"):
        axes |= {name: {0: pairs}} if name in inputs else {}
    if "camera_code" not in inputs:  # MapTracker's encoder knows its cameras.
        axes |= {"images": {1: cameras}, "camera_valid": {1: cameras}, "view.visible": {2: cameras}}
    return axes


def _write(
    module: nn.Module, inputs: dict[str, Tensor], path: Path, outputs: list[str], axes: dict[str, dict[int, Any]] | None
) -> None:
    # First a program of its own: the exporter alone would silently fix axes that it cannot keep variable.
    program = torch.export.export(
        module, (), {"named": inputs}, dynamic_shapes=None if axes is None else {"named": axes}, strict=False
    )
    torch.onnx.export(
        program,
        f=path,
        dynamo=True,
        opset_version=OPSET,
        input_names=list(inputs),
        output_names=outputs,
        external_data=True,
        verbose=False,
    )


def _check_packages() -> None:
    try:
        import onnx  # noqa: F401
        import onnxscript  # noqa: F401
    except ImportError:
        raise UserError("Exporting needs the extra 'onnx': pip install 'predmapnet[onnx]'.") from None


@contextmanager
def _quiet() -> Iterator[None]:
    """Keep the exporter's remarks on its own inside to itself."""
    loggers = [logging.getLogger(name) for name in ("torch.onnx", "onnxscript", "onnx_ir")]
    levels = [logger.level for logger in loggers]
    for logger in loggers:
        logger.setLevel(logging.ERROR)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            yield
        finally:
            for logger, level in zip(loggers, levels, strict=True):
                logger.setLevel(level)
