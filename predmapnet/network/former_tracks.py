"""Memory of the last frame's tracks, found again by track id."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from predmapnet.network.state import Instances, LostTracks


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


def match_tracks(instances: Instances, former: Instances | LostTracks) -> tuple[Tensor, Tensor]:
    """Find former tracks by id: the row ``(B, T') int64`` of each instance (0 for none), and whether it has one."""
    if former.track_ids.shape[1] == 0:
        return torch.zeros_like(instances.track_ids), torch.zeros_like(instances.valid)
    same = instances.track_ids[:, :, None] == former.track_ids[:, None, :]
    same = same & instances.valid[:, :, None] & former.valid[:, None, :]
    return same.long().argmax(dim=2), same.any(dim=2)
