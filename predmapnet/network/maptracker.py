"""MapTracker (Chen et al. 2024), the baseline under PredMapNet: tracks polylines with a memory of maps and queries."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from predmapnet.network.bev_history import BevHistory, look_back
from predmapnet.network.bevformer import BevFormer
from predmapnet.network.camera_pillars import CameraPillars
from predmapnet.network.feature_pyramid import FeaturePyramid
from predmapnet.network.interface import FrameInputs, FrameOutputs, Instances, LayerPredictions, Selection
from predmapnet.network.maptracker_config import MapTrackerConfig
from predmapnet.network.maptracker_decoder import DecoderRows, MapTrackerDecoder
from predmapnet.network.motion_mlp import MotionMlp, pose_vector
from predmapnet.network.raster_head import RasterHead
from predmapnet.network.resnet import LEVEL_WIDTHS, ResNet50
from predmapnet.network.rigid_motion import relative_pose
from predmapnet.network.vector_memory import VectorMemory, empty_vector_memory, recall, remember


@dataclass
class MapTrackerState:
    """Everything the network remembers between two frames of ``B`` streams.

    Attributes:
        instances: the tracks, as of the last frame.
        next_track_id: ``(B,) int64``.
        frame: ``(B,) int64``, number of the next frame within its log.
        ego_to_global: ``(B, 4, 4) float64`` of the last frame.
        bev_memory: ``(B, K, C, H, W)``, past BEV maps, newest last; grows to the capacity.
        bev_memory_pose: ``(B, K, 4, 4) float64``.
        bev_memory_valid: ``(B, K) bool``.
        vector_memory: of the tracks.
    """

    instances: Instances
    next_track_id: Tensor
    frame: Tensor
    ego_to_global: Tensor
    bev_memory: Tensor
    bev_memory_pose: Tensor
    bev_memory_valid: Tensor
    vector_memory: VectorMemory


class MapTracker(nn.Module):
    """The whole network, one instant at a time; all memory is in the :class:`MapTrackerState`.

    One step of a stream::

        outputs = net(inputs, pillars, state)
        selection = select_tracks(outputs, state, net.config)
        state = net.advance(state, outputs, selection.instances, inputs)
    """

    def __init__(self, config: MapTrackerConfig) -> None:
        super().__init__()
        self.config = config
        self.image_backbone = ResNet50()
        self.neck = FeaturePyramid(LEVEL_WIDTHS, config.bev_width)
        self.bev_encoder = BevFormer(config)
        self.raster_head = RasterHead(config.bev_width, config.classes)
        self.detection_queries = nn.Parameter(torch.randn(config.queries, config.decoder_width))
        self.reference_points = nn.Linear(config.decoder_width, 2 * config.points)
        self.motion = MotionMlp(config.decoder_width, 2 * config.decoder_width)
        self.decoder = MapTrackerDecoder(config)
        self.to(memory_format=torch.channels_last)  # type: ignore[call-overload]

    def initial_state(self, batch: int) -> MapTrackerState:
        """Return the state before the first frame of ``batch`` streams."""
        config, device = self.config, self.detection_queries.device
        floats, integers = torch.zeros(batch, 0, device=device), torch.zeros(batch, 0, dtype=torch.int64, device=device)
        return MapTrackerState(
            instances=Instances(
                valid=floats.bool(),
                track_ids=integers,
                labels=integers,
                scores=floats,
                misses=integers,
                queries=torch.zeros(batch, 0, config.decoder_width, device=device),
                points=torch.zeros(batch, 0, config.points, 2, device=device),
                masks=torch.zeros(batch, 0, 0, 0, device=device),
            ),
            next_track_id=torch.zeros(batch, dtype=torch.int64, device=device),
            frame=torch.zeros(batch, dtype=torch.int64, device=device),
            ego_to_global=torch.eye(4, dtype=torch.float64, device=device).repeat(batch, 1, 1),
            bev_memory=torch.zeros(batch, 0, config.bev_width, config.rows, config.columns, device=device),
            bev_memory_pose=torch.zeros(batch, 0, 4, 4, dtype=torch.float64, device=device),
            bev_memory_valid=torch.zeros(batch, 0, dtype=torch.bool, device=device),
            vector_memory=empty_vector_memory(batch, config, device),
        )

    def forward(
        self, inputs: FrameInputs, pillars: CameraPillars, state: MapTrackerState | None = None
    ) -> FrameOutputs:
        """Map one instant of ``B`` streams.

        Args:
            inputs: images (blue, green, red; mean subtracted), which cameras count, and poses.
            pillars: of the rig that took the images.
            state: of the last frame; None begins a log.
        """
        if state is None:
            state = self.initial_state(len(inputs.images))
        history = look_back(
            state.bev_memory, state.bev_memory_pose, state.bev_memory_valid, inputs.ego_to_global, self.config
        )
        bev = self.encode_bev(inputs, pillars, history)
        rows = self.decoder_rows(state, history, inputs.ego_to_global)
        queries, predictions = self.decoder(rows, bev)
        detection_ids = state.instances.track_ids.new_full((len(bev), self.config.queries), -1)
        return FrameOutputs(
            layers=[LayerPredictions(logits, points, None) for logits, points in predictions],
            queries=queries,
            row_valid=rows.valid,
            row_track_ids=torch.cat([state.instances.track_ids, detection_ids], dim=1),
            segmentation=self.raster_head(bev),
            bev=bev,
            ego_to_global=inputs.ego_to_global,
        )

    def encode_bev(self, inputs: FrameInputs, pillars: CameraPillars, history: BevHistory) -> Tensor:
        """From images and past maps to the BEV map ``(B, C, H, W)``."""
        batch = len(inputs.images)
        # What a masked camera saw must not reach anything, not even as not-a-number.
        images = inputs.images.masked_fill(~inputs.camera_valid[:, :, None, None, None], 0.0)
        images = images.flatten(0, 1).contiguous(memory_format=torch.channels_last)
        levels = [level.unflatten(0, (batch, -1)) for level in self.neck(self.image_backbone(images))]
        return self.bev_encoder(levels, pillars, inputs.camera_valid, history.maps, history.valid)

    def decoder_rows(self, state: MapTrackerState, history: BevHistory, ego_to_global: Tensor) -> DecoderRows:
        """Return what the decoder starts from: the tracks carried here, then the detection queries."""
        batch = len(ego_to_global)
        memory = recall(state.vector_memory, self.motion, ego_to_global, state.frame, self.config)
        tracks, track_points = self.carry_tracks(state, history, ego_to_global)
        detections = self.detection_queries.expand(batch, -1, -1)
        points = self.reference_points(detections).sigmoid().unflatten(-1, (-1, 2))
        return DecoderRows(
            queries=torch.cat([tracks, detections], dim=1),
            points=torch.cat([track_points, points], dim=1),
            valid=torch.cat([state.instances.valid, state.instances.valid.new_ones(detections.shape[:2])], dim=1),
            memory=memory,
            first_frame=state.frame == 0,
        )

    def carry_tracks(self, state: MapTrackerState, history: BevHistory, ego_to_global: Tensor) -> tuple[Tensor, Tensor]:
        """Carry the tracks of the last frame into this one: queries ``(B, T, C)`` and points ``(B, T, P, 2)``.

        Queries are detached: in MapTracker's training, the motion perceptron learns from a loss of its own.
        """
        past = state.ego_to_global
        if self.config.quirks.tracks_moved_from_chosen_history and history.nearest_pose is not None:
            past = history.nearest_pose  # Released weights have learned with this pose, wrong or not.
        past_to_current = relative_pose(past, ego_to_global)
        pose = pose_vector(past_to_current)[:, None].expand(-1, state.instances.queries.shape[1], -1)
        queries = self.motion(state.instances.queries, pose.to(state.instances.queries.dtype)).detach()
        return queries, move_on_ground(state.instances.points.detach(), past_to_current, self.config)

    def advance(
        self, state: MapTrackerState | None, outputs: FrameOutputs, instances: Instances, inputs: FrameInputs
    ) -> MapTrackerState:
        """Make the state of the next frame; nothing is detached here.

        Args:
            state: that went into :meth:`forward`.
            outputs: that came out.
            instances: chosen by :func:`select_tracks` or by the training.
            inputs: of the same frame; only the poses are used.
        """
        if state is None:
            state = self.initial_state(len(inputs.ego_to_global))
        capacity, pose = self.config.history_capacity, inputs.ego_to_global
        newest = torch.cat([instances.track_ids, state.next_track_id[:, None] - 1], dim=1).amax(dim=1)
        known = state.bev_memory_valid.new_ones(len(pose), 1)
        return MapTrackerState(
            instances=instances,
            next_track_id=newest + 1,
            frame=state.frame + 1,
            ego_to_global=pose,
            bev_memory=torch.cat([state.bev_memory, outputs.bev[:, None]], dim=1)[:, -capacity:],
            bev_memory_pose=torch.cat([state.bev_memory_pose, pose[:, None]], dim=1)[:, -capacity:],
            bev_memory_valid=torch.cat([state.bev_memory_valid, known], dim=1)[:, -capacity:],
            vector_memory=remember(
                state.vector_memory,
                instances.queries,
                source_rows(instances, state.instances),
                pose,
                state.frame,
                instances.valid,
            ),
        )


def source_rows(instances: Instances, past: Instances) -> Tensor:
    """Return the row ``(B, T') int64`` that each track had in the last frame; -1 for newborn ones."""
    same = (instances.track_ids[:, :, None] == past.track_ids[:, None]) & instances.valid[:, :, None]
    same &= past.valid[:, None]
    rows = torch.arange(1, past.valid.shape[1] + 1, device=same.device)
    return (same * rows).sum(dim=-1) - 1


def move_on_ground(points: Tensor, past_to_current: Tensor, config: MapTrackerConfig) -> Tensor:
    """Move normalised points of the past ground plane into the current frame, clipped to the ROI.

    Args:
        points: ``(B, T, P, 2)``.
        past_to_current: ``(B, 4, 4) float64``.
        config: the region.
    """
    x, y = (points.double() - 0.5).flatten(1, 2).unbind(-1)
    metres = torch.stack([x * config.roi_length, y * config.roi_width], dim=-1)
    moved = metres @ past_to_current[:, :2, :2].transpose(1, 2) + past_to_current[:, None, :2, 3]
    moved = torch.stack([moved[..., 0] / config.roi_length, moved[..., 1] / config.roi_width], dim=-1) + 0.5
    return moved.clamp(0.0, 1.0).view(points.shape).to(points.dtype)


def select_tracks(outputs: FrameOutputs, state: MapTrackerState | None, config: MapTrackerConfig) -> Selection:
    """Decide which rows live on: tracks above one threshold, detections above another; no suppression, no patience.

    Args:
        outputs: of the network.
        state: that went into the network.
        config: thresholds.
    """
    logits, points = outputs.layers[-1].logits, outputs.layers[-1].points
    assert logits is not None and points is not None
    best, labels = logits.max(dim=-1)
    scores = best.sigmoid()
    is_track = outputs.row_track_ids >= 0
    birth = torch.full_like(scores[:, :1], config.first_birth_threshold)
    if state is not None:
        birth = torch.where((state.frame > 0)[:, None], config.birth_threshold, birth)
    keep = (scores > torch.where(is_track, config.keep_threshold, birth)) & outputs.row_valid
    born = keep & ~is_track
    next_id = torch.zeros_like(outputs.row_track_ids[:, :1]) if state is None else state.next_track_id[:, None]
    ids = torch.where(born, next_id + born.cumsum(dim=1) - 1, outputs.row_track_ids)

    def gather(rows: Tensor, track_ids: Tensor) -> Instances:
        order = (~rows).int().argsort(dim=1, stable=True)[:, : int(rows.sum(dim=1).max())]
        valid = rows.gather(1, order)
        return Instances(
            valid=valid,
            track_ids=track_ids.gather(1, order).masked_fill(~valid, -1),
            labels=labels.gather(1, order),
            scores=scores.gather(1, order),
            misses=torch.zeros_like(order),
            queries=outputs.queries.take_along_dim(order[..., None], dim=1),
            points=points.take_along_dim(order[..., None, None], dim=1),
            masks=scores.new_zeros(*order.shape, 0, 0),
        )

    others = outputs.row_valid & ~keep & (scores > config.report_threshold)
    return Selection(instances=gather(keep, ids), detections=gather(others, torch.full_like(ids, -1)))
