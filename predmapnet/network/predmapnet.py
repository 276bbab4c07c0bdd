"""PredMapNet, whole: reads like Fig. 2 of the paper."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from predmapnet.config import PredMapNetConfig
from predmapnet.datasets.source import Rig
from predmapnet.network.bev_encoder import BevEncoder
from predmapnet.network.depth_head import DepthHead
from predmapnet.network.ego_motion import relative_motion
from predmapnet.network.future_guidance import ShortTermFutureGuidance, extend_history
from predmapnet.network.history_guidance import HistoryMapGuidance
from predmapnet.network.history_memory import HistoryRasterMapMemory
from predmapnet.network.image_backbone import ImageBackbone
from predmapnet.network.instance_masks import MaskHead
from predmapnet.network.interface import (
    BevFeatures,
    FrameInputs,
    FrameOutputs,
    Instances,
    LayerPredictions,
    LostTracks,
    StreamState,
)
from predmapnet.network.map_decoder import MapDecoder, visible_rows
from predmapnet.network.revival import recall, still_lost
from predmapnet.network.segmentation_head import SegmentationHead
from predmapnet.network.semantic_queries import GeneratedQueries, SemanticAwareQueryGenerator
from predmapnet.network.temporal_bev import TemporalBevFusion, empty_memory, remember_bev
from predmapnet.network.track_memory import memory_of_tracks
from predmapnet.network.track_propagation import TrackPropagation
from predmapnet.network.view_transform import RigLookup, make_rig_lookup, to_ground


class PredMapNet(nn.Module):
    """The network of the paper, one instant at a time; all memory is in the :class:`StreamState` that goes in and out.

    One step of a stream::

        outputs = net(inputs, lookup, state)
        selection = select(outputs, state, net.config)
        state = net.advance(state, outputs, selection.instances, inputs, selection.lost)
    """

    def __init__(self, config: PredMapNetConfig) -> None:
        super().__init__()
        self.config = config
        fine = config.bev.widths[0]
        self.image_backbone = ImageBackbone(config.backbone)
        self.bev_encoder = BevEncoder(config.backbone.channels, config.bev)
        self.segmentation_head = SegmentationHead(fine, config.decoder.classes)
        self.query_generator = SemanticAwareQueryGenerator(config)
        self.map_decoder = MapDecoder(config)
        self.propagation = TrackPropagation(config)
        needs_masks = config.semantic_queries.enabled or config.history_map.memory
        self.mask_head = MaskHead(config) if needs_masks else None
        self.history_memory = HistoryRasterMapMemory(config.history_map, config.roi)
        self.history_guidance = HistoryMapGuidance(config) if config.history_map.guidance else None
        self.future_guidance = ShortTermFutureGuidance(config) if config.future.enabled else None
        self.temporal_bev = TemporalBevFusion(config) if config.temporal_bev.enabled else None
        self.depth_head = DepthHead(config.backbone.channels, config.depth) if config.depth.enabled else None
        self.to(memory_format=torch.channels_last)  # type: ignore[call-overload]

    def make_rig_lookup(self, rig: Rig) -> RigLookup:
        """Precompute the view transform of a rig (cameras at the size of their stored images)."""
        return make_rig_lookup(rig, self.config).to(self.query_generator.content.device)

    def initial_state(self, batch: int) -> StreamState:
        """Return the state before the first frame of ``batch`` streams: no tracks, nothing remembered."""
        config, device = self.config, self.query_generator.content.device
        points, histories = config.decoder.points, config.future.histories
        floats, integers = torch.zeros(batch, 0, device=device), torch.zeros(batch, 0, dtype=torch.int64, device=device)
        maps, poses, valid = empty_memory(batch, config, device)
        masks = torch.zeros(batch, 0, *config.mask_size, device=device)
        polylines = torch.zeros(batch, 0, points, 2, device=device)
        instances = Instances(
            valid=floats.bool(),
            track_ids=integers,
            labels=integers,
            scores=floats,
            misses=integers,
            queries=torch.zeros(batch, 0, config.decoder.width, device=device),
            points=polylines,
            masks=masks,
        )
        return StreamState(
            instances=instances,
            history_maps=masks,
            point_history=torch.zeros(batch, 0, histories, points, 2, device=device),
            point_history_valid=torch.zeros(batch, 0, histories, dtype=torch.bool, device=device),
            forecasts=polylines,
            next_track_id=torch.zeros(batch, dtype=torch.int64, device=device),
            ego_to_global=torch.eye(4, dtype=torch.float64, device=device).expand(batch, 4, 4).clone(),
            bev_memory=maps,
            bev_memory_pose=poses,
            bev_memory_valid=valid,
        )

    def forward(self, inputs: FrameInputs, lookup: RigLookup, state: StreamState | None = None) -> FrameOutputs:
        """Map one instant of ``B`` streams.

        Args:
            inputs: images, which cameras count, and poses.
            lookup: of the rig that took the images.
            state: of the last frame; None or an empty state makes it a single-frame network.
        """
        return self.decode_bev(self.encode_bev(inputs, lookup), inputs, state)

    def encode_bev(self, inputs: FrameInputs, lookup: RigLookup) -> BevFeatures:
        """From images to BEV features, without any memory: the part that can be frozen and cached."""
        batch, cameras = inputs.images.shape[:2]
        # What a masked camera saw must not reach anything, batch statistics included.
        images = inputs.images.masked_fill(~inputs.camera_valid[:, :, None, None, None], 0.0)
        features = self.image_backbone(images.flatten(0, 1).contiguous(memory_format=torch.channels_last))
        depth = None if self.depth_head is None else self.depth_head(features).unflatten(0, (batch, cameras))
        ground = to_ground(features.unflatten(0, (batch, cameras)), inputs.camera_valid, lookup)
        fine, middle, coarse = self.bev_encoder(ground)
        return BevFeatures(fine, middle, coarse, depth)

    def decode_bev(self, bev: BevFeatures, inputs: FrameInputs, state: StreamState | None = None) -> FrameOutputs:
        """From BEV features and memory to map instances; of ``inputs`` only the poses are used."""
        fine, middle, raw = bev.fine, bev.middle, bev.fine.new_zeros(len(bev.fine), 0, *bev.fine.shape[-2:])
        if self.temporal_bev is not None:
            raw = self.temporal_bev.compress(bev.fine)
            if state is not None:
                fine, middle = self.temporal_bev(fine, middle, raw, inputs.ego_to_global, state)
        if state is None:
            state = self.initial_state(len(bev.fine))

        mask_features = None if self.mask_head is None else self.mask_head.mask_features(fine, middle)
        detections = self.query_generator([bev.coarse, middle, fine], mask_features, self.mask_head)

        tracks, references, valid, history = self._track_rows(state, inputs.ego_to_global, fine, middle)
        queries = torch.cat([tracks, detections.queries], dim=1)
        one_way = self.config.tracking.query_assignment == "one_way"
        allowed = visible_rows(valid, detections.queries.shape[1], one_way)
        embedding, refined = self.map_decoder(queries, torch.cat([references, detections.points], dim=1), fine, allowed)

        layers = self._generator_layers(detections, tracks, references, mask_features)
        layers += [LayerPredictions(logits, points, None) for logits, points in refined]
        if self.mask_head is not None and mask_features is not None:
            layers[-1].masks = self.mask_head(embedding, mask_features)
        detection_rows = valid.new_ones(len(valid), self.config.decoder.queries)
        return FrameOutputs(
            layers=layers,
            queries=embedding,
            row_valid=torch.cat([valid, detection_rows], dim=1),
            row_track_ids=torch.cat([state.instances.track_ids, detection_rows.long().neg()], dim=1),
            segmentation=self.segmentation_head(fine),
            bev=raw,
            ego_to_global=inputs.ego_to_global,
            depth=bev.depth,
            warped_history=history,
        )

    def _track_rows(
        self, state: StreamState, ego_to_global: Tensor, fine: Tensor, middle: Tensor
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Propagate the tracks of the last frame: queries, references, validity and aligned history maps."""
        past_to_current = relative_motion(state.ego_to_global, ego_to_global)
        queries, references, valid = self.propagation(state.instances, past_to_current)
        if self.future_guidance is not None:
            queries = self.future_guidance(queries, state.forecasts)
        history = state.history_maps
        if self.config.history_map.memory:
            history = self.history_memory.align(history, relative_motion(ego_to_global, state.ego_to_global))
        if self.history_guidance is not None:
            level = middle if self.config.masks.stride == 2 else fine
            queries = self.history_guidance(queries, state.instances.labels, history, level)
        return queries, references, valid, history

    def _generator_layers(
        self, detections: GeneratedQueries, tracks: Tensor, references: Tensor, mask_features: Tensor | None
    ) -> list[LayerPredictions]:
        """Predictions of the query generator; track rows say the same in all of them, the decoder's input."""
        if not detections.logits:
            points = torch.cat([references, detections.points], dim=1)
            return [LayerPredictions(None, points, None)]
        assert mask_features is not None and self.mask_head is not None
        track_logits = self.query_generator.classify(tracks)
        track_masks = self.mask_head(tracks, mask_features)
        layers = [
            LayerPredictions(torch.cat([track_logits, logits], dim=1), None, torch.cat([track_masks, masks], dim=1))
            for logits, masks in zip(detections.logits, detections.masks, strict=True)
        ]
        layers[-1].points = torch.cat([references, detections.points], dim=1)
        return layers

    def advance(
        self,
        state: StreamState | None,
        outputs: FrameOutputs,
        instances: Instances,
        inputs: FrameInputs,
        lost: LostTracks | None = None,
    ) -> StreamState:
        """Carry the instances that live on into the state of the next frame.

        Nothing is detached here: training decides how far gradients reach back.

        Args:
            state: that went into :meth:`forward`.
            outputs: that came out.
            instances: chosen by :func:`predmapnet.network.tracking.select` or by the training.
            inputs: of the same frame; only the poses are used.
            lost: what the selection says of lost tracks; without it, a track that ended is forgotten.
        """
        if state is None:
            state = self.initial_state(len(inputs.ego_to_global))
        warped = outputs.warped_history if self.config.history_map.memory else None
        memory = memory_of_tracks(instances, state, warped)
        if lost is not None:
            memory = recall(memory, instances, lost, inputs.ego_to_global, self.config.roi)
        history_maps = instances.masks
        if memory.history_maps is not None:
            history_maps = self.history_memory.update(
                instances.masks, instances.scores, memory.history_maps, memory.source, memory.matched
            )
        history, history_valid = extend_history(
            memory.point_history, memory.point_history_valid, instances.points, memory.source, memory.matched
        )
        forecasts = instances.points
        if self.future_guidance is not None:
            last_step = last_motion(state, inputs.ego_to_global)
            forecasts = self.future_guidance.forecast(history, history_valid, last_step)
        maps, poses, valid = remember_bev(state, outputs.bev, inputs.ego_to_global, self.config.temporal_bev.spacing)
        newest = torch.cat([instances.track_ids, state.next_track_id[:, None] - 1], dim=1).amax(dim=1)
        return StreamState(
            instances=instances,
            history_maps=history_maps,
            point_history=history,
            point_history_valid=history_valid,
            forecasts=forecasts,
            next_track_id=newest + 1,
            ego_to_global=inputs.ego_to_global,
            bev_memory=maps,
            bev_memory_pose=poses,
            bev_memory_valid=valid,
            lost=None if lost is None else still_lost(lost, instances),
        )


def last_motion(state: StreamState, ego_to_global: Tensor) -> Tensor:
    """Return how the ground moved ``(B, 2, 3)`` since the last frame; not at all in streams without a track so far."""
    motion = relative_motion(state.ego_to_global, ego_to_global)
    still = torch.eye(2, 3, device=motion.device)
    return torch.where((state.next_track_id > 0)[:, None, None], motion, still)
