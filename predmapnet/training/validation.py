"""Chamfer mAP on validation scenes while training, single frames or whole streams."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence

import numpy as np
import torch
from numpy.typing import NDArray

from mapfusion.elements import FrameMap
from predmapnet.evaluation.chamfer_ap import chamfer_average_precision, thresholds_for
from predmapnet.evaluation.frames import EvaluationFrame
from predmapnet.mapper import to_frame_map
from predmapnet.network.image_input import normalise_images
from predmapnet.network.predmapnet import PredMapNet
from predmapnet.network.state import FrameInputs
from predmapnet.network.track_selection import select
from predmapnet.training.data.scene_cache import CachedFrame, CachedScene

Float = NDArray[np.float64]

EVERY = 4
"""Every fourth frame is measured: neighbours look alike."""
FIRST = 3
"""The first measured frame, so that streams have something to remember."""
FRAME_INTERVAL_NS = 500_000_000


@torch.no_grad()
def validate(network: PredMapNet, scenes: Sequence[CachedScene], streaming: bool) -> dict[str, float]:
    """Measure a network on cached scenes.

    Args:
        network: in evaluation mode.
        scenes: whole scenes.
        streaming: run each scene from its start with state; otherwise every frame stands alone. The frames that
            are measured are the same.

    Returns:
        ``mAP`` and per kind the AP averaged over thresholds, and at each threshold, all in [0, 1].
    """
    frames: list[EvaluationFrame] = []
    for scene in scenes:
        measured = range(FIRST, len(scene), EVERY)
        indices = range(len(scene)) if streaming else measured
        maps = map_frames(network, scene, indices, streaming)
        frames += [
            EvaluationFrame(scene.name, index, predicted, scene.frame(index, images=False).truth)
            for index, predicted in zip(indices, maps, strict=True)
            if index in measured
        ]
    result = chamfer_average_precision(frames, thresholds_for(network.config.roi))
    figures = {"mAP": result.mean}
    for of_kind in result.kinds:
        figures[of_kind.kind.label] = of_kind.average_precision
        for curve in of_kind.curves:
            figures[f"{of_kind.kind.label}@{curve.threshold:g}"] = curve.average_precision
    return figures


@torch.no_grad()
def map_frames(network: PredMapNet, scene: CachedScene, indices: Iterable[int], streaming: bool) -> Iterator[FrameMap]:
    """Yield the maps of some frames of a cached scene.

    Args:
        network: in evaluation mode.
        scene: whose images are at the network's size; it knows no times, so frames count as half a second apart.
        indices: the frames, in order.
        streaming: hand the state on from frame to frame.
    """
    config = network.config
    empty = network.initial_state(1)
    state = empty
    known, geometry = b"", None
    for index in indices:
        frame = scene.frame(index)
        inputs = _inputs(frame, network)
        if (cameras := frame.calibration.fingerprint()) != known:
            known, geometry = cameras, network.view_geometry(inputs.calibration)
        outputs = network(inputs, state, geometry)
        selection = select(outputs, state, config)
        after = network.advance(state, outputs, selection.instances, inputs, selection.lost)
        pose = inputs.ego_to_global[0].cpu().numpy()
        yield to_frame_map(selection, after, outputs.segmentation, config, index * FRAME_INTERVAL_NS, pose)
        state = after if streaming else empty


def _inputs(frame: CachedFrame, network: PredMapNet) -> FrameInputs:
    device = network.device
    return FrameInputs(
        images=normalise_images(torch.from_numpy(frame.images)[None].to(device), network.config.image),
        camera_valid=torch.from_numpy(frame.camera_valid)[None].to(device),
        ego_to_global=torch.from_numpy(frame.ego_to_global)[None].to(device),
        calibration=frame.calibration.to(device),
    )
