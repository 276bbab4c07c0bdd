"""Curve of stations along a line, with the sums of the observations at each of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mapfusion.arrays import Float, Marks

INFORMATION, SEEN, SEEN_VIEW, OBSERVATIONS, SCATTER = range(5)
"""Columns of :attr:`StationCurve.sums`."""

PLACES, TRACKS = range(2)
"""Columns of :attr:`StationCurve.marks`."""


@dataclass
class StationCurve:
    """Curve of stations along a line, about one spacing apart; arrays of equal length.

    Attributes:
        points: ``(n, 2) float64``, metres, global frame.
        sums: ``(n, 5) float64``, sums over the observations: information (inverse variance across the line, 1 / m²),
            sightings weighted by score, view weights of those sightings, 1, and information times squared distance
            from the fused station.
        marks: ``(n, 2) uint64``, bits for the places from which the station was seen and for the tracks
            (:mod:`mapfusion.integrate.uncertainty`).
    """

    points: Float
    sums: Float
    marks: Marks

    def __len__(self) -> int:
        return len(self.points)

    @property
    def information(self) -> Float:
        """``(n,) float64``, inverse variance across the line if errors were independent, 1 / m²."""
        return self.sums[:, INFORMATION]

    @property
    def seen(self) -> Float:
        """``(n,) float64``, sum of sightings, weighted by score."""
        return self.sums[:, SEEN]

    @property
    def seen_view(self) -> Float:
        """``(n,) float64``, sum of the view weights of those sightings."""
        return self.sums[:, SEEN_VIEW]

    def part(self, start: int, stop: int) -> StationCurve:
        """Return stations ``start`` to ``stop`` (excluded)."""
        return StationCurve(self.points[start:stop], self.sums[start:stop], self.marks[start:stop])

    def reversed(self) -> StationCurve:
        """Return the curve with its stations in the opposite order."""
        return StationCurve(self.points[::-1], self.sums[::-1], self.marks[::-1])

    def copy(self) -> StationCurve:
        """Return a curve with arrays of its own."""
        return StationCurve(self.points.copy(), self.sums.copy(), self.marks.copy())

    @staticmethod
    def join(parts: Sequence[StationCurve]) -> StationCurve:
        """Put curves end to end."""
        return StationCurve(
            np.concatenate([part.points for part in parts]),
            np.concatenate([part.sums for part in parts]),
            np.concatenate([part.marks for part in parts]),
        )
