"""Memory of the last frame's tracks, found again by track id."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from predmapnet.network.state import Instances, LostTracks, StreamState


@dataclass
class FormerTracks:
    """Memory of ``T`` former tracks, and which of them the ``T'`` instances of this frame continue.

    Attributes:
        source: ``(B, T') int64``, the former track that an instance continues (0 where there is none).
        matched: ``(B, T') bool``, whether it continues one.
        history_maps: ``(B, T, H_m, W_m)``, in this frame's ego frame; None without memory.
        point_history: ``(B, T, n, P, 2)``.
        point_history_valid: ``(B, T, n) bool``.
    """

    source: Tensor
    matched: Tensor
    history_maps: Tensor | None
    point_history: Tensor
    point_history_valid: Tensor


def find_former_tracks(instances: Instances, state: StreamState, warped_history: Tensor | None) -> FormerTracks:
    """Return the memory of the last frame's tracks.

    Args:
        instances: of this frame.
        state: of the last frame.
        warped_history: ``(B, T, H_m, W_m)``, its history maps in this frame's ego frame, or None.
    """
    source, matched = match_tracks(instances, state.instances)
    return FormerTracks(source, matched, warped_history, state.point_history, state.point_history_valid)


def match_tracks(instances: Instances, former: Instances | LostTracks) -> tuple[Tensor, Tensor]:
    """Find the row of each instance among former tracks, by track id.

    Returns:
        ``(B, T') int64`` rows (0 where there is none) and ``(B, T') bool``, whether there is one.
    """
    if former.track_ids.shape[1] == 0:
        return torch.zeros_like(instances.track_ids), torch.zeros_like(instances.valid)
    same = instances.track_ids[:, :, None] == former.track_ids[:, None, :]
    same = same & instances.valid[:, :, None] & former.valid[:, None, :]
    return same.long().argmax(dim=2), same.any(dim=2)
