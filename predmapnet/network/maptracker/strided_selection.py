"""Strided selection (MapTracker): past frames are chosen by the distance that the car has driven since."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import torch
from torch import Tensor

from predmapnet.network.kernels.tracing import stable_order


def select_strided(
    travelled: Tensor, valid: Tensor, distances: Sequence[float], fallback: Literal["latest", "nearest"]
) -> tuple[Tensor, Tensor]:
    """Choose entries that lie about as far back as wanted.

    With as many entries as wanted distances or fewer, all are taken, in time order. Otherwise, from the largest
    distance to the smallest, the nearest entry that is at least so far away, or if there is none the farthest of
    those that are left; entries farther than one that was chosen are out. If too few are left, the fallback.

    Args:
        travelled: ``(..., K)``, how far from here each entry was made, metres; entries in time order.
        valid: ``(..., K) bool``; the valid entries are the last ones.
        distances: metres, increasing.
        fallback: the last entries in time order, or the nearest ones from far to near.

    Returns:
        Indices ``(..., S) int64`` and which of them are valid, ``S = min(K, len(distances))``; the valid ones are
        the last ones, and the very last is the nearest (or the latest).
    """
    slots = min(travelled.shape[-1], len(distances))
    latest = torch.arange(travelled.shape[-1] - slots, travelled.shape[-1], device=travelled.device)
    latest = latest.expand(*travelled.shape[:-1], slots)
    if travelled.shape[-1] <= len(distances):
        return latest, valid
    travelled = travelled.masked_fill(~valid, torch.inf)
    order = stable_order(travelled)
    near = travelled.gather(-1, order)
    entries = valid.sum(dim=-1)
    left, picks = entries, []
    for distance in reversed(distances):
        closer = (near < distance).sum(dim=-1)
        left = torch.where(closer < left, closer, left - 1)
        picks.append(left)
    strided = order.gather(-1, torch.stack(picks, dim=-1).clamp(min=0))
    nearest = order[..., :slots].flip(-1)
    strided = torch.where((left < 0)[..., None], latest if fallback == "latest" else nearest, strided)
    chosen = torch.where((entries <= len(distances))[..., None], latest, strided)
    return chosen, valid.gather(-1, chosen)
