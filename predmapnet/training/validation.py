"""Chamfer mAP on validation scenes while training, single frames or whole streams."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray

from mapfusion.elements import ElementKind, FrameMap
from predmapnet.config import PredMapNetConfig
from predmapnet.evaluation.chamfer_ap import chamfer_average_precision, thresholds_for
from predmapnet.evaluation.frames import EvaluationFrame
from predmapnet.network.image_input import normalise_images
from predmapnet.network.interface import FrameInputs, Selection, StreamState
from predmapnet.network.predmapnet import PredMapNet
from predmapnet.network.tracking import select
from predmapnet.network.view_transform import RigLookup
from predmapnet.training.frames import CachedScene

Float = NDArray[np.float64]

EVERY = 4
"""Every fourth frame is measured: neighbours look alike."""
FIRST = 3
"""The first measured frame, so that streams have something to remember."""


@torch.no_grad()
def validate(
    network: PredMapNet, lookup: RigLookup, scenes: Sequence[CachedScene], streaming: bool
) -> dict[str, float]:
    """Measure a network on cached scenes.

    Args:
        network: in evaluation mode.
        lookup: of the scenes' rig.
        scenes: whole scenes.
        streaming: run each scene from its start with state; otherwise every frame stands alone. The frames that
            are measured are the same.

    Returns:
        ``mAP`` and per kind the AP averaged over thresholds, and at each threshold, all in [0, 1].
    """
    frames: list[EvaluationFrame] = []
    for scene in scenes:
        state: StreamState | None = None
        for index in range(0 if streaming else FIRST, len(scene), 1 if streaming else EVERY):
            inputs = _inputs(scene, index, network.config)
            outputs = network(inputs, lookup, state)
            chosen = select(outputs, state, network.config)
            if streaming:
                state = network.advance(state, outputs, chosen.instances, inputs)
            if index % EVERY == FIRST:
                predicted = _frame_map(chosen, scene.ego_to_global[index], network.config)
                frames.append(EvaluationFrame(scene.name, index, predicted, scene.truths[index]))
    result = chamfer_average_precision(frames, thresholds_for(network.config.roi))
    figures = {"mAP": result.mean}
    for of_kind in result.kinds:
        figures[of_kind.kind.label] = of_kind.average_precision
        for curve in of_kind.curves:
            figures[f"{of_kind.kind.label}@{curve.threshold:g}"] = curve.average_precision
    return figures


def _inputs(scene: CachedScene, index: int, config: PredMapNetConfig) -> FrameInputs:
    images = torch.from_numpy(np.array(scene.images[index]))[None]
    return FrameInputs(
        images=normalise_images(images, config.image),
        camera_valid=torch.ones(images.shape[:2], dtype=torch.bool),
        ego_to_global=torch.from_numpy(scene.ego_to_global[index])[None],
    )


def _frame_map(selection: Selection, ego_to_global: Float, config: PredMapNetConfig) -> FrameMap:
    """Everything that is reported of one frame of one stream, in metres."""
    parts = (selection.instances, selection.detections)
    kept = [part.valid[0] for part in parts]
    kinds, scores, track_ids, points = (
        torch.cat([getattr(part, name)[0][rows] for part, rows in zip(parts, kept, strict=True)]).numpy()
        for name in ("labels", "scores", "track_ids", "points")
    )
    lines = (points.clip(0.0, 1.0).astype(np.float64) - 0.5) * config.roi.size
    rings = kinds == ElementKind.PED_CROSSING
    lines[rings, -1] = lines[rings, 0]
    return FrameMap(
        timestamp=0,
        ego_to_global=ego_to_global,
        roi=config.roi,
        kinds=kinds,
        scores=scores.astype(np.float64),
        track_ids=track_ids,
        polylines=tuple(lines),
    )
