"""Tracks as the consistency metric of MapTracker forms them, for ground truth and for predictions without ids.

Elements of an earlier instant are moved into the current ego frame by the measured ego motion, clipped to the ROI
coordinate by coordinate (what left it is smeared along its border, as officially), drawn, and assigned to the
current elements of their kind by the overlap of the masks.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from mapfusion.elements import ElementKind, RegionOfInterest
from mapfusion.geometry import inverse_pose
from predmapnet.evaluation.chamfer_distance import resample_all
from predmapnet.evaluation.frames import EvaluationFrame
from predmapnet.evaluation.track_masks import Words, draw_masks, mask_iou

Float = NDArray[np.float64]
Integer = NDArray[np.int64]

POINTS_PER_LINE = 20
TRUTH_OVERLAP = 0.01
"""Truths of consecutive frames are the same above this overlap."""
PREDICTION_OVERLAP = 0.001
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
    """Elements of one frame as they are compared: points in metres and masks."""

    kinds: Integer
    points: Float
    masks: Words
    ego_to_global: Float
    roi: RegionOfInterest


def truth_track_ids(frames: Sequence[EvaluationFrame]) -> list[Integer]:
    """Track ids of the ground truth of one scene, as the official code finds them.

    Args:
        frames: all frames of the scene in order; ``truth`` must not be simplified.

    Returns:
        Per frame ``(n,)`` ids, counted from 0 per kind. A truth inherits the id of the truth of the previous frame
        that it overlaps (no frame further back is looked at).
    """
    following = [0] * len(ElementKind)
    ids: list[Integer] = []
    previous: _Instant | None = None
    for frame in frames:
        current = _truth_instant(frame)
        inherited = np.full(len(current.kinds), -1, dtype=np.int64)
        if previous is not None:
            partner = _partners(previous, current, TRUTH_OVERLAP, single_precision=True)
            inherited[partner >= 0] = ids[-1][partner[partner >= 0]]
        for kind in ElementKind:
            fresh = np.flatnonzero((inherited < 0) & (current.kinds == kind))
            inherited[fresh] = following[kind] + np.arange(len(fresh))
            following[kind] += len(fresh)
        ids.append(inherited)
        previous = current
    return ids


def form_tracks(frames: Sequence[EvaluationFrame]) -> list[FormedTracks]:
    """Form tracks from the predictions of one scene, as the official code does for methods without ids.

    Predictions above a score of 0.4 look for a partner in each of the last five frames, nearest first, and take its
    id if it is still free.

    Args:
        frames: all frames of the scene in order.

    Returns:
        One entry per frame.
    """
    following = [0] * len(ElementKind)
    scene_ids: dict[tuple[int, int], int] = {}
    past: list[tuple[_Instant, Integer]] = []
    formed = []
    for frame in frames:
        kept = np.flatnonzero(frame.predicted.scores > PREDICTION_SCORE)
        current = _prediction_instant(frame, kept)
        ids = np.full(len(kept), -1, dtype=np.int64)
        taken: list[set[int]] = [set() for _ in ElementKind]
        order: list[list[int]] = [[] for _ in ElementKind]
        for instant, past_ids in reversed(past):
            partner = _partners(instant, current, PREDICTION_OVERLAP, single_precision=False)
            for row in np.flatnonzero((ids < 0) & (partner >= 0)):
                kind, candidate = current.kinds[row], int(past_ids[partner[row]])
                if candidate not in taken[kind]:
                    ids[row] = candidate
                    taken[kind].add(candidate)
                    order[kind].append(int(row))
        for row in np.flatnonzero(ids < 0):
            kind = current.kinds[row]
            ids[row] = following[kind]
            following[kind] += 1
            order[kind].append(int(row))
        past = [*past, (current, ids)][-LOOK_BACK:]
        rows = np.array([row for rows_of_kind in order for row in rows_of_kind], dtype=np.int64)
        keys = zip(current.kinds[rows].tolist(), ids[rows].tolist(), strict=True)
        unique = np.array([scene_ids.setdefault(key, len(scene_ids)) for key in keys], dtype=np.int64)
        formed.append(FormedTracks(kept[rows], ids[rows], unique))
    return formed


def _truth_instant(frame: EvaluationFrame) -> _Instant:
    roi, truth = frame.predicted.roi, frame.truth
    # The official training targets divide by the ROI plus 1e-5; tracks are formed from those.
    normalised = (resample_all(truth.polylines, POINTS_PER_LINE) + roi.size / 2) / (roi.size + 1e-5)
    points = normalised * roi.size - roi.size / 2
    return _Instant(truth.kinds, points, draw_masks(points, truth.kinds, roi), frame.predicted.ego_to_global, roi)


def _prediction_instant(frame: EvaluationFrame, rows: Integer) -> _Instant:
    predicted = frame.predicted
    kinds = predicted.kinds[rows]
    points = resample_all([predicted.polylines[row] for row in rows], POINTS_PER_LINE)
    masks = draw_masks(points, kinds, predicted.roi)
    return _Instant(kinds, points, masks, predicted.ego_to_global, predicted.roi)


def _partners(previous: _Instant, current: _Instant, overlap: float, single_precision: bool) -> Integer:
    """Row of the earlier element that each current element continues, ``(n,)``, or -1."""
    partner = np.full(len(current.kinds), -1, dtype=np.int64)
    if not len(previous.kinds) or not len(current.kinds):
        return partner
    moved = _move(previous, current, single_precision)
    masks = draw_masks(moved, previous.kinds, current.roi)
    for kind in ElementKind:
        before, now = np.flatnonzero(previous.kinds == kind), np.flatnonzero(current.kinds == kind)
        if len(before) and len(now):
            iou = mask_iou(masks[before], current.masks[now])
            first, second = linear_sum_assignment(-iou)
            same = iou[first, second] > overlap
            partner[now[second[same]]] = before[first[same]]
    return partner


def _move(previous: _Instant, current: _Instant, single_precision: bool) -> Float:
    """Points of the earlier instant in the current ego frame, clipped to the ROI, metres.

    The official code rounds to single precision at this point, and normalises truths (not predictions) in it.
    """
    previous_to_current = inverse_pose(current.ego_to_global) @ previous.ego_to_global
    moved = previous.points @ previous_to_current[:2, :2].T + previous_to_current[:2, 3]
    rounded = moved.astype(np.float32)
    size = current.roi.size
    if single_precision:
        half = (size / 2).astype(np.float32)
        normalised = np.clip((rounded + half) / size.astype(np.float32), 0.0, 1.0).astype(np.float64)
    else:
        normalised = np.clip((rounded.astype(np.float64) + size / 2) / size, 0.0, 1.0)
    back: Float = normalised * size - size / 2
    return back
