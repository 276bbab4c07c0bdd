"""The temporal stage: tracks, memories and forecasts learn in long streams over cached BEV features."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from hashlib import sha256
from itertools import count
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from mapfusion.elements import ElementKind
from predmapnet.config import LookupBevConfig
from predmapnet.errors import UserError
from predmapnet.network.predmapnet import PredMapNet
from predmapnet.network.state import BevFeatures, FrameInputs, FrameOutputs, Instances, StreamState
from predmapnet.network.track_selection import instances_from_rows
from predmapnet.training.data.batches import StreamSegment, collate_frames
from predmapnet.training.data.draws import TrainingScenes
from predmapnet.training.data.streams import FeatureStore, Streams
from predmapnet.training.data.targets import Targets
from predmapnet.training.losses.lite import forecast_loss, forecast_point_loss, frame_losses
from predmapnet.training.process_group import ProcessGroup
from predmapnet.training.settings import TrainingSettings
from predmapnet.training.single_frame import frame_inputs, roi_size
from predmapnet.training.track_truth import Chosen, TrackTruth, choose_tracks, truth_of_tracks

ENCODE_BATCH = 4
FROZEN = ("image_backbone", "bev_encoder", "depth_head")


class TemporalStage:
    """Losses of streams that carry their state from step to step; gradients reach over a clip's frames.

    Attributes:
        name: of the stage.
        frames_per_step: frames that this process sees in one step.
    """

    name = "temporal"

    def __init__(
        self,
        network: PredMapNet,
        scenes: TrainingScenes,
        settings: TrainingSettings,
        folder: Path,
        processes: ProcessGroup,
        report: Callable[[str], None] = print,
    ) -> None:
        self.frames_per_step = settings.streams.streams * settings.streams.frames
        self._network = network
        self._scenes = scenes
        self._settings = settings
        self._folder = folder
        self._processes = processes
        self._report = report
        self._size = roi_size(network.config).to(network.device)
        self._state = network.initial_state(settings.streams.streams)
        self._track_truth = TrackTruth.none(settings.streams.streams, network.device)
        self._segments: Streams | None = None

    def begin(self) -> None:
        """Freeze what makes BEV features and compute those of all frames once."""
        for part in FROZEN:
            module = getattr(self._network, part)
            if module is not None:
                module.requires_grad_(False)
        config = self._network.config
        if not isinstance(config.bev, LookupBevConfig):
            raise UserError(f"{config.name} has the past in its BEV features, so that they cannot be computed once.")
        # Halved sizes are rounded up.
        sizes = [(-(-config.bev.rows // scale), -(-config.bev.columns // scale)) for scale in (1, 2, 4)]
        shapes = tuple((width, *size) for width, size in zip(config.bev.widths, sizes, strict=True))
        store = FeatureStore(self._folder / self._fingerprint(), shapes)
        self._fill(store)
        self._processes.wait()
        settings, processes = self._settings, self._processes
        self._segments = Streams(
            self._scenes,
            store,
            settings.streams,
            settings.augmentation,
            (settings.seed, 2),
            processes.rank,
            processes.size,
        )

    def batches(self, first: int) -> Iterator[StreamSegment]:
        """Yield the next frames of all streams, step after step."""
        assert self._segments is not None, "begin() comes first"
        return map(self._segments.__getitem__, count(first))

    def losses(self, step: int, batch: StreamSegment) -> dict[str, Tensor]:
        """Return the weighted losses of the next frames, mean over frames, and carry the state on."""
        settings = self._settings.streams
        generator = np.random.default_rng([self._settings.seed, self._processes.rank, 2, step])
        forgetful = torch.from_numpy(generator.random(settings.streams) < settings.state_dropout)
        device = self._network.device
        assert batch.fresh is not None and batch.after is not None
        instants = [instant.to(device) for instant in batch.instants]
        state = forget(self._state, (batch.fresh | forgetful).to(device))
        track_truth = self._track_truth
        terms: dict[str, Tensor] = {}
        following = [instant.targets for instant in instants[1:]] + [batch.after.to(device)]
        for instant, stored, coming in zip(instants, batch.features, following, strict=True):
            features = BevFeatures([level.to(device) for level in stored.levels])
            inputs = FrameInputs(instant.images, instant.camera_valid, instant.ego_to_global, instant.calibration)
            outputs = self._network.decode_bev(features, inputs, state)
            rows = state.instances.valid.shape[1]
            points = outputs.layers[-1].points
            assert points is not None
            tracks = truth_of_tracks(
                track_truth, outputs.query_valid[:, :rows], points[:, :rows], instant.targets, self._size
            )
            weights, costs = self._settings.weights, self._settings.costs
            found = frame_losses(outputs, instant.targets, self._size, weights, costs, tracks, rows)
            chosen = choose_tracks(outputs, rows, track_truth, found.assignment, instant.targets, settings, generator)
            instances = named_instances(outputs, chosen, state)
            state = self._network.advance(state, outputs, instances, inputs)
            track_truth = chosen.track_truth
            found.terms["forecast"] = self._forecast(state, chosen, coming)
            for name, term in found.terms.items():
                share = term / len(batch.instants)
                terms[name] = terms[name] + share if name in terms else share
        self._state, self._track_truth = detached(state), track_truth
        return terms

    def _forecast(self, state: StreamState, chosen: Chosen, coming: Targets) -> Tensor:
        """Prediction loss of the tracks whose element is still there in the next frame."""
        if self._network.future_guidance is None:
            return state.forecasts.new_zeros(())
        pairs = truth_of_tracks(chosen.track_truth, chosen.valid, state.forecasts, coming, self._size)
        forecasts, truth = state.forecasts[pairs.frame, pairs.row], coming.points[pairs.truth]
        rings = coming.kinds[pairs.truth] == ElementKind.PED_CROSSING
        loss = forecast_loss(forecasts, truth, self._size)
        loss = loss + forecast_point_loss(forecasts, truth, rings, self._size)
        return self._settings.weights.forecast * loss / max(len(pairs), 1)

    def state(self) -> dict[str, Tensor]:
        """Return state and true elements of the streams."""
        tensors = {f"owners.{name}": value for name, value in vars(self._track_truth).items()}
        return tensors | {f"state.{name}": value for name, value in self._state.tensors().items()}

    def restore(self, tensors: dict[str, Tensor]) -> None:
        """Continue from what :meth:`state` returned; streams that an older version wrote have forgotten everything."""

        def part(prefix: str) -> dict[str, Tensor]:
            return {name.removeprefix(prefix): value for name, value in tensors.items() if name.startswith(prefix)}

        tensors = {name: value.to(self._network.device) for name, value in tensors.items()}
        if "state.frame" in tensors:
            self._track_truth = TrackTruth(**part("owners."))
            self._state = StreamState.from_tensors(part("state."))

    def _fingerprint(self) -> str:
        """Name of the frozen weights, so that features of others are never mixed in."""
        digest = sha256()
        for part in FROZEN:
            module = getattr(self._network, part)
            for value in [] if module is None else module.state_dict().values():
                digest.update(value.cpu().contiguous().numpy().tobytes())
        return f"features-{digest.hexdigest()[:12]}"

    @torch.no_grad()
    def _fill(self, store: FeatureStore) -> None:
        """Encode the scenes that are not stored yet, shared out over the processes."""
        self._network.eval()
        missing = [index for index in range(len(self._scenes.scenes)) if not store.has(index)]
        for done, scene in enumerate(mine := missing[self._processes.rank :: self._processes.size]):
            frames = len(self._scenes.scenes[scene])
            features = []
            for start in range(0, frames, ENCODE_BATCH):
                numbers = range(start, min(start + ENCODE_BATCH, frames))
                loaded = [self._scenes.load(scene, frame, store.mirrored(scene)) for frame in numbers]
                batch = collate_frames(loaded, self._network.config).to(self._network.device)
                inputs = frame_inputs(batch, self._network.config)
                features.append(self._network.encode_bev(self._network.encode_images(inputs), inputs))
            store.write(scene, features)
            if self._processes.leads and done % 10 == 9:
                self._report(f"BEV features: {done + 1}/{len(mine)} scenes of this process")


def named_instances(outputs: FrameOutputs, chosen: Chosen, state: StreamState) -> Instances:
    """Turn chosen rows into instances; tracks keep their ids, newborns get the next free ones."""
    newborn = chosen.valid & (chosen.identity < 0)
    fresh_ids = state.next_track_id[:, None] + newborn.long().cumsum(1) - 1
    batch = len(newborn)
    # One more column stands for "no former track".
    former = torch.cat([state.instances.track_ids, state.instances.track_ids.new_full((batch, 1), -1)], 1)
    kept_ids = former[torch.arange(batch, device=former.device)[:, None], chosen.identity]
    return instances_from_rows(outputs, chosen.rows, chosen.valid, torch.where(newborn, fresh_ids, kept_ids))


def forget(state: StreamState, streams: Tensor) -> StreamState:
    """Return the state with some streams as if they had just begun.

    Args:
        state: of ``B`` streams.
        streams: ``(B,) bool``, which ones forget.
    """
    keep = ~streams[:, None]
    instances = replace(
        state.instances,
        valid=state.instances.valid & keep,
        track_ids=state.instances.track_ids.masked_fill(~keep, -1),
    )
    return replace(
        state,
        instances=instances,
        point_history_valid=state.point_history_valid & keep[:, :, None],
        next_track_id=state.next_track_id.masked_fill(streams, 0),
        frame=state.frame.masked_fill(streams, 0),
        bev_memory_valid=state.bev_memory_valid & keep,
        lost=None if state.lost is None else replace(state.lost, valid=state.lost.valid & keep),
    )


def detached(state: StreamState) -> StreamState:
    """Return the state without its gradient history."""
    return StreamState.from_tensors({name: value.detach() for name, value in state.tensors().items()})
