"""One training step of the paper's network: a clip of frames with MapTracker's assignment, and all losses of Sec. 3.6.

Every track answers for the element that it stands for as long as that is seen; detections share out the rest. Rows
that are confident after a frame are the tracks of the next one, whether or not they stand for anything.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor
from torch.nn import functional

from predmapnet.config import BevFormerConfig
from predmapnet.errors import UserError
from predmapnet.network.ego_motion import relative_motion, relative_pose
from predmapnet.network.maptracker.bev_memory import store_bev_map
from predmapnet.network.maptracker.decoder import MapTrackerDecoder
from predmapnet.network.predmapnet import PredMapNet
from predmapnet.network.state import FrameInputs, FrameOutputs, ImageFeatures, StreamState
from predmapnet.network.track_propagation import PoseTrackPropagation
from predmapnet.network.track_selection import instances_from_rows
from predmapnet.training.data.depth_targets import UNKNOWN, depth_loss
from predmapnet.training.data.targets import Targets
from predmapnet.training.losses.lite import forecast_loss, mask_loss, masks_of_size
from predmapnet.training.losses.maptracker import (
    LayerTargets,
    all_orders,
    assign_layer,
    layer_losses,
    segmentation_losses,
    stacked,
    transformation_loss,
)
from predmapnet.training.losses.matching import Assignment
from predmapnet.training.pose_noise import with_pose_noise
from predmapnet.training.settings import ClipSettings, ClipStage
from predmapnet.training.track_truth import TrackTruth, truth_of_tracks


@dataclass
class ClipFrame:
    """One instant of a clip, of ``B`` streams.

    Attributes:
        inputs: of the network.
        targets: truth, rasters included.
        depth: ``(B, N, h', w') int64`` of :func:`~predmapnet.training.data.depth_targets.depth_targets`, or None.
    """

    inputs: FrameInputs
    targets: Targets
    depth: Tensor | None = None


@dataclass
class Past:
    """What one frame hands to the next.

    Attributes:
        state: of the network.
        track_truth: the true element behind each track.
        labels: ``(B, T) int64``, what each track stood for in the last frame; the number of classes for nothing.
        lines: ``(B, T, 2 P)``, and where that was.
    """

    state: StreamState
    track_truth: TrackTruth
    labels: Tensor
    lines: Tensor


def clip_losses(
    network: PredMapNet,
    clip: Sequence[ClipFrame],
    stage: ClipStage,
    settings: ClipSettings,
    step: int,
    generator: torch.Generator,
) -> dict[str, Tensor]:
    """Return the weighted losses of a clip by name; their sum is what is minimised (the last equation of Sec. 3.6).

    As in MapTracker, frames are added up, not averaged.

    Args:
        network: with MapTracker's decoder and BEV memory, in training mode.
        clip: frames in time order.
        stage: what is trained.
        settings: weights and noise.
        step: number of the optimiser step, from 0.
        generator: of the noise, on the CPU.

    Raises:
        UserError: the network is of another kind.
    """
    encoder = network.config.bev
    if not isinstance(encoder, BevFormerConfig) or not isinstance(network.propagation, PoseTrackPropagation):
        raise UserError(f"{network.config.name} does not train in clips: it has not MapTracker's decoder and memory.")
    past = _no_past(network, len(clip[0].inputs.images))
    terms: dict[str, Tensor] = {}
    for number, frame in enumerate(clip):
        seen = _as_seen(past.state, frame.inputs, stage, settings, step, generator) if number else past.state
        with torch.set_grad_enabled(stage.trains_images(number, len(clip))):
            images = network.encode_images(frame.inputs)
            _add(terms, _depth_terms(images, frame, settings))
        bev = network.encode_bev(images, frame.inputs, seen)
        if not stage.vectors:
            _add(terms, _segmentation_terms(network.segmentation_head(bev.levels[0]), frame.targets))
            maps = store_bev_map(past.state, bev.levels[0], frame.inputs.ego_to_global, encoder.memory)
            past.state = _with_maps(past.state, maps, frame.inputs.ego_to_global)
            continue
        outputs = network.decode_bev(bev, frame.inputs, seen)
        _add(terms, _segmentation_terms(outputs.segmentation, frame.targets))
        if number:
            _add(terms, {"transformation": _transformation(network, past, seen, frame.inputs)})
        vector_terms, assigned = _vector_terms(network, outputs, frame.targets, past, settings)
        _add(terms, vector_terms)
        past = _next_tracks(network, outputs, frame, past, assigned, settings)
        if number + 1 < len(clip) and network.future_guidance is not None:
            _add(terms, {"forecast": settings.forecast * _forecast(past, clip[number + 1].targets, network)})
    return terms


def _no_past(network: PredMapNet, batch: int) -> Past:
    state = network.initial_state(batch)
    nothing = state.instances
    return Past(state, TrackTruth.none(batch, network.device), nothing.labels, nothing.points.flatten(2))


def _as_seen(
    state: StreamState,
    inputs: FrameInputs,
    stage: ClipStage,
    settings: ClipSettings,
    step: int,
    generator: torch.Generator,
) -> StreamState:
    """Return the state as the network is shown it: with wrong poses, and without the vector memory at first."""
    if not stage.vectors:
        return state
    noise = settings.angle_noise, settings.distance_noise
    state = with_pose_noise(state, inputs.ego_to_global, *noise, generator)
    return state if step >= stage.memory_from_step else _without_memory(state)


def _add(terms: dict[str, Tensor], more: dict[str, Tensor]) -> None:
    for name, term in more.items():
        terms[name] = terms[name] + term if name in terms else term


def _without_memory(state: StreamState) -> StreamState:
    """Let the decoder run as in a first frame: the vector memory is not looked at."""
    memory = state.vector_memory
    unknown = replace(memory, valid=torch.zeros_like(memory.valid))
    return replace(state, frame=torch.zeros_like(state.frame), vector_memory=unknown)


def _with_maps(state: StreamState, memory: tuple[Tensor, Tensor, Tensor], ego_to_global: Tensor) -> StreamState:
    maps, poses, valid = memory
    return replace(
        state,
        bev_memory=maps,
        bev_memory_pose=poses,
        bev_memory_valid=valid,
        ego_to_global=ego_to_global,
        frame=state.frame + 1,
    )


def _depth_terms(images: ImageFeatures, frame: ClipFrame, settings: ClipSettings) -> dict[str, Tensor]:
    """L_depth, of frames whose images are trained on."""
    if images.depth is None or frame.depth is None or not torch.is_grad_enabled():
        return {}
    blind = ~frame.inputs.camera_valid[:, :, None, None]
    return {"depth": settings.depth * depth_loss(images.depth, frame.depth.masked_fill(blind, UNKNOWN))}


def _segmentation_terms(logits: Tensor, targets: Targets) -> dict[str, Tensor]:
    """L_BEV."""
    truth = functional.adaptive_max_pool2d(targets.segmentation, logits.shape[-2:])
    focal, dice = segmentation_losses(logits, truth)
    return {"segmentation": focal, "segmentation_dice": dice}


def _vector_terms(
    network: PredMapNet, outputs: FrameOutputs, targets: Targets, past: Past, settings: ClipSettings
) -> tuple[dict[str, Tensor], LayerTargets]:
    """L_track of all decoder layers and L_seg of all masks, and the assignment of the last layer."""
    orders = all_orders(targets.points, targets.kinds)
    owned = _continued(outputs, targets, past, network)
    terms: dict[str, Tensor] = {}
    decoded = [layer for layer in outputs.layers if layer.logits is not None and layer.points is not None]
    assert decoded, "the decoder has layers"
    valid = outputs.query_valid.flatten()
    for layer in decoded:
        assert layer.logits is not None and layer.points is not None
        logits, lines = layer.logits, layer.points.flatten(2)
        assigned = _assign(logits, lines, orders, targets, outputs, past, owned)
        focal, distance = layer_losses(logits.flatten(0, 1), lines.flatten(0, 1), assigned, valid)
        _add(terms, {"focal": focal, "points": distance})
    rows = outputs.query_valid.shape[1]
    pairs = Assignment(assigned.rows // rows, assigned.rows % rows, assigned.truth)
    of_detections = _from_row(pairs, past.track_truth.kinds.shape[1])
    for layer in outputs.layers:
        if layer.masks is not None:
            # Layers of the generator refine detections only: a track has one mask, in the last layer.
            answering = pairs if layer is outputs.layers[-1] else of_detections
            masks = masks_of_size(targets.masks, layer.masks)
            loss = mask_loss(layer.masks, masks, answering, settings.mask_dice, settings.mask_entropy)
            _add(terms, {"mask": loss * len(answering) / max(len(pairs), 1)})
    return terms, assigned


def _from_row(pairs: Assignment, first: int) -> Assignment:
    """Return the pairs of row ``first`` and later ones."""
    kept = pairs.row >= first
    return Assignment(pairs.frame[kept], pairs.row[kept], pairs.truth[kept])


def _continued(outputs: FrameOutputs, targets: Targets, past: Past, network: PredMapNet) -> Tensor:
    """Return the truth ``(B, R) int64`` with which each track goes on; -1 for others. No two go on with one piece."""
    tracks = past.track_truth.kinds.shape[1]
    continued = torch.full_like(outputs.query_track_ids, -1)
    points = outputs.layers[-1].points
    assert points is not None
    size = points.new_tensor([network.config.roi_length, network.config.roi_width])
    pairs = truth_of_tracks(past.track_truth, outputs.query_valid[:, :tracks], points[:, :tracks], targets, size)
    first = torch.full((len(targets),), tracks, device=continued.device)
    first = first.scatter_reduce(0, pairs.truth, pairs.row, "amin")
    keep = first[pairs.truth] == pairs.row
    continued[pairs.frame[keep], pairs.row[keep]] = pairs.truth[keep]
    return continued


def _assign(
    logits: Tensor, lines: Tensor, orders: Tensor, targets: Targets, outputs: FrameOutputs, past: Past, owned: Tensor
) -> LayerTargets:
    """Assign the rows of all streams, one after the other."""
    tracks = past.track_truth.kinds.shape[1]
    detection = outputs.query_valid.clone()
    detection[:, :tracks] = False
    pieces = torch.bincount(targets.frame, minlength=targets.batch).tolist()
    streams, begin = [], 0
    for stream, count in enumerate(pieces):
        part = slice(begin, begin + count)
        here = torch.where(owned[stream] >= 0, owned[stream] - begin, -1)
        kinds = targets.kinds[part]
        streams.append(assign_layer(logits[stream], lines[stream], orders[part], kinds, detection[stream], here))
        begin += count
    return stacked(streams, pieces)


def _transformation(network: PredMapNet, past: Past, seen: StreamState, inputs: FrameInputs) -> Tensor:
    """Loss of the motion that carried the tracks here, with its noise."""
    assert isinstance(network.propagation, PoseTrackPropagation) and isinstance(network.map_decoder, MapTrackerDecoder)
    tracks = past.state.instances
    motion = relative_pose(seen.ego_to_global, inputs.ego_to_global)
    motion = motion[:, None].expand(-1, tracks.valid.shape[1], -1, -1)
    return transformation_loss(
        network.propagation.motion,
        network.map_decoder.read_out,
        tracks.queries[tracks.valid],
        past.labels[tracks.valid],
        past.lines[tracks.valid],
        motion[tracks.valid],
        network.config.roi,
    )


def _next_tracks(
    network: PredMapNet,
    outputs: FrameOutputs,
    frame: ClipFrame,
    past: Past,
    assigned: LayerTargets,
    settings: ClipSettings,
) -> Past:
    """Make confident rows the tracks of the next frame: those that answer for truth, and false ones."""
    logits = outputs.layers[-1].logits
    assert logits is not None
    keep = (logits.detach().sigmoid().amax(dim=-1) >= settings.track_score) & outputs.query_valid
    rows = (~keep).int().argsort(dim=1, stable=True)[:, : int(keep.sum(dim=1).max())]
    valid = keep.gather(1, rows)
    born = keep & (outputs.query_track_ids < 0)
    new_ids = past.state.next_track_id[:, None] + born.long().cumsum(dim=1) - 1
    ids = torch.where(born, new_ids, outputs.query_track_ids)
    instances = instances_from_rows(outputs, rows, valid, ids.gather(1, rows))

    batch, width = keep.shape
    answers = torch.full((batch * width,), -1, device=keep.device).scatter(0, assigned.rows, assigned.truth)
    truth = answers.view(batch, width).gather(1, rows).masked_fill(~valid, -1)

    def known(values: Tensor) -> Tensor:
        # One more entry stands for "none", so that -1 can be looked up.
        return functional.pad(values, (0, 1), value=-1)[truth]

    if network.config.history_map.memory:
        # Wrong poses are for the tracks of this frame; what is remembered of them lies where it was seen.
        motion = relative_motion(frame.inputs.ego_to_global, past.state.ego_to_global)
        outputs = replace(outputs, warped_history=network.history_memory.align(past.state.history_maps, motion))
    state = network.advance(past.state, outputs, instances, frame.inputs)
    return Past(
        state=state,
        track_truth=TrackTruth(known(frame.targets.kinds), known(frame.targets.element_ids)),
        labels=assigned.labels.view(batch, width).gather(1, rows),
        lines=assigned.lines.view(batch, width, -1).take_along_dim(rows[..., None], dim=1),
    )


def _forecast(past: Past, coming: Targets, network: PredMapNet) -> Tensor:
    """L_pred: chamfer distance of forecasts and truth of the next frame, mean over the tracks still seen there."""
    forecasts = past.state.forecasts
    size = forecasts.new_tensor([network.config.roi_length, network.config.roi_width])
    pairs = truth_of_tracks(past.track_truth, past.state.instances.valid, forecasts, coming, size)
    loss = forecast_loss(forecasts[pairs.frame, pairs.row], coming.points[pairs.truth], size)
    return loss / max(len(pairs), 1)
