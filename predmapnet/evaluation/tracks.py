"""Track ids as the consistency metric of MapTracker forms them, for ground truth and for predictions without ids.

Elements of an earlier instant are moved into the current ego frame by the measured ego motion, drawn, and assigned
to the current elements of their kind by the overlap of the masks.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from mapfusion.arrays import Bool, Float, Integer
from mapfusion.elements import ElementKind, RegionOfInterest
from predmapnet.datasets.ground_truth.raster import Mask, instance_masks
from predmapnet.datasets.ground_truth.tracks import (
    TrackFrame,
    from_normalised,
    match_masks,
    official_track_ids,
    track_frame,
    warp,
)
from predmapnet.evaluation.chamfer_distance import resample_all
from predmapnet.evaluation.frames import EvaluationFrame

POINTS_PER_LINE = 20
PREDICTION_OVERLAP = 0.001
"""A prediction continues a track above this overlap."""
PREDICTION_SCORE = 0.4
"""Only predictions above this score get tracks."""
LOOK_BACK = 5
"""Frames; how far back a prediction may find its track again."""


@dataclass(frozen=True)
class FormedTracks:
    """Tracks that were formed from the predictions of one frame.

    Attributes:
        rows: ``(n,)`` rows of the frame's predictions that take part, by kind and then in the order in which they
            got their ids. The official result file keeps this order, and it decides equal scores.
        kind_ids: ``(n,)`` ids, counted from 0 per scene and kind.
        track_ids: ``(n,)`` ids that are unique in the scene over all kinds.
    """

    rows: Integer
    kind_ids: Integer
    track_ids: Integer

    def apply(self, frame: EvaluationFrame) -> EvaluationFrame:
        """Return the frame with only these predictions, in this order, with the formed ids."""
        predicted = frame.predicted
        formed = replace(
            predicted,
            kinds=predicted.kinds[self.rows],
            scores=predicted.scores[self.rows],
            track_ids=self.track_ids,
            polylines=tuple(predicted.polylines[row] for row in self.rows),
            forecasts=None,
            history_masks=None,
        )
        return replace(frame, predicted=formed)


@dataclass(frozen=True)
class _Instant:
    """Predictions of one frame as they are compared: normalised points, rows of each kind, and their masks."""

    frame: TrackFrame
    rows: tuple[Integer, ...]
    masks: tuple[Mask, ...]


def truth_track_ids(frames: Sequence[EvaluationFrame]) -> list[Integer]:
    """Track ids of the ground truth of one scene, not simplified, as the official code finds them.

    Returns:
        Per frame ``(n,)`` ids, counted from 0 per kind.
    """
    if not frames:
        return []
    roi = frames[0].predicted.roi
    return official_track_ids([track_frame(frame.truth, frame.predicted.ego_to_global, roi) for frame in frames], roi)


def form_tracks(frames: Sequence[EvaluationFrame]) -> list[FormedTracks]:
    """Form tracks from the predictions of one scene, as the official code does for methods without ids.

    Predictions above a score of 0.4 look for a partner in each of the last five frames, nearest first, and take its
    id if it is still free.
    """
    following = [0] * len(ElementKind)
    scene_ids: dict[tuple[int, int], int] = {}
    past: list[tuple[_Instant, Integer]] = []
    formed = []
    for frame in frames:
        kept = np.flatnonzero(frame.predicted.scores > PREDICTION_SCORE)
        current = _instant(frame, kept)
        kinds = current.frame.kinds
        ids = np.full(len(kept), -1, dtype=np.int64)
        taken: list[set[int]] = [set() for _ in ElementKind]
        order: list[list[int]] = [[] for _ in ElementKind]
        for instant, past_ids in reversed(past):
            partner = _partners(instant, current, ids < 0, frame.predicted.roi)
            for row in np.flatnonzero(partner >= 0):
                kind, candidate = kinds[row], int(past_ids[partner[row]])
                if candidate not in taken[kind]:
                    ids[row] = candidate
                    taken[kind].add(candidate)
                    order[kind].append(int(row))
        for row in np.flatnonzero(ids < 0):
            kind = kinds[row]
            ids[row] = following[kind]
            following[kind] += 1
            order[kind].append(int(row))
        past = [*past, (current, ids)][-LOOK_BACK:]
        rows = np.array([row for rows_of_kind in order for row in rows_of_kind], dtype=np.int64)
        keys = zip(kinds[rows].tolist(), ids[rows].tolist(), strict=True)
        unique = np.array([scene_ids.setdefault(key, len(scene_ids)) for key in keys], dtype=np.int64)
        formed.append(FormedTracks(kept[rows], ids[rows], unique))
    return formed


def _instant(frame: EvaluationFrame, rows: Integer) -> _Instant:
    predicted, roi = frame.predicted, frame.predicted.roi
    kinds = predicted.kinds[rows]
    points = resample_all([predicted.polylines[row] for row in rows], POINTS_PER_LINE)
    normalised = (points + roi.size / 2) / roi.size
    rows_of_kind = tuple(np.flatnonzero(kinds == kind) for kind in ElementKind)
    masks = tuple(_draw(kind, normalised[rows_of_kind[kind]], roi) for kind in ElementKind)
    return _Instant(TrackFrame(kinds, normalised, predicted.ego_to_global), rows_of_kind, masks)


def _draw(kind: ElementKind, normalised: Float, roi: RegionOfInterest) -> Mask:
    return instance_masks(kind, from_normalised(normalised, roi), roi)


def _partners(previous: _Instant, current: _Instant, wanted: Bool, roi: RegionOfInterest) -> Integer:
    """Row of the earlier prediction that each wanted current one continues, ``(n,)``, or -1.

    Those that are not wanted still compete, but kinds of which none is wanted are not drawn.
    """
    partner = np.full(len(current.frame.kinds), -1, dtype=np.int64)
    for kind in ElementKind:
        before, now = previous.rows[kind], current.rows[kind]
        if len(before) and wanted[now].any():
            moved = warp(previous.frame.points[before], previous.frame, current.frame, roi, single_precision=False)
            old, new = match_masks(_draw(kind, moved, roi), current.masks[kind], PREDICTION_OVERLAP)
            partner[now[new]] = before[old]
    partner[~wanted] = -1
    return partner
