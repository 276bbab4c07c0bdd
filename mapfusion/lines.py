"""A line of the map: a curve whose stations carry position, variance and evidence, updated one curve at a time."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from mapfusion.elements import ElementKind
from mapfusion.matching import Correspondence, correspond, tangents
from mapfusion.observations import Track

Float = NDArray[np.float64]

BLEND_LENGTH = 10.0
"""Over this distance past the common stretch an extension forgets by how far its observation was off, metres."""


@dataclass
class Evidence:
    """What is known of an element as a whole."""

    first_seen: int
    last_seen: int
    observations: int = 1
    tracks: dict[Track, int] = field(default_factory=dict)
    """Track to the number of frames in which it was fused into this element."""
    beside: dict[int, int] = field(default_factory=dict)
    """Element id to the number of frames that showed it beside this one."""

    def sighted(self, track: Track, timestamp: int, again: bool = False) -> None:
        """Count one frame of a track; ``again`` where another observation of the same frame was counted."""
        self.first_seen = min(self.first_seen, timestamp)
        self.last_seen = max(self.last_seen, timestamp)
        self.observations += not again
        self.tracks[track] = self.tracks.get(track, 0) + 1

    def absorb(self, other: Evidence) -> None:
        """Add what is known of an element that turned out to be this one."""
        self.first_seen = min(self.first_seen, other.first_seen)
        self.last_seen = max(self.last_seen, other.last_seen)
        self.observations += other.observations
        for track, count in other.tracks.items():
            self.tracks[track] = self.tracks.get(track, 0) + count
        for element, count in other.beside.items():
            self.beside[element] = self.beside.get(element, 0) + count


@dataclass
class Curve:
    """Stations along a line, about one spacing apart; arrays of equal length.

    Attributes:
        points: ``(n, 2) float64``, metres, global frame.
        information: ``(n,) float64``, inverse variance across the line, 1 / m².
        seen: ``(n,) float64``, sum of sightings, weighted by score.
        seen_view: ``(n,) float64``, sum of the view weights of those sightings.
    """

    points: Float
    information: Float
    seen: Float
    seen_view: Float

    def __len__(self) -> int:
        return len(self.points)

    def part(self, start: int, stop: int) -> Curve:
        """Return stations ``start`` to ``stop`` (excluded)."""
        piece = slice(start, stop)
        return Curve(self.points[piece], self.information[piece], self.seen[piece], self.seen_view[piece])

    def reversed(self) -> Curve:
        """Return the curve with its stations in the opposite order."""
        return Curve(self.points[::-1], self.information[::-1], self.seen[::-1], self.seen_view[::-1])

    @staticmethod
    def join(parts: list[Curve]) -> Curve:
        """Put curves end to end."""
        return Curve(
            np.concatenate([part.points for part in parts]),
            np.concatenate([part.information for part in parts]),
            np.concatenate([part.seen for part in parts]),
            np.concatenate([part.seen_view for part in parts]),
        )


@dataclass
class FusedLine:
    """A divider or boundary of the map."""

    kind: ElementKind
    curve: Curve
    evidence: Evidence


def fuse(base: Curve, new: Curve, match: Correspondence) -> tuple[Curve, list[Curve]]:
    """Fuse a curve into another that it lies beside.

    Where both lie side by side, each station moves across the line to the mean weighted by information. Where the
    new curve goes on past an end of the base, the base is extended, led over smoothly from the fused stretch.

    Args:
        base: the curve of the map.
        new: an observation, or another curve of the map.
        match: stations of ``base`` (at least one) beside vertices of ``new``.

    Returns:
        The fused curve, and the parts of ``new`` that leave the base sideways and must be something else.
    """
    last = len(new) - 1
    station, vertex, offset = match.station, match.vertex, match.offset
    if match.same_way.mean() < 0.5:
        new = new.reversed()
        vertex = last - vertex
    gain = new.information[vertex] / (base.information[station] + new.information[vertex])
    points, information = base.points.copy(), base.information.copy()
    seen, seen_view = base.seen.copy(), base.seen_view.copy()
    points[station] += gain[:, None] * offset
    information[station] += new.information[vertex]
    seen[station] += new.seen[vertex]
    seen_view[station] += new.seen_view[vertex]
    fused = Curve(points, information, seen, seen_view)

    leftovers: list[Curve] = []
    parts = [fused]
    head, tail = int(np.argmin(vertex)), int(np.argmax(vertex))
    if vertex[head] > 0:
        before = new.part(0, int(vertex[head]))
        if station[head] <= 1:
            shift = -(1.0 - gain[head]) * offset[head]
            extension = _extension(before.reversed(), base.points[station[head]] + offset[head], shift, points)
            parts.insert(0, extension.reversed())
        else:
            leftovers.append(before)
    if vertex[tail] < last:
        after = new.part(int(vertex[tail]) + 1, last + 1)
        if station[tail] >= len(base) - 2:
            shift = -(1.0 - gain[tail]) * offset[tail]
            parts.append(_extension(after, base.points[station[tail]] + offset[tail], shift, points))
        else:
            leftovers.append(after)
    return Curve.join(parts) if len(parts) > 1 else fused, leftovers


def _extension(piece: Curve, foot: Float, shift: Float, base: Float) -> Curve:
    """Lead a piece over from the base's end and stop where it comes back to the base (a closed loop).

    Args:
        piece: vertices past the end, nearest first.
        foot: ``(2,)``, where the base's end falls on the unshifted curve.
        shift: ``(2,)``, from there to the fused end.
        base: ``(n, 2)`` stations of the base.
    """
    away = np.linalg.norm(piece.points - foot, axis=1)
    start = 0
    # vertices beside the base's end rather than past it would fold the line back
    at_start = np.sum((base[0] - foot) ** 2) < np.sum((base[-1] - foot) ** 2)
    end = base[0] if at_start else base[-1]
    inner = base[min(2, len(base) - 1)] if at_start else base[max(len(base) - 3, 0)]
    outward = (end - inner) / max(float(np.linalg.norm(end - inner)), 1e-9)
    while start < min(3, len(piece)) and (piece.points[start] + shift - end) @ outward < 0.3:
        start += 1
    points = piece.points + np.exp(-away / BLEND_LENGTH)[:, None] * shift
    stop = len(piece)
    if len(base) > 24 and len(piece) > start:
        other_end = base[-12:] if at_start else base[:12]
        near = (((points[:, None, :] - other_end[None, :, :]) ** 2).sum(axis=2) < 0.6**2).any(axis=1)
        if near.any():
            stop = max(int(np.argmax(near)), start)
    return Curve(points[start:stop], piece.information[start:stop], piece.seen[start:stop], piece.seen_view[start:stop])


def beside(base: Curve, new: Curve, reach: float, angle: float) -> Correspondence:
    """Return the stations of ``base`` beside ``new``."""
    origin = new.points[0]
    return correspond(
        base.points - origin,
        tangents(base.points),
        np.zeros(len(base), dtype=np.int64),
        new.points - origin,
        tangents(new.points),
        reach,
        angle,
        end=0.6,
    )
