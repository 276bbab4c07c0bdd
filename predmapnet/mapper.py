"""Streaming inference: frames in, maps of single instants out, all memory in an explicit state."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from mapfusion.arrays import Float
from mapfusion.elements import ElementKind, FrameMap, RegionOfInterest
from predmapnet.config import PredMapNetConfig
from predmapnet.datasets.images import read_camera_image
from predmapnet.engines import Engine, TorchEngine
from predmapnet.errors import UserError
from predmapnet.machine import EngineKind, NetworkOptions, Precision
from predmapnet.network.calibration import calibrate
from predmapnet.network.image_input import WindowPixels, normalise_images, stack_windows
from predmapnet.network.predmapnet import PredMapNet
from predmapnet.network.state import FrameInputs, Instances, Selection, StreamState
from predmapnet.scenes import Frame, Image, ground_in_view
from predmapnet.weights.checkpoint import load_checkpoint


@dataclass(frozen=True)
class SeenFrame:
    """A frame as far as it goes without memory: cameras with an image, inputs of the network, and features."""

    valid: NDArray[np.bool_]
    inputs: FrameInputs
    features: Any


@dataclass(frozen=True)
class CameraImages:
    """Images of one instant as the network wants them: windows ``(N, h, w, 3)``, RGB, 0 to 255, in the rig's order.

    They are black where there is no image (``valid (N,) bool``).
    """

    windows: WindowPixels
    valid: NDArray[np.bool_]


class Mapper:
    """PredMapNet over a stream of frames.

    It keeps nothing of a stream, so several logs can be mapped in turns, each with its own state.

    Example:
        >>> mapper = Mapper.from_checkpoint()  # doctest: +SKIP
        >>> state = None
        >>> for index in range(len(scene)):  # doctest: +SKIP
        ...     frame_map, state = mapper.step(scene.frame(index), state)

    Attributes:
        config: of the network.
        weights_sha256: of the file that the weights came from; empty for a network that was made in memory.
        facts: about the training, from the weights file (:class:`predmapnet.weights.checkpoint.Checkpoint`).
        precision: of the image backbone and the BEV encoder (:mod:`predmapnet.network.kernels.low_precision`).
        compiled: whether these two are compiled.
        engine: what computes the network.
        ahead: whether :func:`predmapnet.mapping.map_scene` lets it :meth:`see` the next frames during a step.
    """

    def __init__(
        self,
        network: PredMapNet | Engine,
        device: str | torch.device = "cpu",
        weights_sha256: str = "",
        facts: Mapping[str, Any] | None = None,
        precision: Precision = Precision.FLOAT32,
        compiled: bool = False,
        ahead: bool = True,
    ) -> None:
        engine = TorchEngine(network, device, precision, compiled) if isinstance(network, PredMapNet) else network
        self.engine: Engine = engine
        self.config: PredMapNetConfig = engine.config
        self.weights_sha256 = weights_sha256
        self.facts: Mapping[str, Any] = dict(facts or {})
        self.precision = precision
        self.compiled = compiled
        self.ahead = ahead

    @classmethod
    def from_checkpoint(cls, options: NetworkOptions | None = None) -> Mapper:
        """Load a network; without options the shipped weights. Raises UserError without weights, device or compiler."""
        options = options or NetworkOptions()
        if options.engine is EngineKind.ONNX or (options.weights is not None and options.weights.is_dir()):
            from predmapnet.export.engine import OnnxEngine

            engine = OnnxEngine.open(options)
            return cls(engine, engine.device, engine.graphs.sha256, engine.graphs.facts, ahead=options.ahead)
        checkpoint = load_checkpoint(options.weights)
        device = choose_device(options.device)
        facts, sha256 = checkpoint.facts, checkpoint.sha256
        return cls(checkpoint.network, device, sha256, facts, options.precision, options.compiled, options.ahead)

    @property
    def roi(self) -> RegionOfInterest:
        """The region that is mapped at one instant."""
        return self.config.roi

    def read_images(self, frame: Frame, *, allow_missing_cameras: bool = False) -> CameraImages:
        """Read and crop the images of a frame; safe to call from other threads while a step runs.

        Args:
            frame: names the images.
            allow_missing_cameras: mask cameras without an image out instead of failing.

        Raises:
            UserError: an image is missing, damaged, or not of its camera's size, or the car has other cameras than the
                network has learned.
        """
        images: dict[str, Image] = {}
        for camera in frame.rig:
            image = frame.images.get(camera.name)
            if image is None or (isinstance(image, Path) and not image.exists()):
                if not allow_missing_cameras:
                    raise UserError(_missing_camera(frame, camera.name, image))
                continue
            images[camera.name] = read_camera_image(image, camera)
        if not images:
            raise UserError(
                f"Frame {frame.index} of {frame.scene} has no image of any camera: there is nothing to map."
            )
        windows, valid = stack_windows(images, frame.rig, self.config.image)
        return CameraImages(windows, valid)

    @torch.inference_mode()
    def see(self, frame: Frame, images: CameraImages) -> SeenFrame:
        """Compute what needs no memory of a frame; safe to call from other threads while a step runs."""
        device = self.engine.device
        inputs = FrameInputs(
            images=normalise_images(torch.from_numpy(images.windows)[None].to(device), self.config.image),
            camera_valid=torch.from_numpy(images.valid)[None].to(device),
            ego_to_global=torch.from_numpy(np.asarray(frame.ego_to_global, dtype=np.float64))[None].to(device),
            calibration=calibrate(frame.rig, self.config).to(device),
        )
        return SeenFrame(images.valid, inputs, self.engine.features(inputs))

    @torch.inference_mode()
    def step(
        self,
        frame: Frame,
        state: StreamState | None = None,
        *,
        images: CameraImages | SeenFrame | None = None,
        allow_missing_cameras: bool = False,
    ) -> tuple[FrameMap, StreamState]:
        """Map the next frame of a log.

        Args:
            frame: the next of its log.
            state: returned by the step before; None begins a log.
            images: of this frame, if :meth:`read_images` or :meth:`see` was called ahead; read here otherwise.
            allow_missing_cameras: as in :meth:`read_images`, which also says what errors there are.

        Returns:
            The map of this instant, ``visible`` saying what ground the cameras with an image cover, and the state for
            the next step. ``state`` itself is not changed.
        """
        if images is None:
            images = self.read_images(frame, allow_missing_cameras=allow_missing_cameras)
        seen = images if isinstance(images, SeenFrame) else self.see(frame, images)
        selection, state, segmentation = self.engine.step(seen.inputs, state, seen.features)
        frame_map = to_frame_map(selection, state, segmentation, self.config, frame.timestamp, frame.ego_to_global)
        working = (camera for camera, valid in zip(frame.rig, seen.valid, strict=True) if valid)
        road = float(np.median([camera.ground_height for camera in frame.rig]))
        return replace(frame_map, visible=ground_in_view(working, self.roi), ground_height=road), state


def choose_device(name: str) -> torch.device:
    """Return the device of a name (``auto``: a GPU if there is one); raises UserError where it does not exist."""
    if name == "auto":
        return torch.device("cuda" if torch.cuda.is_available() else "cpu")
    try:
        device = torch.device(name)
    except RuntimeError:  # its message lists twenty devices
        raise UserError(f"There is no device '{name}'. Choose auto, cpu, cuda or mps.") from None
    try:
        torch.zeros(1, device=device)
    except (RuntimeError, AssertionError) as error:
        reason = str(error).splitlines()[0]
        raise UserError(f"The device '{name}' cannot be used ({reason}). Try --device cpu.") from None
    return device


def _missing_camera(frame: Frame, camera: str, path: Path | None) -> str:
    unknown = "the data set names no file for it" if path is None else f"{path} does not exist"
    return (
        f"Frame {frame.index} of {frame.scene} has no image of {camera}: {frame.missing.get(camera, unknown)}. "
        "Restore it, or map without it (--allow-missing-cameras)."
    )


def to_frame_map(
    selection: Selection,
    state: StreamState,
    segmentation: Tensor,
    config: PredMapNetConfig,
    timestamp: int,
    ego_to_global: Float,
) -> FrameMap:
    """Return the frame map of one stream: tracks first, then detections without a track.

    The state is that after the frame; ``segmentation`` is ``(1, 3, H_s, W_s)`` logits.
    """
    tracks, others = _rows(selection.instances), _rows(selection.detections)
    kinds = np.concatenate([tracks["labels"], others["labels"]])
    points = np.concatenate([tracks["points"], others["points"]])
    valid = selection.instances.valid[0]
    forecasts: tuple[Float, ...] | None = None
    if config.future.enabled:
        nothing = np.zeros((0, 2))
        forecasts = _to_metres(state.forecasts[0][valid].cpu().numpy(), tracks["labels"], config.roi)
        forecasts += (nothing,) * len(others["labels"])
    masks = None
    if config.history_map.memory:
        remembered = state.history_maps[0][valid].float().cpu().numpy()
        masks = np.concatenate([remembered, np.zeros((len(others["labels"]), *config.mask_size), dtype=np.float32)])
    return FrameMap(
        timestamp=timestamp,
        ego_to_global=ego_to_global,
        roi=config.roi,
        kinds=kinds,
        scores=np.concatenate([tracks["scores"], others["scores"]]).astype(np.float64),
        track_ids=np.concatenate([tracks["track_ids"], others["track_ids"]]),
        polylines=_to_metres(points.clip(0.0, 1.0), kinds, config.roi),
        forecasts=forecasts,
        segmentation=segmentation[0].sigmoid().float().cpu().numpy(),
        history_masks=masks,
    )


def _rows(instances: Instances) -> Mapping[str, NDArray[np.generic]]:
    """Valid rows of the first stream, as arrays."""
    valid = instances.valid[0]
    names = ("labels", "points", "scores", "track_ids")
    return {name: getattr(instances, name)[0][valid].cpu().numpy() for name in names}


def _to_metres(points: NDArray[np.generic], kinds: NDArray[np.generic], roi: RegionOfInterest) -> tuple[Float, ...]:
    """Turn normalised ``(n, P, 2)`` into ``n`` polylines in metres; crossings become closed rings."""
    lines = (points.astype(np.float64) - 0.5) * roi.size
    rings = kinds == ElementKind.PED_CROSSING
    lines[rings, -1] = lines[rings, 0]
    return tuple(lines)
