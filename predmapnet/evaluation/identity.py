"""Id switches and track lengths of true elements while they are in view."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mapfusion.arrays import Integer
from predmapnet.evaluation.frames import EvaluationFrame


@dataclass(frozen=True)
class IdentityCounts:
    """Counts of one scene, or pooled over several.

    Attributes:
        switches: changes of the predicted track that finds a true track.
        matches: true elements found, over all frames.
        truths: true elements, over all frames.
        track_lengths: frames in which each predicted track was reported.
        true_track_lengths: the same for true tracks.
    """

    switches: int
    matches: int
    truths: int
    track_lengths: Integer
    true_track_lengths: Integer

    def figures(self) -> dict[str, object]:
        """As written to JSON; a figure that does not exist is None."""
        return {
            "id_switches": self.switches,
            "id_switches_per_100_matches": 100.0 * self.switches / self.matches if self.matches else None,
            "tracked_share": self.matches / self.truths if self.truths else None,
            "tracks": len(self.track_lengths),
            "track_length_mean": float(self.track_lengths.mean()) if len(self.track_lengths) else None,
            "true_tracks": len(self.true_track_lengths),
            "true_track_length_mean": float(self.true_track_lengths.mean()) if len(self.true_track_lengths) else None,
        }


def count_identities(
    frames: Sequence[EvaluationFrame], truth_ids: Sequence[Integer], matched: Sequence[Integer]
) -> IdentityCounts:
    """Follow the true tracks of one scene through the predictions of its frames in order.

    Args:
        frames: of the scene.
        truth_ids: per frame ``(m,)`` track ids of the truths, unique per kind.
        matched: per frame ``(n,)`` track id of the truth that each prediction finds, or -1.
    """
    last: dict[tuple[int, int], int] = {}
    tracks: Counter[int] = Counter()
    true_tracks: Counter[tuple[int, int]] = Counter()
    switches = matches = truths = 0
    for frame, ids, found in zip(frames, truth_ids, matched, strict=True):
        truths += len(ids)
        true_tracks.update(zip(frame.truth.kinds.tolist(), ids.tolist(), strict=True))
        track_ids = frame.predicted.track_ids
        tracks.update(set(track_ids[track_ids >= 0].tolist()))
        for row in np.flatnonzero(found >= 0):
            truth = (int(frame.predicted.kinds[row]), int(found[row]))
            track = int(track_ids[row])
            switches += last.get(truth, track) != track
            matches += 1
            last[truth] = track
    lengths = np.array(list(tracks.values()), dtype=np.int64)
    true_lengths = np.array(list(true_tracks.values()), dtype=np.int64)
    return IdentityCounts(int(switches), matches, truths, lengths, true_lengths)


def pool_identities(counts: Sequence[IdentityCounts]) -> IdentityCounts:
    """Add up scenes."""
    empty = np.zeros(0, dtype=np.int64)
    return IdentityCounts(
        sum(part.switches for part in counts),
        sum(part.matches for part in counts),
        sum(part.truths for part in counts),
        np.concatenate([empty, *(part.track_lengths for part in counts)]),
        np.concatenate([empty, *(part.true_track_lengths for part in counts)]),
    )
