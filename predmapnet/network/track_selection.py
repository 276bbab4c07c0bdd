"""Track selection: thresholds, merging of duplicates, and identities decide which queries live on."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from mapfusion.elements import RegionOfInterest
from predmapnet.config import PredMapNetConfig, TrackingConfig
from predmapnet.network.kernels.tracing import rows_needed, stable_order
from predmapnet.network.polylines import chamfer_distances, resample_polylines
from predmapnet.network.revival import revive
from predmapnet.network.state import FrameOutputs, Instances, Selection, StreamState


@torch.no_grad()
def select(outputs: FrameOutputs, state: StreamState | None, config: PredMapNetConfig) -> Selection:
    """Decide what lives on, at inference.

    Tracks keep their ids. With merging, a track takes up the detections of its class that lie close to it: it gets the
    query and geometry of the higher score and the noisy-or of both scores, and what was taken up is gone; of two tracks
    of one thing the older lives on, of two newborns the one with the higher score. A track ends after too many
    frames without support (``tau_t``); a detection above ``tau_d`` that nothing took up is born, with the id of a lost
    track if it is found to be one.

    Without merging thresholds alone decide, as in the paper and in MapTracker: newborns are numbered in the order of
    their queries, and a track that ends is still reported, as a detection.
    """
    rules = config.tracking
    rows = _candidates(outputs, state, rules)
    tracks = rows.track_ids.shape[1]
    detection_rows, detection_scores = rows.rows[:, tracks:], rows.scores[:, tracks:]
    source, scores, alive = rows.rows[:, :tracks], rows.scores[:, :tracks], rows.valid[:, :tracks]
    free = rows.valid[:, tracks:]
    repeats = torch.zeros_like(alive)
    confident = detection_scores > _birth_threshold(state, rules)
    if rules.merge:
        distances = _line_distances(outputs, rows, config.roi, rules)
        repeats = _has_older_twin(distances[:, :tracks, :tracks], rows.track_ids, rules)
        alive = alive & ~repeats
        source, scores, taken = _take_up(distances[:, :tracks, tracks:], rows, alive, rules)
        free = free & ~taken
        free = free & ~_has_better_twin(distances[:, tracks:, tracks:], free & confident, rules)
    born = free & confident
    misses = torch.where(scores > rules.tau_t, 0, rows.misses + 1)
    alive = alive & (misses <= rules.misses_allowed)

    first_id = torch.zeros_like(born[:, 0].long()) if state is None else state.next_track_id
    new_ids = first_id[:, None] + born.long().cumsum(dim=1) - 1
    instances = _compact(
        outputs,
        rows=torch.cat([source, detection_rows], dim=1),
        valid=torch.cat([alive, born], dim=1),
        track_ids=torch.cat([rows.track_ids, new_ids], dim=1),
        misses=torch.cat([misses, torch.zeros_like(new_ids)], dim=1),
        scores=torch.cat([scores, detection_scores], dim=1),
        most=tracks,
    )
    others, reported, other_scores = detection_rows, free & ~born, detection_scores
    if not rules.merge:
        ended = rows.valid[:, :tracks] & ~alive & (scores > rules.report_threshold)
        others, reported, other_scores = rows.rows, torch.cat([ended, reported], dim=1), rows.scores
    no_id, no_misses = torch.full_like(others, -1), torch.zeros_like(others)
    detections = _compact(outputs, others, reported, no_id, no_misses, other_scores, most=others.shape[1])
    if state is None or not config.revival.enabled:
        return Selection(instances, detections)
    instances, lost = revive(instances, state, repeats, outputs.ego_to_global, config)
    return Selection(instances, detections, lost)


def _birth_threshold(state: StreamState | None, rules: TrackingConfig) -> Tensor | float:
    """Return the score above which a detection is born: one number, or ``(B, 1)`` where first frames have their own."""
    if rules.first_tau_d is None:
        return rules.tau_d
    if state is None:
        return rules.first_tau_d
    return torch.where(state.frame == 0, rules.first_tau_d, rules.tau_d)[:, None]


@dataclass
class _Rows:
    """Rows that matter: all ``T`` tracks, then the ``D`` best detections in falling order of score.

    Without merging, detections stay in the order of their queries.

    Attributes:
        rows: ``(B, T + D) int64``, rows of the outputs.
        valid: ``(B, T + D) bool``.
        scores: ``(B, T + D)``.
        labels: ``(B, T + D) int64``.
        track_ids, misses: ``(B, T) int64``.
    """

    rows: Tensor
    valid: Tensor
    scores: Tensor
    labels: Tensor
    track_ids: Tensor
    misses: Tensor


def _candidates(outputs: FrameOutputs, state: StreamState | None, rules: TrackingConfig) -> _Rows:
    logits = outputs.layers[-1].logits
    assert logits is not None
    tracks = 0 if state is None else state.instances.track_ids.shape[1]
    scores, labels = logits.sigmoid().max(dim=-1)
    detections = scores[:, tracks:]
    rank = -detections if rules.merge else (detections <= rules.report_threshold).int()
    order = stable_order(rank)
    ranked = detections.gather(1, order)
    # At least one column, so that nothing below has to think of none.
    count = max(1, rows_needed(ranked > rules.report_threshold, ranked.shape[1]))
    track_rows = torch.arange(tracks, device=scores.device).expand(len(scores), tracks)
    rows = torch.cat([track_rows, order[:, :count] + tracks], dim=1)
    enough = ranked[:, :count] > rules.report_threshold
    return _Rows(
        rows=rows,
        valid=torch.cat([outputs.query_valid[:, :tracks], enough], dim=1),
        scores=scores.gather(1, rows),
        labels=labels.gather(1, rows),
        track_ids=outputs.query_track_ids[:, :tracks],
        misses=rows[:, :0] if state is None else state.instances.misses,
    )


def _line_distances(outputs: FrameOutputs, rows: _Rows, roi: RegionOfInterest, rules: TrackingConfig) -> Tensor:
    """Chamfer distances ``(B, n, n)`` in metres; infinite between classes, to invalid rows, and beyond interest."""
    points = outputs.layers[-1].points
    assert points is not None
    size = points.new_tensor([roi.length, roi.width])
    stream = torch.arange(len(points), device=points.device)[:, None]
    lines = points[stream, rows.rows] * size
    low, high = lines.amin(dim=2), lines.amax(dim=2)
    gap = torch.maximum(low[:, :, None] - high[:, None], low[:, None] - high[:, :, None]).amax(dim=-1)
    pairs = (rows.labels[:, :, None] == rows.labels[:, None]) & rows.valid[:, :, None] & rows.valid[:, None]
    pairs = (pairs & (gap <= max(rules.merge_distance, rules.duplicate_distance))).triu(diagonal=1)
    where, first, second = pairs.nonzero(as_tuple=True)
    lines = resample_polylines(lines, rules.merge_samples)
    distances = torch.full_like(gap, torch.inf)
    distances[where, first, second] = chamfer_distances(lines[where, first], lines[where, second])
    return torch.minimum(distances, distances.transpose(1, 2))


def _has_older_twin(distances: Tensor, track_ids: Tensor, rules: TrackingConfig) -> Tensor:
    """Tell which tracks ``(B, T)`` repeat an older one; ids grow, so the smaller one is older."""
    older = track_ids[:, :, None] < track_ids[:, None, :]
    return ((distances < rules.duplicate_distance) & older).any(dim=1)


def _has_better_twin(distances: Tensor, wanted: Tensor, rules: TrackingConfig) -> Tensor:
    """Tell which detections ``(B, D)`` repeat a better one (an earlier column) that is ``wanted`` as a newborn."""
    twins = ((distances < rules.duplicate_distance) & wanted[:, :, None]).triu(diagonal=1)
    return twins.any(dim=1)


def _take_up(distances: Tensor, rows: _Rows, alive: Tensor, rules: TrackingConfig) -> tuple[Tensor, Tensor, Tensor]:
    """Merge each track with the best of the detections that lie nearest to it.

    Returns:
        Where each track now comes from ``(B, T) int64``, its score ``(B, T)``, and which detections are gone
        ``(B, D) bool``.
    """
    tracks = distances.shape[1]
    source, scores = rows.rows[:, :tracks], rows.scores[:, :tracks]
    if tracks == 0:
        return source, scores, torch.zeros_like(rows.valid[:, tracks:])
    distances = distances.masked_fill(~alive[:, :, None], torch.inf)
    near = distances < rules.merge_distance
    nearest = near & (distances == distances.amin(dim=1, keepdim=True))
    best, which = torch.where(nearest, rows.scores[:, None, tracks:], 0.0).max(dim=2)
    source = torch.where(best > scores, rows.rows[:, tracks:].gather(1, which), source)
    return source, 1 - (1 - scores) * (1 - best), near.any(dim=1)


def _compact(
    outputs: FrameOutputs, rows: Tensor, valid: Tensor, track_ids: Tensor, misses: Tensor, scores: Tensor, most: int
) -> Instances:
    """Move valid rows to the front, in their order, and cut the padding that no stream needs.

    Args:
        most: rows of the result in a traced graph, where their number cannot depend on data.
    """
    count = rows_needed(valid, most)
    order = stable_order((~valid).long())[:, :count]
    rows, valid, track_ids, misses, scores = (
        column.gather(1, order) for column in (rows, valid, track_ids, misses, scores)
    )
    return instances_from_rows(outputs, rows, valid, track_ids, misses, scores)


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
