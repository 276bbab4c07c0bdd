"""Vector memory (MapTracker): queries of each track in past frames, and their recall in the current ego frame."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from predmapnet.config import MapTrackerDecoderConfig, PredMapNetConfig
from predmapnet.network.ego_motion import relative_pose
from predmapnet.network.kernels.tracing import stable_order
from predmapnet.network.layers import interleaved_sines
from predmapnet.network.maptracker.motion_mlp import MotionMlp, pose_vector
from predmapnet.network.maptracker.strided_selection import select_strided
from predmapnet.network.state import VectorMemory


@dataclass
class RecalledQueries:
    """Chosen entries of each track, carried into the current frame.

    Attributes:
        queries: ``(B, T, S, C)``; detached, as in MapTracker's training.
        code: ``(B, T, S, C)``, of their age in frames; added to attention keys.
        valid: ``(B, T, S) bool``; the valid ones come first.
        slots: ``(B, T, S) int64``, which entries of the memory these are.
        pose: ``(B, T, S, 7)``, motion vectors from then to now.
    """

    queries: Tensor
    code: Tensor
    valid: Tensor
    slots: Tensor
    pose: Tensor


def empty_vector_memory(batch: int, config: PredMapNetConfig, device: torch.device) -> VectorMemory:
    """Return a memory without tracks, and without any entry for a decoder that does not read it."""
    decoder = config.decoder
    shape, precision = (batch, 0, 0), torch.float64
    if isinstance(decoder, MapTrackerDecoderConfig):
        shape = (batch, 0, decoder.memory_capacity)
        precision = torch.float32 if decoder.quirks.single_precision_memory_poses else torch.float64
    return VectorMemory(
        queries=torch.zeros(*shape, decoder.width, device=device),
        poses=torch.zeros(*shape, 4, 4, dtype=precision, device=device),
        frames=torch.zeros(shape, dtype=torch.int64, device=device),
        valid=torch.zeros(shape, dtype=torch.bool, device=device),
    )


def recall_queries(
    memory: VectorMemory, motion: MotionMlp, ego_to_global: Tensor, frame: Tensor, distances: Sequence[float]
) -> RecalledQueries:
    """Choose entries of each track by distance and carry them into the current ego frame.

    Args:
        memory: of the last frame.
        motion: carries queries.
        ego_to_global: ``(B, 4, 4) float64``, current.
        frame: ``(B,) int64``, number of the current frame.
        distances: metres back at which entries are chosen.
    """
    # Released weights know the noise that rounded global coordinates leave in the finest sines of the motion code.
    current = ego_to_global.to(memory.poses.dtype)[:, None, None]
    travelled = (memory.poses[..., :2, 3] - current[..., :2, 3]).norm(dim=-1)
    slots, valid = select_strided(travelled, memory.valid, distances, fallback="nearest")
    first = stable_order((~valid).int())
    slots, valid = slots.gather(-1, first), valid.gather(-1, first)

    poses = memory.poses.take_along_dim(slots[..., None, None], dim=2)
    pose = pose_vector(relative_pose(poses, current)).masked_fill(~valid[..., None], 0.0)
    queries = memory.queries.take_along_dim(slots[..., None], dim=2).masked_fill(~valid[..., None], 0.0)
    carried = motion(queries, pose.to(queries.dtype)).masked_fill(~valid[..., None], 0.0).detach()
    age = frame[:, None, None] - memory.frames.gather(-1, slots)
    code = interleaved_sines(age.masked_fill(~valid, 0), queries.shape[-1]).masked_fill(~valid[..., None], 0.0)
    return RecalledQueries(carried, code, valid, slots, pose)


def store_queries(
    memory: VectorMemory,
    queries: Tensor,
    source: Tensor,
    matched: Tensor,
    ego_to_global: Tensor,
    frame: Tensor,
    valid: Tensor,
) -> VectorMemory:
    """Store the queries ``(B, T', C)`` of the tracks that live on; the oldest entry of each goes.

    Args:
        memory: of the last frame.
        queries: of this frame.
        source: ``(B, T') int64``, their row in ``memory``.
        matched: ``(B, T') bool``, whether they have one; newborn ones do not.
        ego_to_global: ``(B, 4, 4) float64``, current.
        frame: ``(B,) int64``, number of the current frame.
        valid: ``(B, T') bool``, False in padded rows.
    """

    def shifted(entries: Tensor, newest: Tensor) -> Tensor:
        kept = entries.take_along_dim(source.view(*source.shape, *[1] * (entries.ndim - 2)), dim=1)
        return torch.cat([kept[:, :, 1:], newest[:, :, None].to(entries.dtype)], dim=2)

    if memory.valid.shape[1] == 0:  # A row to take from, for newborn tracks.
        memory = VectorMemory(
            **{name: entries.new_zeros(len(entries), 1, *entries.shape[2:]) for name, entries in vars(memory).items()}
        )
    rows = queries.shape[1]
    kept_valid = shifted(memory.valid, valid)
    kept_valid[:, :, :-1] &= (matched & valid)[..., None]
    return VectorMemory(
        queries=shifted(memory.queries, queries),
        poses=shifted(memory.poses, ego_to_global[:, None].expand(-1, rows, -1, -1)),
        frames=shifted(memory.frames, frame[:, None].expand(-1, rows)),
        valid=kept_valid,
    )
