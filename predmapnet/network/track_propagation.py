"""From the tracks of the last frame to the track rows of this one."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from mapfusion.elements import ElementKind
from predmapnet.config import PredMapNetConfig
from predmapnet.network.ego_motion import move_points
from predmapnet.network.interface import Instances
from predmapnet.network.layers import Perceptron
from predmapnet.network.polylines import clip_polylines


class TrackPropagation(nn.Module):
    """Carries queries by a residual perceptron of the ego motion, and polylines by the motion itself."""

    def __init__(self, config: PredMapNetConfig) -> None:
        super().__init__()
        width = config.decoder.width
        self.roi = config.roi
        self.motion = Perceptron(width + 4, width, width, zero_last=True)
        self.is_track = nn.Parameter(torch.zeros(width))

    def forward(self, tracks: Instances, past_to_current: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Propagate.

        Args:
            tracks: of the last frame.
            past_to_current: ``(B, 2, 3)``, metres.

        Returns:
            Queries ``(B, T, C)``; polylines ``(B, T, P, 2)`` in the current ego frame, normalised, clipped to the ROI
            and evenly resampled; and which rows still have something in the ROI ``(B, T) bool``.
        """
        rotation, translation = past_to_current[:, :, :2], past_to_current[:, :, 2]
        code = torch.cat([rotation[:, 0], translation / 10.0], dim=-1)
        code = code[:, None].expand(-1, tracks.queries.shape[1], -1).to(tracks.queries.dtype)
        queries = tracks.queries + self.motion(torch.cat([tracks.queries, code], dim=-1)) + self.is_track
        if tracks.points.shape[1] == 0:
            return queries, tracks.points, tracks.valid
        moved = move_points(tracks.points.detach(), past_to_current, self.roi)
        size = moved.new_tensor([self.roi.length, self.roi.width])
        references, inside = clip_polylines(moved, tracks.labels == ElementKind.PED_CROSSING, size)
        return queries, references, tracks.valid & inside
