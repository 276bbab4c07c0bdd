"""Consistency-aware AP (C-mAP) of MapTracker: chamfer AP in which an element must keep its identity.

Within a scene the first predicted track that finds a true track owns it; a prediction of another track that finds
it later counts as a false positive. Frames in which a kind has no truth or no prediction are left out for that kind,
so false positives there do not count.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import groupby

import numpy as np
from numpy.typing import NDArray

from mapfusion.arrays import Integer
from mapfusion.elements import ElementKind
from predmapnet.evaluation.chamfer_ap import STANDARD_THRESHOLDS, Thresholds
from predmapnet.evaluation.chamfer_distance import (
    POINTS_PER_LINE,
    chamfer_matrix,
    match_greedily,
    resample_all,
)
from predmapnet.evaluation.frames import EvaluationFrame, simplify_all
from predmapnet.evaluation.precision_recall import AveragePrecision, Matches, accumulate
from predmapnet.evaluation.tracks import form_tracks, truth_track_ids

_TRUTH_POINTS = 20
"""The official code takes truths through this many points before it measures."""


def consistency_average_precision(
    frames: Sequence[EvaluationFrame], thresholds: Thresholds = STANDARD_THRESHOLDS, anchored: bool = True
) -> AveragePrecision:
    """C-mAP with the track ids that the predictions carry; those with track id -1 take no part.

    Scenes come one after the other, with their frames in order. Without ``anchored`` nobody asks for consistency (the
    official ``--consist 0``), which shows what it costs.
    """
    matches: list[Matches] = []
    for _, group in groupby(frames, key=lambda frame: frame.scene):
        scene = list(group)
        matches += consistency_matches(scene, matched_tracks(scene, truth_track_ids(scene), thresholds), anchored)
    return accumulate(matches, thresholds)


def with_formed_tracks(frames: Sequence[EvaluationFrame]) -> list[EvaluationFrame]:
    """Replace the track ids by ids formed from the predictions, as officially for methods without tracks."""
    formed: list[EvaluationFrame] = []
    for _, group in groupby(frames, key=lambda frame: frame.scene):
        scene = list(group)
        formed += [tracks.apply(frame) for tracks, frame in zip(form_tracks(scene), scene, strict=True)]
    return formed


def matched_tracks(
    frames: Sequence[EvaluationFrame], truth_ids: Sequence[Integer], thresholds: Thresholds = STANDARD_THRESHOLDS
) -> list[Integer]:
    """Find the true track of each tracked prediction, frame by frame: ``(n, thresholds) int64`` ids, -1 for none.

    ``truth_ids`` are per frame the ``(m,)`` track ids of the truths, unique per kind.
    """
    return [_matched_tracks(frame, ids, thresholds) for frame, ids in zip(frames, truth_ids, strict=True)]


def consistency_matches(
    frames: Sequence[EvaluationFrame], matched: Sequence[Integer], anchored: bool = True
) -> list[Matches]:
    """Decide which predictions of a scene are true positives by the :func:`matched_tracks` of its frames in order."""
    owners: dict[tuple[int, int, int], int] = {}
    matches = []
    for frame, found in zip(frames, matched, strict=True):
        kinds, tracks = frame.predicted.kinds, frame.predicted.track_ids
        match = Matches.of(kinds, frame.predicted.scores, found, frame.truth.kinds)
        counted = (tracks >= 0) & np.isin(kinds, frame.truth.kinds)
        match.flags[~counted] = -1
        if anchored:
            for column in range(found.shape[1]):
                _anchor(np.flatnonzero(counted), kinds, tracks, found[:, column], column, owners, match.flags)
        matches.append(match)
    return matches


def _matched_tracks(frame: EvaluationFrame, truth_ids: Integer, thresholds: Thresholds) -> Integer:
    matched = np.full((len(frame.predicted), len(thresholds)), -1, dtype=np.int64)
    rows = np.flatnonzero(frame.predicted.track_ids >= 0)
    if len(rows) and len(truth_ids):
        kinds = frame.predicted.kinds[rows]
        predicted = resample_all([frame.predicted.polylines[row] for row in rows], POINTS_PER_LINE)
        coarse = resample_all(simplify_all(frame.truth.polylines), _TRUTH_POINTS)
        truths = resample_all(list(coarse), POINTS_PER_LINE)
        matrix = chamfer_matrix(predicted, kinds, truths, frame.truth.kinds, limit=max(thresholds))
        found = match_greedily(matrix, frame.predicted.scores[rows], thresholds)
        matched[rows] = np.where(found >= 0, truth_ids[found], -1)
    return matched


def _anchor(
    rows: Integer,
    kinds: Integer,
    tracks: Integer,
    matched: Integer,
    column: int,
    owners: dict[tuple[int, int, int], int],
    flags: NDArray[np.int8],
) -> None:
    """Turn true positives of tracks that do not own what they found into false positives (changes ``flags``).

    If a track id is repeated within a kind, its last occurrence says what it found. "Found nothing" is treated like
    a true track too, as officially; it matters for repeated ids only.
    """
    for kind in ElementKind:
        of_kind = [row for row in rows.tolist() if kinds[row] == kind]
        found = {int(tracks[row]): int(matched[row]) for row in of_kind}
        for row in of_kind:
            track = int(tracks[row])
            owner = owners.setdefault((int(kind), column, found[track]), track)
            if owner != track:
                flags[row, column] = 0
