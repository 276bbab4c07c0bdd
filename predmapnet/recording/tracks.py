"""Tracks of one frame with what is said of them: id, score and age; and how far their forecasts were off."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mapfusion.arrays import Bool
from mapfusion.elements import ElementKind, FrameMap
from predmapnet.evaluation.forecast import pointwise_error


@dataclass(frozen=True)
class Tracks:
    """Tracks of one frame.

    Attributes:
        frame_map: tracked elements only.
        ages: ``(n,)``, seconds since each track began.
    """

    frame_map: FrameMap
    ages: tuple[float, ...]

    @property
    def labels(self) -> list[str]:
        """Texts shown to a pointer on a track, one a track."""
        found = self.frame_map
        return [
            f"{ElementKind(kind).noun} {track}, score {score:.2f}, {age:.1f} s old"
            for kind, track, score, age in zip(found.kinds, found.track_ids, found.scores, self.ages, strict=True)
        ]

    def select(self, mask: Bool) -> Tracks:
        """Return the tracks where ``mask`` (``(n,) bool``) is true."""
        ages = tuple(age for age, chosen in zip(self.ages, mask, strict=True) if chosen)
        return Tracks(self.frame_map.select(mask), ages)


class TrackAges:
    """Birth of each track of a stream."""

    def __init__(self) -> None:
        self._born: dict[int, int] = {}

    def tracks_of(self, frame_map: FrameMap) -> Tracks:
        """Return the tracks of the next frame."""
        tracked = frame_map.tracked
        born = [self._born.setdefault(int(track), tracked.timestamp) for track in tracked.track_ids]
        return Tracks(tracked, tuple((tracked.timestamp - birth) / 1e9 for birth in born))


def forecast_errors_by_kind(expected: FrameMap, came: FrameMap) -> dict[ElementKind, float]:
    """Return how far forecasts were from the tracks that came, metres, mean by kind; only kinds that have some.

    Args:
        expected: the frame before, with forecasts for this one.
        came: this frame; tracks that went on have the same ids.
    """
    errors: dict[ElementKind, list[float]] = {}
    rows = {int(track): row for row, track in enumerate(came.track_ids)}
    for track, kind, forecast in zip(expected.track_ids, expected.kinds, expected.forecasts or (), strict=False):
        row = rows.get(int(track))
        if row is not None and len(forecast) == len(came.polylines[row]) > 1:
            ring = ElementKind(kind).is_ring
            errors.setdefault(ElementKind(kind), []).append(pointwise_error(forecast, came.polylines[row], ring))
    return {kind: float(np.mean(found)) for kind, found in errors.items()}
