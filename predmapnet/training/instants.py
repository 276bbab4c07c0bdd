"""The loop over instants: what a network learns from some consecutive frames, whatever they come from.

Single frames, clips and streams differ in the data, in what goes on from instant to instant, and in the losses; all of
that stands in the :class:`~predmapnet.training.settings.Stage`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn
from torch.utils.checkpoint import checkpoint

from mapfusion.elements import ElementKind
from predmapnet.config import BevFormerConfig
from predmapnet.frame_cache.depth_targets import UNKNOWN
from predmapnet.network.ego_motion import relative_motion, relative_pose
from predmapnet.network.maptracker.bev_memory import store_bev_map
from predmapnet.network.maptracker.decoder import MapTrackerDecoder
from predmapnet.network.predmapnet import PredMapNet
from predmapnet.network.state import BevFeatures, FrameInputs, FrameOutputs, Instances, StreamState
from predmapnet.network.track_propagation import PoseTrackPropagation
from predmapnet.network.track_selection import instances_from_rows
from predmapnet.training.data.batches import Batch, StreamSegment
from predmapnet.training.losses.frame import LossSums, add_forecasts, add_layers
from predmapnet.training.losses.matching import Matched, Truth, best_order, match
from predmapnet.training.losses.terms import depth_loss, segmentation_losses, transformation_losses
from predmapnet.training.pose_noise import with_pose_noise
from predmapnet.training.run_checkpoint import below_prefix, with_prefix
from predmapnet.training.settings import Stage
from predmapnet.training.track_truth import Chosen, TrackTruth, choose_tracks

Draws = Sequence[np.random.Generator]
"""Sources of randomness, one for each stream."""


@dataclass
class Past:
    """Handover from one instant to the next: the state, whom the tracks stand for, how they were chosen, and from what.

    There is no state where every frame stands alone, and nothing was chosen before the first instant.
    """

    state: StreamState | None
    owners: TrackTruth
    chosen: Chosen | None = None
    truth: Truth | None = None


class StageTraining(nn.Module):
    """A network in one stage: from the frames of a step to the losses, whose sum is minimised.

    Attributes:
        network: what is trained.
        stage: what it learns.
        seed: of draws and noise, together with the step and the stream.
        rank: number of this process: whichever process a stream is in, it draws the same.
        carried: what the streams of the last step go on with.
        shared: averages counts over all ``processes``.
        low_precision: the image backbone and the BEV encoder compute in bfloat16; everything else never does.
        save_memory: their activations are computed again in the backward pass.
    """

    _size: Tensor
    _unit: Tensor

    def __init__(self, network: PredMapNet, stage: Stage, seed: tuple[int, ...] = (0,), rank: int = 0) -> None:
        super().__init__()
        self.network, self.stage, self.seed, self.rank = network, stage, seed, rank
        self.carried: Past | None = None
        self.shared: Callable[[Tensor], Tensor] = lambda counts: counts
        self.processes = 1
        self.low_precision = self.save_memory = False
        size = torch.tensor([network.config.roi_length, network.config.roi_width])
        self.register_buffer("_size", size, persistent=False)
        self.register_buffer("_unit", size.clone() if stage.losses.metres else torch.ones(2), persistent=False)
        network.requires_grad_(True)
        for part in stage.frozen:
            if (module := getattr(network, part)) is not None:
                module.requires_grad_(False)

    def forward(self, segment: StreamSegment, step: int, part: int = 0) -> dict[str, Tensor]:
        """Return the weighted losses of one step, or of a part of it, by name.

        Args:
            segment: frames in order of time, on the host.
            step: number of the optimiser step, from 0.
            part: of the step.
        """
        network, stage, weights = self.network, self.stage, self.stage.losses
        streams, count = len(segment.instants[0].ego_to_global), len(segment.instants)
        first = self.rank * streams
        draws = [np.random.default_rng([*self.seed, step, part, first + stream]) for stream in range(streams)]
        noise = [torch.Generator().manual_seed(int(each.integers(2**62))) for each in draws]
        past, sums = self._beginning(segment, draws), LossSums()
        following = [] if segment.after is None else [segment.after]
        targets = [instant.targets for instant in segment.instants] + following
        truths = [Truth(each, network.device, self._unit) for each in targets]
        for number, (instant, truth) in enumerate(zip(segment.instants, truths, strict=False)):
            inputs = instant.inputs(network)
            seen = self._as_seen(past.state, inputs, step, noise) if number else past.state
            if segment.features:
                bev = BevFeatures([level.to(network.device) for level in segment.features[number].levels])
            else:
                bev = self._encode(inputs, seen, instant, stage.trains_images(number, count), sums)
            if not stage.vectors:
                sums.add_all(segmentation_losses(network.segmentation_head(bev.levels[0]), truth.targets, weights))
                past.state = self._with_map(past.state, bev.levels[0], inputs)
                continue
            outputs = network.decode_bev(bev, inputs, seen)
            sums.add_all(segmentation_losses(outputs.segmentation, truth.targets, weights))
            if weights.transformation and seen is not None and past.chosen is not None and past.truth is not None:
                self._add_transformation(sums, past.state, seen, past.chosen, past.truth, inputs)
            exclusive = network.config.decoder.query_assignment == "suppress"
            matched = match(outputs, truth, past.owners, weights, exclusive)
            add_layers(sums, outputs, truth, matched, past.owners.kinds.shape[1], weights)
            if past.state is None:
                continue
            past = self._next(past, outputs, matched, truth, inputs, draws)
            if network.future_guidance is not None and number + 1 < len(truths):
                assert past.state is not None
                add_forecasts(sums, past.state.forecasts, past.owners, truths[number + 1], self._size, weights)
        if stage.data == "streams" and past.state is not None:
            self.carried = Past(past.state.detached(), past.owners)
        return sums.means(self.shared, self.processes, 1 / count if weights.mean_over_frames else 1.0)

    def tensors(self) -> dict[str, Tensor]:
        """Return what the streams go on with, for a checkpoint."""
        if self.carried is None or self.carried.state is None:
            return {}
        owners = {name: torch.from_numpy(value) for name, value in vars(self.carried.owners).items()}
        return with_prefix("owners", owners) | with_prefix("state", self.carried.state.tensors())

    def restore(self, tensors: Mapping[str, Tensor]) -> None:
        """Go on with what :meth:`tensors` returned."""
        if state := below_prefix("state", tensors):
            owners = {name: value.numpy() for name, value in below_prefix("owners", tensors).items()}
            on_device = {name: value.to(self.network.device) for name, value in state.items()}
            self.carried = Past(StreamState.from_tensors(on_device), TrackTruth(**owners))

    def _beginning(self, segment: StreamSegment, draws: Draws) -> Past:
        """Return the past of the first instant: none, or that of the last step where streams go on."""
        if self.stage.tracks is None and self.stage.vectors:
            return Past(None, TrackTruth.none(len(draws)))
        past = self.carried or Past(self.network.initial_state(len(draws)), TrackTruth.none(len(draws)))
        if segment.fresh is None or self.stage.tracks is None or past.state is None:
            return past
        forgetful = torch.tensor([each.random() < self.stage.tracks.state_dropout for each in draws])
        return Past(past.state.forgotten((segment.fresh | forgetful).to(self.network.device)), past.owners)

    def _encode(
        self, inputs: FrameInputs, seen: StreamState | None, instant: Batch, trained: bool, sums: LossSums
    ) -> BevFeatures:
        """From images to BEV features, in low precision and with little memory where asked for; adds L_depth."""
        network = self.network
        low = torch.autocast(network.device.type, torch.bfloat16) if self.low_precision else nullcontext()

        def lean(part: Callable[..., Any], *arguments: object) -> Any:
            return checkpoint(part, *arguments, use_reentrant=False) if self.save_memory else part(*arguments)

        with torch.set_grad_enabled(trained and torch.is_grad_enabled()), low:
            images = lean(network.encode_images, inputs)
        if images.depth is not None and instant.depth is not None and trained:
            bins = instant.depth.masked_fill(~instant.camera_valid[:, :, None, None], UNKNOWN)
            loss = depth_loss(images.depth.float(), bins.to(network.device))
            sums.add("depth", self.stage.losses.depth * loss, int((bins != UNKNOWN).sum()))
        with low:
            bev = lean(network.encode_bev, images, inputs, seen)
        return BevFeatures([level.float() for level in bev.levels])

    def _as_seen(
        self, state: StreamState | None, inputs: FrameInputs, step: int, noise: Sequence[torch.Generator]
    ) -> StreamState | None:
        """Return the state as the network is shown it: with wrong poses, and without the vector memory at first."""
        stage = self.stage
        if state is None or not stage.vectors:
            return state
        if stage.angle_noise or stage.distance_noise:
            state = with_pose_noise(state, inputs.ego_to_global, stage.angle_noise, stage.distance_noise, noise)
        if step >= stage.memory_from_step:
            return state
        # The decoder runs as in a first frame.
        unknown = replace(state.vector_memory, valid=torch.zeros_like(state.vector_memory.valid))
        return replace(state, frame=torch.zeros_like(state.frame), vector_memory=unknown)

    def _with_map(self, state: StreamState | None, bev: Tensor, inputs: FrameInputs) -> StreamState:
        """Remember the BEV features of an instant, and nothing else."""
        encoder = self.network.config.bev
        assert isinstance(encoder, BevFormerConfig) and state is not None
        maps, poses, valid = store_bev_map(state, bev, inputs.ego_to_global, encoder.memory)
        state = replace(state, bev_memory=maps, bev_memory_pose=poses, bev_memory_valid=valid)
        return replace(state, ego_to_global=inputs.ego_to_global, frame=state.frame + 1)

    def _add_transformation(
        self,
        sums: LossSums,
        state: StreamState | None,
        seen: StreamState,
        chosen: Chosen,
        truth: Truth,
        inputs: FrameInputs,
    ) -> None:
        """Add the loss of the motion that carried the tracks here, with its noise; ``truth`` is what they were."""
        propagation, decoder, weights = self.network.propagation, self.network.map_decoder, self.stage.losses
        assert isinstance(propagation, PoseTrackPropagation) and isinstance(decoder, MapTrackerDecoder)
        assert state is not None
        streams, rows = np.nonzero(chosen.valid)
        answers = chosen.truth[streams, rows]
        kinds = np.append(truth.kinds, self.network.config.decoder.classes)[answers]
        stream, row, piece, labels = on_device(self.network.device, streams, rows, np.maximum(answers, 0), kinds)
        points = state.instances.points[stream, row].detach()
        if len(truth.kinds):  # What stands for nothing gets any line: it does not count.
            rings = labels == ElementKind.PED_CROSSING
            points = best_order(points, truth.targets.points[piece], rings, weights.cost_beta)
        motion = relative_pose(seen.ego_to_global, inputs.ego_to_global)[stream]
        queries, roi = state.instances.queries[stream, row], self.network.config.roi
        lines, classes = transformation_losses(
            propagation.motion, decoder.read_out, queries, labels, points, motion, roi, weights
        )
        sums.add("transformation", lines, int((answers >= 0).sum()))
        sums.add("transformation", classes, len(answers))

    def _next(
        self, past: Past, outputs: FrameOutputs, matched: Matched, truth: Truth, inputs: FrameInputs, draws: Draws
    ) -> Past:
        """Choose the tracks of the next instant and carry the state on."""
        network, rules, state = self.network, self.stage.tracks, past.state
        assert rules is not None and state is not None
        chosen = choose_tracks(
            matched.scores, matched.valid, matched.truth, past.owners, truth.kinds, truth.element_ids, rules, draws
        )
        if network.config.history_map.memory:
            # Wrong poses are for the tracks of this frame; what is remembered of them lies where it was seen.
            motion = relative_motion(inputs.ego_to_global, state.ego_to_global)
            outputs = replace(outputs, warped_history=network.history_memory.align(state.history_maps, motion))
        instances = named_instances(outputs, chosen, state)
        return Past(network.advance(state, outputs, instances, inputs), chosen.owners, chosen, truth)


def on_device(device: torch.device, *arrays: np.ndarray) -> list[Tensor]:
    """Bring arrays of the host to a device."""
    return [torch.from_numpy(array).to(device) for array in arrays]


def named_instances(outputs: FrameOutputs, chosen: Chosen, state: StreamState) -> Instances:
    """Turn chosen rows into instances; tracks keep their ids, newborns get the next free ones."""
    rows, identity, valid = on_device(outputs.queries.device, chosen.rows, chosen.identity, chosen.valid)
    newborn = valid & (identity < 0)
    fresh_ids = state.next_track_id[:, None] + newborn.long().cumsum(1) - 1
    # One more column stands for "no former track".
    former = nn.functional.pad(state.instances.track_ids, (0, 1), value=-1)
    kept_ids = former[torch.arange(len(rows), device=rows.device)[:, None], identity]
    return instances_from_rows(outputs, rows, valid, torch.where(newborn, fresh_ids, kept_ids))
