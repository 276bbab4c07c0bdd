"""Inputs and outputs of the network, and the state that is handed from frame to frame.

``B`` streams (logs) are processed side by side, ``T`` is the number of track rows (padded over the streams),
``Q`` of detection queries, ``P`` of points per polyline, ``C`` the width of the decoder, ``H x W`` the BEV grid
(row 0 is the largest y, column 0 the smallest x), ``H_m x W_m`` the grid of instance masks and history maps over the
same ROI (``config.mask_size``: 25 x 50 in the lite preset; 0 x 0 where no module needs masks). Points are normalised to
``[0, 1]`` over the ROI: x forward, y left.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from torch import Tensor

from predmapnet.network.calibration import Calibration
from predmapnet.network.maptracker.reference_points import ReferencePoints
from predmapnet.network.small.ground_lookup import GroundLookup

ViewGeometry = GroundLookup | ReferencePoints
"""Ground as the cameras of some frames see it, as the BEV encoder takes it; may be kept while they stay put."""


@dataclass
class FrameInputs:
    """One instant of ``B`` streams, of any cars; ``N`` is the largest number of cameras.

    Attributes:
        images: ``(B, N, 3, h, w) float32``, as :func:`predmapnet.network.image_input.normalise_images` makes them.
        camera_valid: ``(B, N) bool``; False for a missing or late camera, and in padding.
        ego_to_global: ``(B, 4, 4) float64``.
        calibration: of the cameras.
    """

    images: Tensor
    camera_valid: Tensor
    ego_to_global: Tensor
    calibration: Calibration


@dataclass
class Instances:
    """Map instances that live on after a frame: the tracks of the next one. Rows are padded.

    Attributes:
        valid: ``(B, T) bool``.
        track_ids: ``(B, T) int64``, -1 in padding.
        labels: ``(B, T) int64``.
        scores: ``(B, T)``.
        misses: ``(B, T) int64``, frames since the score was last above the tracking threshold.
        queries: ``(B, T, C)``, last decoder layer's embedding.
        points: ``(B, T, P, 2)``, normalised, in the ego frame of the instant they were decoded at.
        masks: ``(B, T, H_m, W_m)``, probabilities of the current frame.
    """

    valid: Tensor
    track_ids: Tensor
    labels: Tensor
    scores: Tensor
    misses: Tensor
    queries: Tensor
    points: Tensor
    masks: Tensor


@dataclass
class LostTracks:
    """Tracks that were not seen lately and may come back (:mod:`predmapnet.network.revival`). Rows are padded.

    ``L`` is the number of rows; everything is as of the last frame in which the track was seen.

    Attributes:
        valid: ``(B, L) bool``.
        track_ids: ``(B, L) int64``.
        labels: ``(B, L) int64``.
        missing: ``(B, L) int64``, frames in which the track was not seen, before the present one.
        ego_to_global: ``(B, L, 4, 4) float64``.
        history_maps: ``(B, L, H_m, W_m)``.
        point_history: ``(B, L, n, P, 2)``.
        point_history_valid: ``(B, L, n) bool``.
        recent_poses: ``(B, n, 4, 4) float64``, of the stream's last n frames before the present one, oldest first.
    """

    valid: Tensor
    track_ids: Tensor
    labels: Tensor
    missing: Tensor
    ego_to_global: Tensor
    history_maps: Tensor
    point_history: Tensor
    point_history_valid: Tensor
    recent_poses: Tensor


@dataclass
class VectorMemory:
    """Queries of the tracks in past frames; rows are the tracks of the state, the newest of ``K`` entries is the last.

    A decoder without such a memory leaves it with no entries (``K = 0``).

    Attributes:
        queries: ``(B, T, K, C)``, embeddings of the last decoder layer.
        poses: ``(B, T, K, 4, 4)``, ego to global, when each entry was made.
        frames: ``(B, T, K) int64``, number of that frame within its log.
        valid: ``(B, T, K) bool``; the valid entries are the last ones.
    """

    queries: Tensor
    poses: Tensor
    frames: Tensor
    valid: Tensor


@dataclass
class StreamState:
    """Everything the network remembers between two frames; nothing is hidden in a module.

    Attributes:
        instances: the tracks, as of the last frame.
        history_maps: ``(B, T, H_m, W_m)``, history raster memory M of Sec. 3.3, in the last frame's ego frame.
        point_history: ``(B, T, n, P, 2)``, last n polylines of each track, oldest first, each in the ego frame of
            its own instant (Sec. 3.5), normalised.
        point_history_valid: ``(B, T, n) bool``.
        forecasts: ``(B, T, P, 2)``, where each track is expected in the next ego frame, normalised.
        next_track_id: ``(B,) int64``.
        frame: ``(B,) int64``, number of the next frame within its log.
        ego_to_global: ``(B, 4, 4) float64`` of the last frame.
        bev_memory: ``(B, K, C_bev, H, W)``, past BEV maps (newest last).
        bev_memory_pose: ``(B, K, 4, 4) float64``.
        bev_memory_valid: ``(B, K) bool``; the valid ones are the last ones.
        vector_memory: of the tracks.
        lost: tracks that may come back, or None where nobody keeps them.
    """

    instances: Instances
    history_maps: Tensor
    point_history: Tensor
    point_history_valid: Tensor
    forecasts: Tensor
    next_track_id: Tensor
    frame: Tensor
    ego_to_global: Tensor
    bev_memory: Tensor
    bev_memory_pose: Tensor
    bev_memory_valid: Tensor
    vector_memory: VectorMemory
    lost: LostTracks | None = None

    def tensors(self) -> dict[str, Tensor]:
        """Return the state as named tensors, to be saved (safetensors) and read back by :meth:`from_tensors`."""
        named = {name: value for name, value in vars(self).items() if isinstance(value, Tensor)}
        for part in ("instances", "vector_memory", "lost"):
            value = getattr(self, part)
            named |= {} if value is None else {f"{part}.{name}": field for name, field in vars(value).items()}
        return named

    @classmethod
    def from_tensors(cls, named: Mapping[str, Tensor]) -> StreamState:
        """Make the state that :meth:`tensors` named."""
        parts: dict[str, dict[str, Tensor]] = {"": {}, "instances": {}, "vector_memory": {}, "lost": {}}
        for name, value in named.items():
            part, _, field = name.rpartition(".")
            parts[part][field] = value
        return cls(
            instances=Instances(**parts["instances"]),
            vector_memory=VectorMemory(**parts["vector_memory"]),
            lost=LostTracks(**parts["lost"]) if parts["lost"] else None,
            **parts[""],
        )

    def forgotten(self, streams: Tensor) -> StreamState:
        """Return the state with some streams ``(B,) bool`` as if they had just begun."""
        tensors = self.tensors()
        for name, value in tensors.items():
            # Poses stay valid ones, and the large maps are not looked at.
            if not name.endswith(("ego_to_global", "pose", "poses", "bev_memory")):
                nothing = -1 if name.endswith("track_ids") else 0
                tensors[name] = value.masked_fill(streams.view(-1, *[1] * (value.ndim - 1)), nothing)
        return StreamState.from_tensors(tensors)

    def detached(self) -> StreamState:
        """Return the state without its gradient history."""
        return StreamState.from_tensors({name: value.detach() for name, value in self.tensors().items()})


@dataclass
class LayerPredictions:
    """Predictions of one decoder layer; rows are ``T`` tracks, then ``Q`` detections.

    Attributes:
        logits: ``(B, T + Q, 3)`` or None in layers that do not classify.
        points: ``(B, T + Q, P, 2)``, normalised, or None in layers that have no polyline yet.
        masks: ``(B, T + Q, H_m, W_m)`` logits, or None in layers without masks.
    """

    logits: Tensor | None
    points: Tensor | None
    masks: Tensor | None


@dataclass
class FrameOutputs:
    """Output of the network for one instant.

    Attributes:
        layers: all supervised layers, first to last; the last one is the result.
        queries: ``(B, T + Q, C)``, embedding of the last layer.
        query_valid: ``(B, T + Q) bool``; False for padded track rows.
        query_track_ids: ``(B, T + Q) int64``; -1 for detections.
        segmentation: ``(B, 3, H_s, W_s)`` logits.
        bev: ``(B, C_bev, H, W)``, BEV features that go into the memory.
        ego_to_global: ``(B, 4, 4) float64``, pose of the instant.
        depth: ``(B, N, D, h', w')`` logits of the auxiliary head, or None.
        warped_history: ``(B, T, H_m, W_m)``, history maps of the track rows in this frame's ego frame, or None.
    """

    layers: list[LayerPredictions]
    queries: Tensor
    query_valid: Tensor
    query_track_ids: Tensor
    segmentation: Tensor
    bev: Tensor
    ego_to_global: Tensor
    depth: Tensor | None = None
    warped_history: Tensor | None = None


@dataclass
class ImageFeatures:
    """Features ``(B, N, C, h_i, w_i)`` of the images of one instant, fine to coarse.

    In training there may be depth logits ``(B, N, D, h_0, w_0)`` of the auxiliary head.
    """

    levels: list[Tensor]
    depth: Tensor | None = None


@dataclass
class BevFeatures:
    """BEV features of the images of one instant.

    With the BEV encoder ``lookup`` it is all that can be known before any memory, and what a frozen-BEV stage caches.
    With ``bevformer`` past BEV maps are in it.

    Attributes:
        levels: fine to coarse: ``(B, C_0, H, W)``; unless nothing asks for it, ``(B, C_1, H / 2, W / 2)`` and
            ``(B, C_2, H / 4, W / 4)`` (rounded up).
        depth: logits of the auxiliary head, or None.
    """

    levels: list[Tensor]
    depth: Tensor | None = None


@dataclass
class Selection:
    """Selection among the rows of one frame, at inference.

    Attributes:
        instances: tracks that live on, newborns included.
        detections: further rows above the report threshold, for precision-recall curves; ``track_ids`` are -1.
        lost: tracks that ended, those that came back in this frame included; None without revival.
    """

    instances: Instances
    detections: Instances
    lost: LostTracks | None = None
