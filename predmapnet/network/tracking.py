"""Which rows of a frame live on as tracks: thresholds, merging of duplicates, identities."""

from __future__ import annotations

import torch
from torch import Tensor

from predmapnet.network.interface import FrameOutputs, Instances


def instances_from_rows(
    outputs: FrameOutputs,
    rows: Tensor,
    valid: Tensor,
    track_ids: Tensor,
    misses: Tensor | None = None,
    scores: Tensor | None = None,
) -> Instances:
    """Gather rows of the last layer as instances.

    Args:
        outputs: of one frame.
        rows: ``(B, K) int64``, rows of ``outputs`` (anything in padding).
        valid: ``(B, K) bool``, False in padding.
        track_ids: ``(B, K) int64``.
        misses: ``(B, K) int64``; zero by default.
        scores: ``(B, K)``; those of the rows by default.
    """
    last = outputs.layers[-1]
    assert last.logits is not None and last.points is not None
    stream = torch.arange(len(rows), device=rows.device)[:, None]
    probabilities = last.logits.sigmoid()[stream, rows]
    best, labels = probabilities.max(dim=-1)
    masks = best.new_zeros(*rows.shape, 0, 0) if last.masks is None else last.masks[stream, rows].sigmoid()
    return Instances(
        valid=valid,
        track_ids=track_ids.masked_fill(~valid, -1),
        labels=labels,
        scores=(best if scores is None else scores) * valid,
        misses=torch.zeros_like(rows) if misses is None else misses,
        queries=outputs.queries[stream, rows],
        points=last.points[stream, rows],
        masks=masks,
    )


def match_tracks(instances: Instances, former: Instances) -> tuple[Tensor, Tensor]:
    """Find the row of each instance among the tracks of the last frame, by track id.

    Returns:
        ``(B, T') int64`` rows (0 where there is none) and ``(B, T') bool``, whether there is one.
    """
    if former.track_ids.shape[1] == 0:
        return torch.zeros_like(instances.track_ids), torch.zeros_like(instances.valid)
    same = instances.track_ids[:, :, None] == former.track_ids[:, None, :]
    same = same & instances.valid[:, :, None] & former.valid[:, None, :]
    return same.long().argmax(dim=2), same.any(dim=2)
