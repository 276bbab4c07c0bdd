"""PredMapNet, the whole network: reads like Fig. 2 of the paper."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from predmapnet.config import BevFormerConfig, MapTrackerDecoderConfig, PredMapNetConfig
from predmapnet.network.bev_pyramid import BevPyramid
from predmapnet.network.calibration import Calibration
from predmapnet.network.depth_head import DepthHead
from predmapnet.network.ego_motion import relative_motion
from predmapnet.network.former_tracks import FormerTracks, match_tracks
from predmapnet.network.future_guidance import ShortTermFutureGuidance, extend_history
from predmapnet.network.history_guidance import HistoryMapGuidance
from predmapnet.network.history_memory import HistoryRasterMapMemory
from predmapnet.network.image_input import input_size
from predmapnet.network.instance_masks import MaskHead
from predmapnet.network.map_decoder import DecoderInput, MapDecoder
from predmapnet.network.maptracker.bev_memory import store_bev_map
from predmapnet.network.maptracker.bevformer import BevFormer
from predmapnet.network.maptracker.decoder import MapTrackerDecoder
from predmapnet.network.maptracker.resnet import ResNet50Pyramid
from predmapnet.network.maptracker.vector_memory import empty_vector_memory, store_queries
from predmapnet.network.revival import still_lost, with_returned_tracks
from predmapnet.network.segmentation_head import SegmentationHead, UpsamplingSegmentationHead
from predmapnet.network.semantic_queries import GeneratedQueries, SemanticAwareQueryGenerator
from predmapnet.network.small.backbone import ImageBackbone
from predmapnet.network.small.bev_encoder import BevEncoder
from predmapnet.network.small.decoder import PointDecoder
from predmapnet.network.small.residual_bev_memory import ResidualBevMemory, empty_bev_memory, store_raw_map
from predmapnet.network.state import (
    BevFeatures,
    FrameInputs,
    FrameOutputs,
    ImageFeatures,
    Instances,
    LayerPredictions,
    LostTracks,
    StreamState,
    ViewGeometry,
)
from predmapnet.network.track_propagation import CarriedTracks, PoseTrackPropagation, TrackPropagation


class PredMapNet(nn.Module):
    """The network of the paper, one instant at a time; all memory is in the :class:`StreamState` that goes in and out.

    The baseline (image backbone, BEV encoder, map decoder, propagation) comes in two sizes that share their
    interfaces; the paper's modules are the same on both, each with its switch. All switches off on MapTracker's
    baseline is MapTracker.

    One step of a stream::

        outputs = net(inputs, state)
        selection = select(outputs, state, net.config)
        state = net.advance(state, outputs, selection.instances, inputs, selection.lost)
    """

    def __init__(self, config: PredMapNetConfig) -> None:
        super().__init__()
        self.config = config
        bev, fine, classes = config.bev, config.bev.widths[0], config.decoder.classes
        self.image_backbone: nn.Module
        self.bev_encoder: BevFormer | BevEncoder
        if isinstance(bev, BevFormerConfig):
            self.image_backbone, self.bev_encoder = ResNet50Pyramid(bev.width), BevFormer(config)
            image_width, residual_memory, needs_pyramid = bev.width, False, config.semantic_queries.enabled
        else:
            self.image_backbone, self.bev_encoder = ImageBackbone(bev.backbone), BevEncoder(config)
            image_width, residual_memory, needs_pyramid = bev.backbone.channels, bev.memory.enabled, False
        self.segmentation_head = (
            UpsamplingSegmentationHead(fine, classes)
            if config.segmentation.kind == "upsampling"
            else SegmentationHead(fine, classes)
        )
        self.query_generator = SemanticAwareQueryGenerator(config)
        maptracker = isinstance(config.decoder, MapTrackerDecoderConfig)
        self.map_decoder: MapDecoder = MapTrackerDecoder(config) if maptracker else PointDecoder(config)
        self.propagation = PoseTrackPropagation(config) if maptracker else TrackPropagation(config)
        needs_masks = config.semantic_queries.enabled or config.history_map.memory
        self.mask_head = MaskHead(config) if needs_masks else None
        self.history_memory = HistoryRasterMapMemory(config.history_map, config.roi)
        self.history_guidance = HistoryMapGuidance(config) if config.history_map.guides else None
        self.future_guidance = ShortTermFutureGuidance(config) if config.future.enabled else None
        self.temporal_bev = ResidualBevMemory(config) if residual_memory else None
        self.bev_pyramid = BevPyramid(bev.widths) if needs_pyramid else None
        self.depth_head = DepthHead(image_width, config.depth) if config.depth.enabled else None
        self.to(memory_format=torch.channels_last)  # type: ignore[call-overload]

    @property
    def device(self) -> torch.device:
        """The device of the parameters."""
        return self.query_generator.content.device

    def view_geometry(self, calibration: Calibration, size: tuple[int, int] | None = None) -> ViewGeometry:
        """Find where the cameras of some frames see the ground; the result serves as long as no camera moves.

        ``size`` is rows and columns of the network's input, if not those of the configuration.
        """
        geometry: ViewGeometry = self.bev_encoder.geometry(calibration, size or input_size(self.config.image))
        return geometry

    def initial_state(self, batch: int) -> StreamState:
        """Return the state before the first frame of ``batch`` streams: no tracks, nothing remembered."""
        config, device = self.config, self.device
        points, histories = config.decoder.points, config.future.histories
        floats, integers = torch.zeros(batch, 0, device=device), torch.zeros(batch, 0, dtype=torch.int64, device=device)
        maps, poses, valid = empty_bev_memory(batch, config, device)
        masks = torch.zeros(batch, 0, *(config.mask_size if self.mask_head is not None else (0, 0)), device=device)
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
            frame=torch.zeros(batch, dtype=torch.int64, device=device),
            ego_to_global=torch.eye(4, dtype=torch.float64, device=device).expand(batch, 4, 4).clone(),
            bev_memory=maps,
            bev_memory_pose=poses,
            bev_memory_valid=valid,
            vector_memory=empty_vector_memory(batch, config, device),
        )

    def forward(
        self, inputs: FrameInputs, state: StreamState | None = None, geometry: ViewGeometry | None = None
    ) -> FrameOutputs:
        """Map one instant of ``B`` streams.

        Args:
            inputs: images, cameras and poses.
            state: of the last frame; None or an empty state makes it a single-frame network.
            geometry: :meth:`view_geometry` of these cameras, if it is known; found here otherwise.
        """
        bev = self.encode_bev(self.encode_images(inputs), inputs, state, geometry)
        return self.decode_bev(bev, inputs, state)

    def encode_images(self, inputs: FrameInputs) -> ImageFeatures:
        """From images to image features: no memory and no geometry yet."""
        valid = inputs.camera_valid
        # What a masked camera saw must not reach anything, not even as not-a-number.
        pixels = inputs.images.movedim(2, -1).masked_fill(~valid[:, :, None, None, None], 0.0)
        images = pixels.flatten(0, 1).movedim(-1, 1)
        seen = valid.flatten().nonzero()[:, 0] if self.training else None
        if seen is not None and 0 < len(seen) < len(images):  # Black images would enter the batch statistics.
            images = images[seen]
        else:
            seen = None
        levels = self.image_backbone(images.contiguous(memory_format=torch.channels_last))
        depth = self.depth_head(levels[0]) if self.depth_head is not None and self.training else None

        def of_cameras(features: Tensor) -> Tensor:
            return (features if seen is None else _spread(features, seen, valid.numel())).unflatten(0, valid.shape)

        return ImageFeatures([of_cameras(level) for level in levels], None if depth is None else of_cameras(depth))

    def encode_bev(
        self,
        images: ImageFeatures,
        inputs: FrameInputs,
        state: StreamState | None = None,
        geometry: ViewGeometry | None = None,
    ) -> BevFeatures:
        """From image features to BEV features; with the encoder ``bevformer`` the BEV memory takes part.

        Arguments are those of :meth:`forward`.
        """
        if state is None and isinstance(self.config.bev, BevFormerConfig):
            state = self.initial_state(len(inputs.camera_valid))
        if geometry is None:
            rows, columns = inputs.images.shape[-2:]
            geometry = self.view_geometry(inputs.calibration, (rows, columns))
        levels = self.bev_encoder(images.levels, inputs, geometry, state)
        if self.bev_pyramid is not None:
            levels = self.bev_pyramid(levels[0])
        return BevFeatures(levels, images.depth)

    def decode_bev(self, bev: BevFeatures, inputs: FrameInputs, state: StreamState | None = None) -> FrameOutputs:
        """From BEV features and memory to map instances; of ``inputs`` only the poses are used."""
        levels, remembered = self._with_past_maps(bev.levels, inputs.ego_to_global, state)
        if state is None:
            state = self.initial_state(len(levels[0]))
        mask_features = None if self.mask_head is None else self.mask_head.mask_features(levels)
        detections = self.query_generator(levels[::-1], mask_features, self.mask_head)
        tracks, history = self._track_rows(state, inputs.ego_to_global, levels)
        start = DecoderInput(
            queries=torch.cat([tracks.queries, detections.queries], dim=1),
            points=torch.cat([tracks.points, detections.points], dim=1),
            track_valid=tracks.valid,
            memory=tracks.memory,
            first_frame=state.frame == 0,
        )
        embedding, refined = self.map_decoder(start, levels[0])

        layers = self._generator_layers(detections, tracks, mask_features)
        layers += [LayerPredictions(logits, points, None) for logits, points in refined]
        if self.mask_head is not None and mask_features is not None:
            decoded = self.config.history_map.masks == "decoded"
            layers[-1].masks = self.mask_head(embedding if decoded else start.queries, mask_features)
        no_id = state.instances.track_ids.new_full(detections.queries.shape[:2], -1)
        return FrameOutputs(
            layers=layers,
            queries=embedding,
            query_valid=start.valid,
            query_track_ids=torch.cat([state.instances.track_ids, no_id], dim=1),
            segmentation=self.segmentation_head(levels[0]),
            bev=remembered,
            ego_to_global=inputs.ego_to_global,
            depth=bev.depth,
            warped_history=history,
        )

    def _with_past_maps(
        self, levels: list[Tensor], ego_to_global: Tensor, state: StreamState | None
    ) -> tuple[list[Tensor], Tensor]:
        """Return the levels with what past maps add to finished BEV features, and the map to be remembered."""
        fine = levels[0]
        if isinstance(self.config.bev, BevFormerConfig):
            return levels, fine
        if self.temporal_bev is None:
            return levels, fine.new_zeros(len(fine), 0, *fine.shape[-2:])
        raw = self.temporal_bev.compress(fine)
        if state is None:
            return levels, raw
        return [*self.temporal_bev(fine, levels[1], raw, ego_to_global, state), *levels[2:]], raw

    def _track_rows(
        self, state: StreamState, ego_to_global: Tensor, levels: list[Tensor]
    ) -> tuple[CarriedTracks, Tensor]:
        """Carry the tracks of the last frame and guide them by their past and future; also return aligned maps."""
        tracks, history = self.propagation(state, ego_to_global), state.history_maps
        if self.future_guidance is not None:
            tracks.queries = self.future_guidance(tracks.queries, state.forecasts)
        if self.config.history_map.memory:
            history = self.history_memory.align(history, relative_motion(ego_to_global, state.ego_to_global))
        if self.history_guidance is not None:
            level = levels[self.config.mask_level]
            tracks.queries = self.history_guidance(tracks.queries, state.instances.labels, history, level)
        return tracks, history

    def _generator_layers(
        self, detections: GeneratedQueries, tracks: CarriedTracks, mask_features: Tensor | None
    ) -> list[LayerPredictions]:
        """Predictions of the query generator; track rows say the same in all of them, the decoder's input."""
        points = None if self.map_decoder.learns_start else torch.cat([tracks.points, detections.points], dim=1)
        if not detections.masks:
            return [] if points is None else [LayerPredictions(None, points, None)]
        assert mask_features is not None and self.mask_head is not None
        track_masks = self.mask_head(tracks.queries, mask_features)
        layers = [LayerPredictions(None, None, torch.cat([track_masks, masks], dim=1)) for masks in detections.masks]
        if self.query_generator.classify is not None:
            track_logits = self.query_generator.classify(tracks.queries)
            for layer, logits in zip(layers, detections.logits, strict=True):
                layer.logits = torch.cat([track_logits, logits], dim=1)
        layers[-1].points = points
        if self.config.history_map.masks == "generated":
            layers[-1].masks = None  # They are those of the result, and are not said twice.
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
            instances: chosen by :func:`predmapnet.network.track_selection.select` or by the training.
            inputs: of the same frame; only the poses are used.
            lost: what the selection says of lost tracks; without it, a track that ended is forgotten.
        """
        if state is None:
            state = self.initial_state(len(inputs.ego_to_global))
        warped = outputs.warped_history if self.config.history_map.memory else None
        source, matched = match_tracks(instances, state.instances)
        memory = FormerTracks(source, matched, warped, state.point_history, state.point_history_valid)
        if lost is not None:
            memory = with_returned_tracks(memory, instances, lost, inputs.ego_to_global, self.config.roi)
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
            forecasts = self.future_guidance.forecast(history, history_valid, instances.labels, last_step)
        encoder, store = self.config.bev, (state, outputs.bev, inputs.ego_to_global)
        maps, poses, valid = (
            store_bev_map(*store, encoder.memory)
            if isinstance(encoder, BevFormerConfig)
            else store_raw_map(*store, encoder.memory.spacing)
        )
        queries = state.vector_memory
        if queries.valid.shape[2]:  # Tracks that came back begin anew, as their query does.
            queries = store_queries(
                queries, instances.queries, source, matched, inputs.ego_to_global, state.frame, instances.valid
            )
        newest = torch.cat([instances.track_ids, state.next_track_id[:, None] - 1], dim=1).amax(dim=1)
        return StreamState(
            instances=instances,
            history_maps=history_maps,
            point_history=history,
            point_history_valid=history_valid,
            forecasts=forecasts,
            next_track_id=newest + 1,
            frame=state.frame + 1,
            ego_to_global=inputs.ego_to_global,
            bev_memory=maps,
            bev_memory_pose=poses,
            bev_memory_valid=valid,
            vector_memory=queries,
            lost=None if lost is None else still_lost(lost, instances),
        )


def _spread(features: Tensor, rows: Tensor, count: int) -> Tensor:
    """Put features ``(M, C, h, w)`` into these rows of ``(count, C, h, w)``, channels-last; the others are zero."""
    pixels = features.permute(0, 2, 3, 1)
    return pixels.new_zeros(count, *pixels.shape[1:]).index_copy(0, rows, pixels).permute(0, 3, 1, 2)


def last_motion(state: StreamState, ego_to_global: Tensor) -> Tensor:
    """Return how the ground moved ``(B, 2, 3)`` since the last frame; not at all in streams without a track so far."""
    motion = relative_motion(state.ego_to_global, ego_to_global)
    still = torch.eye(2, 3, device=motion.device)
    return torch.where((state.next_track_id > 0)[:, None, None], motion, still)
