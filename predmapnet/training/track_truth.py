"""True element behind each track, and which rows become the next frame's tracks in training (one-way assignment)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from mapfusion.elements import ElementKind
from predmapnet.network.state import FrameOutputs
from predmapnet.training.data.targets import Targets
from predmapnet.training.losses.matching import Assignment, curve_cost
from predmapnet.training.settings import StreamSettings


@dataclass
class TrackTruth:
    """The true element behind each track row.

    Attributes:
        kinds: ``(B, T) int64``; -1 for false tracks and padding.
        element_ids: ``(B, T) int64``; -1 likewise.
    """

    kinds: Tensor
    element_ids: Tensor

    @classmethod
    def none(cls, batch: int, device: torch.device | None = None) -> TrackTruth:
        """Return what streams without tracks begin with."""
        return cls(*torch.full((2, batch, 0), -1, device=device))


def truth_of_tracks(
    track_truth: TrackTruth, track_valid: Tensor, points: Tensor, targets: Targets, size: Tensor
) -> Assignment:
    """Find the truth that each track answers for in this frame.

    An element may be cut into several pieces by the ROI; a track answers for the piece that is nearest to it.

    Args:
        track_truth: of the ``T`` track rows.
        track_valid: ``(B, T) bool``.
        points: ``(B, T, P, 2)``, where the tracks are, normalised.
        targets: truth of the frame.
        size: ``(2,)``, metres.

    Returns:
        Pairs; tracks whose element is out of sight are absent.
    """
    pairs = []
    for frame in range(targets.batch):
        truth = torch.nonzero(targets.frame == frame)[:, 0]
        rows = torch.nonzero(track_valid[frame] & (track_truth.element_ids[frame] >= 0))[:, 0]
        if not len(truth) or not len(rows):
            continue
        same = (track_truth.kinds[frame, rows, None] == targets.kinds[truth]) & (
            track_truth.element_ids[frame, rows, None] == targets.element_ids[truth]
        )
        rings = targets.kinds[truth] == ElementKind.PED_CROSSING
        distance = curve_cost(points[frame, rows].detach() * size, targets.points[truth] * size, rings)
        nearest = distance.masked_fill(~same, torch.inf).argmin(1)
        seen = same.any(1)
        pairs.append(torch.stack([torch.full_like(rows[seen], frame), rows[seen], truth[nearest[seen]]]))
    found = torch.cat(pairs, 1) if pairs else targets.frame.new_zeros((3, 0))
    return Assignment(found[0], found[1], found[2])


@dataclass
class Chosen:
    """Which rows live on.

    Attributes:
        rows: ``(B, T') int64``, rows of this frame's predictions whose query, points and mask are taken; 0 in padding.
        identity: ``(B, T') int64``, track row whose id is kept, -1 for newborns and padding.
        valid: ``(B, T') bool``.
        track_truth: of the chosen rows.
        truth: ``(B, T') int64``, index of the truth that a row was assigned to in this frame, or -1.
    """

    rows: Tensor
    identity: Tensor
    valid: Tensor
    track_truth: TrackTruth
    truth: Tensor


def choose_tracks(
    outputs: FrameOutputs,
    track_rows: int,
    track_truth: TrackTruth,
    assignment: Assignment,
    targets: Targets,
    settings: StreamSettings,
    generator: np.random.Generator,
) -> Chosen:
    """Choose the next frame's tracks by the network's own scores; truth only names what they answer for.

    Args:
        outputs: of this frame; rows are tracks, then detections.
        track_rows: number of track rows.
        track_truth: of the track rows.
        assignment: last layer's pairs, tracks and detections.
        targets: truth of this frame.
        settings: threshold and how often what is dropped or replaced.
        generator: source of randomness.
    """
    logits = outputs.layers[-1].logits
    assert logits is not None, "the last layer must classify"
    device = logits.device
    scores = logits.detach().sigmoid().amax(2).cpu().numpy()
    valid = outputs.query_valid.cpu().numpy()
    truth = np.full(valid.shape, -1)
    frame, row, answer = (index.cpu().numpy() for index in (assignment.frame, assignment.row, assignment.truth))
    truth[frame, row] = answer
    streams = [
        _choose_of_stream(scores[b], valid[b], truth[b], track_rows, settings, generator) for b in range(len(scores))
    ]
    width = max(len(rows) for rows, _ in streams)
    rows, identity = np.zeros((len(streams), width), np.int64), np.full((len(streams), width), -1)
    kept = np.zeros((len(streams), width), np.bool_)
    for b, (chosen, same) in enumerate(streams):
        rows[b, : len(chosen)], identity[b, : len(chosen)], kept[b, : len(chosen)] = chosen, same, True
    stream = np.arange(len(streams))[:, None]
    of_truth = np.where(kept, truth[stream, rows], -1)
    of_rows, of_tracks, living, pieces = (torch.from_numpy(v).to(device) for v in (rows, identity, kept, of_truth))
    return Chosen(of_rows, of_tracks, living, _truth_of_rows(track_truth, of_tracks, pieces, targets), pieces)


def _choose_of_stream(
    scores: np.ndarray,
    valid: np.ndarray,
    truth: np.ndarray,
    track_rows: int,
    settings: StreamSettings,
    generator: np.random.Generator,
) -> tuple[list[int], list[int]]:
    """Choose rows of one stream: which rows, and whose identity each keeps (-1: born now)."""
    confident = valid & (scores > settings.score)
    continuing = [row for row in np.flatnonzero(confident[:track_rows]) if generator.random() >= settings.track_dropout]
    source = {int(row): int(row) for row in continuing}
    keeper: dict[int, int] = {}
    for row in source:
        owned = int(truth[row])
        if owned >= 0 and (owned not in keeper or scores[row] > scores[keeper[owned]]):
            keeper[owned] = row
    newborn: list[int] = []
    false: list[int] = []
    for row in (track_rows + np.flatnonzero(confident[track_rows:])).tolist():
        if truth[row] < 0:
            false.append(row)
        elif truth[row] not in keeper:
            newborn.append(row)
        elif scores[row] > scores[keeper[truth[row]]] and generator.random() < settings.refresh:
            source[keeper[truth[row]]] = row
    strays = generator.permutation(false)[: generator.integers(0, settings.false_tracks + 1)]
    newborn += [int(row) for row in strays]
    rows = [*source.values(), *newborn]
    identity = [*source.keys(), *[-1] * len(newborn)]
    if len(rows) > settings.capacity:
        best = np.argsort(-scores[rows], kind="stable")[: settings.capacity]
        rows, identity = [rows[i] for i in best], [identity[i] for i in best]
    return rows, identity


def _truth_of_rows(track_truth: TrackTruth, identity: Tensor, truth: Tensor, targets: Targets) -> TrackTruth:
    """A track keeps its element for life; a newborn belongs to the truth it was assigned to."""
    batch, width = identity.shape
    stream = torch.arange(batch, device=identity.device)[:, None]
    result = []
    for kept, of_truth in ((track_truth.kinds, targets.kinds), (track_truth.element_ids, targets.element_ids)):
        # One more column and entry stand for "none", so that -1 can be looked up.
        of_track = torch.cat([kept, kept.new_full((batch, 1), -1)], 1)[stream, identity]
        of_birth = torch.cat([of_truth, of_truth.new_full((1,), -1)])[truth]
        result.append(torch.where(identity >= 0, of_track, of_birth).reshape(batch, width))
    return TrackTruth(result[0], result[1])
