"""Revival of lost tracks, which the paper lists among what it lacks.

A track is lost from its first frame without support on, be it that its score is low or that it left the ROI. Whether
it still lives on unsupported or has ended makes no difference: an unsupported polyline soon strays from its line. A
newborn detection of its class that lies where it was last seen, at most k frames ago, takes its id, history map and
polylines back. Nothing is computed for lost tracks while they are lost: they keep the pose of the frame in which they
were last seen, and one step brings them to the present.
"""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from mapfusion.elements import RegionOfInterest
from predmapnet.config import PredMapNetConfig, RevivalConfig
from predmapnet.network.ego_motion import move_points, relative_motion, warp_bev
from predmapnet.network.former_tracks import FormerTracks, match_tracks
from predmapnet.network.kernels.tracing import is_traced, stable_order
from predmapnet.network.state import Instances, LostTracks, StreamState

CONTESTS = 3
"""Contests for lost tracks that are settled; who loses one may win another."""

LEAST_POINTS = 3
"""A line that shows fewer of its points in the region that both could be seen in is not compared."""


@torch.no_grad()
def revive(
    instances: Instances, state: StreamState, repeats: Tensor, ego_to_global: Tensor, config: PredMapNetConfig
) -> tuple[Instances, LostTracks]:
    """Give newborn tracks the ids of lost ones where they are found to be the same.

    A newborn keeps the query that it was detected with: that one has seen this frame's images, and the propagation of
    queries has only learned to bridge a single frame.

    Args:
        instances: what lives on after this frame.
        state: of the last frame.
        repeats: ``(B, T) bool``, tracks of the last frame that were only a second one of an older track; they do not
            come back.
        ego_to_global: ``(B, 4, 4) float64``, of this frame.
        config: of the network.

    Returns:
        The instances, with the ids of the lost tracks that came back, each once; and all lost tracks, those included.
    """
    lost = _lost_tracks(instances, state, repeats, config.revival)
    newborn = instances.valid & (instances.track_ids >= state.next_track_id[:, None])
    comparable = (lost.labels[:, :, None] == instances.labels[:, None]) & lost.valid[:, :, None] & newborn[:, None]
    # In most frames there is no such pair. The selection has just waited for the device, so asking costs little.
    candidates = comparable.nonzero()
    if not is_traced() and len(candidates) == 0:
        return instances, lost
    distances = torch.full_like(comparable, torch.inf, dtype=instances.points.dtype)
    distances[candidates.unbind(dim=1)] = _distances(candidates, lost, instances.points, ego_to_global, config.roi)
    pairs = _closest_pairs(distances.masked_fill(distances >= config.revival.distance, torch.inf))
    former_ids = lost.track_ids.gather(1, pairs.long().argmax(dim=1))
    found = pairs.any(dim=1)
    # What lived on under that id without support makes way.
    replaced = _shares_id(instances.track_ids, former_ids, found)
    ids = torch.where(found, former_ids, instances.track_ids.masked_fill(replaced, -1))
    return replace(instances, valid=instances.valid & ~replaced, track_ids=ids), lost


def with_returned_tracks(
    memory: FormerTracks, instances: Instances, lost: LostTracks, ego_to_global: Tensor, roi: RegionOfInterest
) -> FormerTracks:
    """Add what is remembered of the lost tracks that came back, carried to this frame by the motion of the car.

    ``instances`` have the ids that :func:`revive` gave them, and ``lost`` is what it returned beside them.
    """
    row, found = match_tracks(instances, lost)
    revived = found & ~memory.matched
    if not is_traced() and not revived.any():
        return memory
    stream = torch.arange(len(row), device=row.device)[:, None]
    then = lost.ego_to_global[stream, row]
    maps = memory.history_maps
    if maps is not None:
        now_to_then = relative_motion(ego_to_global[:, None], then).flatten(0, 1)
        kept = lost.history_maps[stream, row]
        warped = warp_bev(kept.flatten(0, 1)[:, None], now_to_then, roi).view_as(kept)
        maps = torch.cat([maps, warped], dim=1)
    history, valid = _carried_history(lost, row, roi)
    former = memory.point_history.shape[1]
    return FormerTracks(
        source=torch.where(revived, former + torch.arange(row.shape[1], device=row.device), memory.source),
        matched=memory.matched | revived,
        history_maps=maps,
        point_history=torch.cat([memory.point_history, history], dim=1),
        point_history_valid=torch.cat([memory.point_history_valid, valid], dim=1),
    )


def still_lost(lost: LostTracks, instances: Instances) -> LostTracks:
    """Return the lost tracks without those that are seen again."""
    return replace(lost, valid=lost.valid & ~_shares_id(lost.track_ids, instances.track_ids, _supported(instances)))


def _lost_tracks(instances: Instances, state: StreamState, repeats: Tensor, rules: RevivalConfig) -> LostTracks:
    """Put the tracks that get lost in this frame before those that were lost already, and let the oldest ones go."""
    tracks, histories = state.instances, state.point_history.shape[2]
    seen = _shares_id(tracks.track_ids, instances.track_ids, _supported(instances))
    pose = state.ego_to_global[:, None]
    now = LostTracks(
        valid=_supported(tracks) & ~seen & ~repeats,
        track_ids=tracks.track_ids,
        labels=tracks.labels,
        missing=torch.zeros_like(tracks.track_ids),
        ego_to_global=pose.expand(-1, tracks.valid.shape[1], -1, -1),
        history_maps=state.history_maps,
        point_history=state.point_history,
        point_history_valid=state.point_history_valid,
        recent_poses=pose.expand(-1, histories, -1, -1),
    )
    if state.lost is None:
        return now
    missing = state.lost.missing + 1
    gone = _shares_id(state.lost.track_ids, tracks.track_ids, repeats)
    before = replace(state.lost, missing=missing, valid=state.lost.valid & (missing <= rules.frames) & ~gone)
    valid = torch.cat([now.valid, before.valid], dim=1)
    order = stable_order((~valid).long())[:, : rules.capacity]
    stream = torch.arange(len(order), device=order.device)[:, None]
    rows = {
        name: torch.cat([value, getattr(before, name)], dim=1)[stream, order]
        for name, value in vars(now).items()
        if name != "recent_poses"
    }
    return LostTracks(**rows, recent_poses=torch.cat([before.recent_poses[:, 1:], pose], dim=1))


def _supported(instances: Instances) -> Tensor:
    return instances.valid & (instances.misses == 0)


def _shares_id(ids: Tensor, others: Tensor, counted: Tensor) -> Tensor:
    """Tell which ids ``(B, n)`` are among others ``(B, m)`` that are ``counted``."""
    return ((ids[:, :, None] == others[:, None]) & counted[:, None]).any(dim=2)


def _distances(pairs: Tensor, lost: LostTracks, points: Tensor, ego_to_global: Tensor, roi: RegionOfInterest) -> Tensor:
    """Chamfer distances ``(M,)`` in metres of pairs ``(M, 3)``: stream, lost track, instance.

    Of each line only what lies in the ROI of both instants counts: the rest could not be seen at the other one.
    """
    stream, row, column = pairs.unbind(dim=1)
    size = points.new_tensor([roi.length, roi.width])
    then, now = lost.ego_to_global[stream, row], ego_to_global[stream]
    found = points[stream, column]
    carried = move_points(lost.point_history[stream, row, -1], relative_motion(then, now), roi)
    taken_back = move_points(found, relative_motion(now, then), roi)
    there = _mean_where(point_line_distances(carried * size, found * size), _inside(carried))
    back = _mean_where(point_line_distances(found * size, carried * size), _inside(taken_back))
    return (there + back) / 2


def point_line_distances(points: Tensor, lines: Tensor) -> Tensor:
    """Return the distance ``(M, P)`` of each of the points ``(M, P, 2)`` to its line ``(M, S, 2)``, metres."""
    steps = torch.diff(lines, dim=1)[:, None]
    offset = points[:, :, None] - lines[:, None, :-1]
    share = ((offset * steps).sum(dim=-1) / steps.square().sum(dim=-1).clamp(min=1e-9)).clamp(0.0, 1.0)
    return (offset - share[..., None] * steps).square().sum(dim=-1).amin(dim=-1).sqrt()


def _inside(points: Tensor) -> Tensor:
    return ((points >= 0) & (points <= 1)).all(dim=-1)


def _mean_where(values: Tensor, counted: Tensor) -> Tensor:
    """Mean over the last dimension of what is counted; infinite where that is too little."""
    number = counted.sum(dim=-1)
    mean = (values * counted).sum(dim=-1) / number.clamp(min=1)
    return mean.masked_fill(number < LEAST_POINTS, torch.inf)


def _closest_pairs(distances: Tensor) -> Tensor:
    """Pair rows with columns of ``(B, L, K)`` one to one, the closest first; infinite distances are never paired.

    Two that are each other's nearest are paired whoever else is considered first, so all such pairs are taken at once.
    """
    _, rows, columns = distances.shape
    row = torch.arange(rows, device=distances.device)[:, None]
    column = torch.arange(columns, device=distances.device)
    pairs = torch.zeros_like(distances, dtype=torch.bool)
    for _ in range(CONTESTS):
        nearest = (distances.argmin(dim=2, keepdim=True) == column) & (distances.argmin(dim=1, keepdim=True) == row)
        nearest = nearest & distances.isfinite()
        pairs = pairs | nearest
        distances = distances.masked_fill(
            nearest.any(dim=2, keepdim=True) | nearest.any(dim=1, keepdim=True), torch.inf
        )
    return pairs


def _carried_history(lost: LostTracks, row: Tensor, roi: RegionOfInterest) -> tuple[Tensor, Tensor]:
    """Histories ``(B, K, n, P, 2)`` and validity of lost tracks ``row (B, K)``, up to the last frame.

    The frames in which a track was missing are filled with its last polyline, as it lay in the ego frame of each; so
    the forecast sees the car move from one slot to the next as ever.
    """
    stream = torch.arange(len(row), device=row.device)[:, None]
    missing = lost.missing[stream, row][..., None]
    length = lost.point_history.shape[2]
    slots = torch.arange(length, device=row.device).expand(*row.shape, length)
    old = (slots + missing).clamp(max=length - 1)
    history = lost.point_history[stream[..., None], row[..., None], old]
    valid = lost.point_history_valid[stream[..., None], row[..., None], old]
    motion = relative_motion(lost.ego_to_global[stream, row][:, :, None], lost.recent_poses[:, None])
    carried = move_points(history.flatten(0, 2), motion.flatten(0, 2), roi).view_as(history)
    filled = slots >= length - missing
    return torch.where(filled[..., None, None], carried, history), valid
