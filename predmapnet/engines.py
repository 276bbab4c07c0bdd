"""Engines that compute the network for a :class:`~predmapnet.mapper.Mapper`: torch here, exported graphs elsewhere."""

from __future__ import annotations

from threading import Lock
from typing import Any, Protocol

import torch
from torch import Tensor

from predmapnet.config import LookupBevConfig, PredMapNetConfig
from predmapnet.machine import EngineKind, Precision
from predmapnet.network.calibration import Calibration
from predmapnet.network.kernels.compilation import compile_features
from predmapnet.network.kernels.inference import for_inference
from predmapnet.network.kernels.low_precision import in_precision
from predmapnet.network.predmapnet import PredMapNet
from predmapnet.network.state import (
    BevFeatures,
    FrameInputs,
    ImageFeatures,
    Selection,
    StreamState,
    ViewGeometry,
)
from predmapnet.network.track_selection import select

CALIBRATIONS_KEPT = 8
"""Calibrations whose geometry is remembered; cameras that never move cost it once."""

EngineStep = tuple[Selection, StreamState, Tensor]
"""Result of a frame: its selection, the state for the next one, and segmentation logits ``(1, 3, H_s, W_s)``."""


class Engine(Protocol):
    """Computes one instant of one stream.

    Attributes:
        config: of the network.
        device: where inputs are wanted.
        kind: its name in files.
    """

    kind: EngineKind
    config: PredMapNetConfig
    device: torch.device

    def features(self, inputs: FrameInputs) -> Any:
        """Compute what a frame gives without memory; other threads may do that while a step runs."""

    def step(self, inputs: FrameInputs, state: StreamState | None, features: Any = None) -> EngineStep:
        """Map one frame; a state of None begins a stream, and the one given is not changed.

        ``features`` are :meth:`features` of these inputs if they were computed ahead.
        """


class TorchEngine:
    """The network itself, made ready for inference.

    Args:
        network: is copied.
        device: where it computes.
        precision: of the image backbone and the BEV encoder.
        compiled: whether these two are compiled.
    """

    kind = EngineKind.TORCH

    def __init__(self, network: PredMapNet, device: str | torch.device, precision: Precision, compiled: bool) -> None:
        self.network = in_precision(for_inference(network).to(device), precision)
        self.config = network.config
        self.device = torch.device(device)
        if compiled:
            compile_features(self.network)
        self._geometries: dict[bytes, ViewGeometry] = {}
        self._looking_up = Lock()

    def features(self, inputs: FrameInputs) -> ImageFeatures | BevFeatures:
        """Compute image features, and BEV features where no BEV memory takes part in them."""
        images = self.network.encode_images(inputs)
        if not isinstance(self.config.bev, LookupBevConfig):
            return images
        return self.network.encode_bev(images, inputs, None, self._geometry(inputs.calibration))

    def step(
        self, inputs: FrameInputs, state: StreamState | None, features: ImageFeatures | BevFeatures | None = None
    ) -> EngineStep:
        """Map one frame, as :class:`Engine` says."""
        if state is None:
            state = self.network.initial_state(1)
        if features is None:
            features = self.features(inputs)
        if isinstance(features, ImageFeatures):
            features = self.network.encode_bev(features, inputs, state, self._geometry(inputs.calibration))
        outputs = self.network.decode_bev(features, inputs, state)
        selection = select(outputs, state, self.config)
        state = self.network.advance(state, outputs, selection.instances, inputs, selection.lost)
        return selection, state, outputs.segmentation

    def _geometry(self, calibration: Calibration) -> ViewGeometry:
        """Return the geometry of a calibration, from the few that were used last."""
        key = calibration.fingerprint()
        with self._looking_up:
            geometry = self._geometries.pop(key, None)
            if geometry is None:
                geometry = self.network.view_geometry(calibration)
            self._geometries[key] = geometry
            if len(self._geometries) > CALIBRATIONS_KEPT:
                self._geometries.pop(next(iter(self._geometries)))
        return geometry
