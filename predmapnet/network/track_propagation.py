"""Query propagation: tracks of the last frame become track queries of this one."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from mapfusion.elements import ElementKind
from predmapnet.config import MapTrackerDecoderConfig, PredMapNetConfig
from predmapnet.network.ego_motion import move_points, plane_motion, relative_motion, relative_pose
from predmapnet.network.layers import Perceptron
from predmapnet.network.maptracker.bev_memory import nearest_pose
from predmapnet.network.maptracker.motion_mlp import MotionMlp, pose_vector
from predmapnet.network.maptracker.vector_memory import RecalledQueries, recall_queries
from predmapnet.network.polylines import clip_polylines
from predmapnet.network.state import StreamState


@dataclass
class CarriedTracks:
    """The tracks of the last frame in the current ego frame.

    Attributes:
        queries: ``(B, T, C)``.
        points: ``(B, T, P, 2)``, normalised, in [0, 1].
        valid: ``(B, T) bool``, which rows take part in this frame.
        memory: their own queries of past frames, or None.
    """

    queries: Tensor
    points: Tensor
    valid: Tensor
    memory: RecalledQueries | None = None


class TrackPropagation(nn.Module):
    """Carries queries by a residual perceptron of the ego motion, and polylines by the motion itself.

    Polylines are clipped to the ROI and evenly resampled; tracks with nothing left in it are no longer rows.
    """

    def __init__(self, config: PredMapNetConfig) -> None:
        super().__init__()
        width = config.decoder.width
        self.roi = config.roi
        self.motion = Perceptron(width + 4, width, width, zero_last=True)
        self.is_track = nn.Parameter(torch.zeros(width))

    def forward(self, state: StreamState, ego_to_global: Tensor) -> CarriedTracks:
        """Carry the tracks of the last frame to the current pose ``(B, 4, 4) float64``."""
        tracks, past_to_current = state.instances, relative_motion(state.ego_to_global, ego_to_global)
        rotation, translation = past_to_current[:, :, :2], past_to_current[:, :, 2]
        code = torch.cat([rotation[:, 0], translation / 10.0], dim=-1)
        code = code[:, None].expand(-1, tracks.queries.shape[1], -1).to(tracks.queries.dtype)
        queries = tracks.queries + self.motion(torch.cat([tracks.queries, code], dim=-1)) + self.is_track
        if tracks.points.shape[1] == 0:
            return CarriedTracks(queries, tracks.points, tracks.valid)
        moved = move_points(tracks.points.detach(), past_to_current, self.roi)
        size = moved.new_tensor([self.roi.length, self.roi.width])
        references, inside = clip_polylines(moved, tracks.labels == ElementKind.PED_CROSSING, size)
        return CarriedTracks(queries, references, tracks.valid & inside)


class PoseTrackPropagation(nn.Module):
    """MapTracker's: queries by a perceptron of the whole pose, polylines pressed against the border of the ROI.

    The perceptron also carries what each track remembers of itself. Queries are detached: it learns from a loss of its
    own (the transformation loss).
    """

    def __init__(self, config: PredMapNetConfig) -> None:
        super().__init__()
        self.config = config
        self.motion = MotionMlp(config.decoder.width, 2 * config.decoder.width)

    def forward(self, state: StreamState, ego_to_global: Tensor) -> CarriedTracks:
        """Carry the tracks of the last frame to the current pose ``(B, 4, 4) float64``."""
        decoder, tracks = self.config.decoder, state.instances
        assert isinstance(decoder, MapTrackerDecoderConfig)
        memory = recall_queries(state.vector_memory, self.motion, ego_to_global, state.frame, decoder.memory_distances)
        past = state.ego_to_global
        if decoder.quirks.tracks_moved_from_chosen_history and not self.training:
            # Released weights are run with this pose, wrong or not; in training it is that of the last frame.
            past = nearest_pose(state, ego_to_global, self.config)
        past_to_current = relative_pose(past, ego_to_global)
        pose = pose_vector(past_to_current)[:, None].expand(-1, tracks.queries.shape[1], -1)
        queries = self.motion(tracks.queries, pose.to(tracks.queries.dtype)).detach()
        moved = move_points(tracks.points.detach().double(), plane_motion(past_to_current), self.config.roi)
        return CarriedTracks(queries, moved.clamp(0.0, 1.0).to(tracks.points.dtype), tracks.valid, memory)
