"""True element behind each track, and which rows are the tracks of the next frame in training."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mapfusion.arrays import Bool, Float32, Integer
from predmapnet.training.settings import TrackRules


@dataclass
class TrackTruth:
    """The true element behind each track row, on the host.

    Attributes:
        kinds: ``(B, T) int64``; -1 for false tracks and padding.
        element_ids: ``(B, T) int64``; -1 likewise.
    """

    kinds: Integer
    element_ids: Integer

    @classmethod
    def none(cls, batch: int) -> TrackTruth:
        """Return what streams without tracks begin with."""
        return cls(*np.full((2, batch, 0), -1))

    def pieces_of(self, stream: int, kinds: Integer, element_ids: Integer) -> Bool:
        """Return which pieces of truth ``(G)`` each track of a stream stands for, ``(T, G)``."""
        own_kinds, own_ids = self.kinds[stream, :, None], self.element_ids[stream, :, None]
        return (own_kinds == kinds) & (own_ids == element_ids) & (own_ids >= 0)

    def pieces_in_sight(
        self,
        stream: int,
        valid: Bool,
        kinds: Integer,
        element_ids: Integer,
        distance: Float32,
        exclusive: bool,
    ) -> tuple[Integer, Integer]:
        """Find the piece that each track of a stream answers for.

        An element may be cut into several pieces by the ROI; a track answers for the one that is nearest to it.

        Args:
            stream: number of the stream.
            valid: ``(T) bool``.
            kinds, element_ids: ``(G)``, of the pieces.
            distance: ``(T, G)``, of tracks to pieces.
            exclusive: of several tracks that answer for one piece, the first does.

        Returns:
            Track rows and their pieces; tracks whose element is out of sight are absent.
        """
        same = self.pieces_of(stream, kinds, element_ids) & valid[:, None]
        rows = np.flatnonzero(same.any(axis=1))
        if not len(rows):
            return rows, rows
        pieces = np.where(same, distance, np.inf)[rows].argmin(axis=1)
        if exclusive:
            pieces, first = np.unique(pieces, return_index=True)
            rows = rows[first]
        return rows, pieces


@dataclass
class Chosen:
    """Rows that live on, on the host.

    Attributes:
        rows: ``(B, T') int64``, rows of this frame's predictions whose query, points and mask are taken; 0 in padding.
        identity: ``(B, T') int64``, track row whose id is kept, -1 for newborns and padding.
        valid: ``(B, T') bool``.
        owners: of the chosen rows.
        truth: ``(B, T') int64``, truth that a row answers for in this frame, or -1.
    """

    rows: Integer
    identity: Integer
    valid: Bool
    owners: TrackTruth
    truth: Integer


def choose_tracks(
    scores: Float32,
    valid: Bool,
    truth: Integer,
    owners: TrackTruth,
    kinds: Integer,
    element_ids: Integer,
    rules: TrackRules,
    draws: Sequence[np.random.Generator],
) -> Chosen:
    """Choose the next frame's tracks by the network's own scores; truth only names what they answer for.

    A track keeps its element for life; a newborn belongs to the truth that it answers for, or to nothing.

    Args:
        scores, valid, truth: ``(B, R)``, of the rows of this frame (:class:`~..losses.matching.Matched`); tracks come
            first.
        owners: of the tracks.
        kinds, element_ids: ``(M)``, of the truth of this frame.
        rules: threshold and how often what is dropped or replaced.
        draws: source of randomness of each stream.
    """
    tracks = owners.kinds.shape[1]
    streams = [_choose_of_stream(*rows, tracks, rules) for rows in zip(scores, valid, truth, draws, strict=True)]
    width = max(len(rows) for rows, _ in streams)
    rows, identity = np.zeros((len(streams), width), np.int64), np.full((len(streams), width), -1)
    alive = np.zeros((len(streams), width), np.bool_)
    for number, (chosen, same) in enumerate(streams):
        rows[number, : len(chosen)], identity[number, : len(chosen)], alive[number, : len(chosen)] = chosen, same, True
    stream = np.arange(len(streams))[:, None]
    answers = np.where(alive, truth[stream, rows], -1)

    def named(of_tracks: Integer, of_truth: Integer) -> Integer:
        # One more column and entry stand for "none", so that -1 can be looked up.
        old = np.pad(of_tracks, ((0, 0), (0, 1)), constant_values=-1)[stream, identity]
        return np.where(identity >= 0, old, np.append(of_truth, -1)[answers])

    new = TrackTruth(named(owners.kinds, kinds), named(owners.element_ids, element_ids))
    return Chosen(rows, identity, alive, new, answers)


def _choose_of_stream(
    scores: Float32,
    valid: Bool,
    truth: Integer,
    draws: np.random.Generator,
    tracks: int,
    rules: TrackRules,
) -> tuple[list[int], list[int]]:
    """Choose rows of one stream: which rows, and whose identity each keeps (-1: born now)."""
    confident = np.flatnonzero(valid & (scores >= rules.score)).tolist()
    source = {row: row for row in confident if row < tracks and draws.random() >= rules.track_dropout}
    keeper: dict[int, int] = {}
    for row in source:
        owned = int(truth[row])
        if owned >= 0 and (owned not in keeper or scores[row] > scores[keeper[owned]]):
            keeper[owned] = row
    newborn: list[int] = []
    false: list[int] = []
    for row in (row for row in confident if row >= tracks):
        if truth[row] < 0:
            (newborn if rules.false_tracks is None else false).append(row)
        elif truth[row] not in keeper:
            newborn.append(row)
        elif scores[row] > scores[keeper[truth[row]]] and draws.random() < rules.refresh:
            source[keeper[truth[row]]] = row
    if rules.false_tracks is not None:
        newborn += draws.permutation(false)[: draws.integers(0, rules.false_tracks + 1)].astype(int).tolist()
    rows = [*source.values(), *newborn]
    identity = [*source.keys(), *[-1] * len(newborn)]
    if rules.capacity is not None and len(rows) > rules.capacity:
        best = np.argsort(-scores[rows], kind="stable")[: rules.capacity]
        rows, identity = [rows[i] for i in best], [identity[i] for i in best]
    return rows, identity
