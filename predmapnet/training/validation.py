"""Chamfer mAP and C-mAP on validation scenes while training, single frames or whole streams, shared out over ranks."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence

import torch
import torch.distributed as distributed

from mapfusion.elements import FrameMap
from predmapnet.engines import TorchEngine
from predmapnet.evaluation.chamfer_ap import chamfer_average_precision, thresholds_for
from predmapnet.evaluation.consistency_ap import consistency_average_precision
from predmapnet.evaluation.frames import EvaluationFrame
from predmapnet.frame_cache.scene_cache import CachedScene
from predmapnet.machine import Precision
from predmapnet.mapper import to_frame_map
from predmapnet.network.predmapnet import PredMapNet
from predmapnet.training.data.batches import collate_frames
from predmapnet.training.processes import gathered

EVERY = 4
"""Every fourth frame is measured: neighbours look alike."""
FIRST = 3
"""The first measured frame, so that streams have something to remember."""
FRAME_INTERVAL_NS = 500_000_000


def validate(network: PredMapNet, scenes: Sequence[CachedScene], streaming: bool) -> dict[str, float]:
    """Measure a network on cached scenes; each process maps some of them, and all get the figures.

    Args:
        network: on any device.
        scenes: whole scenes, the same in all processes.
        streaming: run each scene from its start with state; otherwise every frame stands alone. The frames that
            are measured are the same.

    Returns:
        ``mAP`` and per kind the AP averaged over thresholds, and at each threshold, all in [0, 1]; ``C-mAP`` of all
        frames of streams.
    """
    rank, size = (distributed.get_rank(), distributed.get_world_size()) if distributed.is_initialized() else (0, 1)
    everyone = gathered([_mapped(network, scene, streaming) for scene in scenes[rank::size]])
    # In the order of the scenes: first the first of each process, and so on.
    frames = [frame for number in range(len(scenes)) for frame in everyone[number % size][number // size]]
    thresholds = thresholds_for(network.config.roi)
    measured = [frame for frame in frames if frame.index % EVERY == FIRST]
    result = chamfer_average_precision(measured, thresholds)
    figures = {"mAP": result.mean}
    if streaming:
        figures["C-mAP"] = consistency_average_precision(frames, thresholds).mean
    for of_kind in result.kinds:
        figures[of_kind.kind.label] = of_kind.average_precision
        for curve in of_kind.curves:
            figures[f"{of_kind.kind.label}@{curve.threshold:g}"] = curve.average_precision
    return figures


def _mapped(network: PredMapNet, scene: CachedScene, streaming: bool) -> list[EvaluationFrame]:
    """Map one scene: all frames of a stream, or those that are measured."""
    indices = range(len(scene)) if streaming else range(FIRST, len(scene), EVERY)
    maps = map_frames(network, scene, indices, streaming)
    return [
        EvaluationFrame(scene.name, index, predicted, scene.frame(index, images=False).truth)
        for index, predicted in zip(indices, maps, strict=True)
    ]


@torch.no_grad()
def map_frames(network: PredMapNet, scene: CachedScene, indices: Iterable[int], streaming: bool) -> Iterator[FrameMap]:
    """Yield the maps of some frames of a cached scene.

    Args:
        network: in any mode; it is copied for inference.
        scene: whose images are at the network's size; it knows no times, so frames count as half a second apart.
        indices: the frames, in order.
        streaming: hand the state on from frame to frame.
    """
    engine, state = TorchEngine(network, network.device, Precision.FLOAT32, compiled=False), None
    for index in indices:
        frame = scene.frame(index)
        selection, after, segmentation = engine.step(collate_frames([frame], network.config).inputs(network), state)
        time = index * FRAME_INTERVAL_NS
        yield to_frame_map(selection, after, segmentation, network.config, time, frame.ego_to_global)
        state = after if streaming else None
