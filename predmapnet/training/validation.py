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
from predmapnet.network.calibration import Calibration, calibrate
from predmapnet.network.image_input import normalise_images
from predmapnet.network.predmapnet import PredMapNet
from predmapnet.network.state import FrameInputs
from predmapnet.network.track_selection import select
from predmapnet.training.data.scene_cache import CachedScene

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
            EvaluationFrame(scene.name, index, predicted, scene.truths[index])
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
    calibration = calibrate(scene.rig, config).to(network.device)
    geometry = network.view_geometry(calibration)
    for index in indices:
        inputs = _inputs(scene, index, network, calibration)
        outputs = network(inputs, state, geometry)
        selection = select(outputs, state, config)
        after = network.advance(state, outputs, selection.instances, inputs, selection.lost)
        pose = scene.ego_to_global[index]
        yield to_frame_map(selection, after, outputs.segmentation, config, index * FRAME_INTERVAL_NS, pose)
        state = after if streaming else empty


def _inputs(scene: CachedScene, index: int, network: PredMapNet, calibration: Calibration) -> FrameInputs:
    images = torch.from_numpy(np.array(scene.images[index]))[None].to(network.device)
    return FrameInputs(
        images=normalise_images(images, network.config.image),
        camera_valid=torch.ones(images.shape[:2], dtype=torch.bool, device=network.device),
        ego_to_global=torch.from_numpy(scene.ego_to_global[index])[None].to(network.device),
        calibration=calibration,
    )
