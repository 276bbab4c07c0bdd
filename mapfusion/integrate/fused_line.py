"""Line of the map whose stations carry position, variance and evidence, updated one observed curve at a time."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from mapfusion.arrays import Float, Integer
from mapfusion.elements import ElementKind
from mapfusion.geometry import tangents
from mapfusion.integrate.evidence import Evidence
from mapfusion.integrate.matching import Correspondence, DirectedPoints, MatchLimits, correspond
from mapfusion.integrate.station_curve import INFORMATION, SCATTER, StationCurve

BLEND_LENGTH = 10.0
"""Decay length, past the common stretch, of the shift that leads an extension over, metres."""

END = 0.6
"""Distance that a foot may lie past an end of the new curve, metres."""

ONES = np.ones(2)


@dataclass
class FusedLine:
    """Divider or boundary of the map.

    Attributes:
        kind: divider or boundary.
        curve: its stations.
        evidence: for it as a whole.
        first: number of the first station; numbers stay with the stations when the line grows at its start.
    """

    kind: ElementKind
    curve: StationCurve
    evidence: Evidence
    first: int = 0


def fuse(line: FusedLine, new: StationCurve, match: Correspondence) -> list[StationCurve]:
    """Fuse a curve (an observation, or another line of the map) into a line that it lies beside, in place.

    Where both lie side by side, each station moves across the line to the mean weighted by information. Where the
    new curve goes on past an end of the line, the line is extended, led over smoothly from the fused stretch. The
    match has at least one station.

    Returns:
        The parts of ``new`` that leave the line sideways and belong to another line.
    """
    base, last = line.curve, len(new) - 1
    station, vertex, offset = match.station, match.vertex, match.offset
    if 2 * np.count_nonzero(match.same_way) < len(station):
        new = new.reversed()
        vertex = last - vertex
    head, tail = int(vertex.argmin()), int(vertex.argmax())
    first_foot, last_foot = base.points[station[head]] + offset[head], base.points[station[tail]] + offset[tail]
    gain = _average(base, new, match, vertex)

    leftovers: list[StationCurve] = []
    parts = [base]
    if vertex[head] > 0:
        before = new.part(0, int(vertex[head]))
        if station[head] <= 1:
            shift = -(1.0 - gain[head]) * offset[head]
            parts.insert(0, _extension(before.reversed(), first_foot, shift, base.points).reversed())
            line.first -= len(parts[0])
        else:
            leftovers.append(before)
    if vertex[tail] < last:
        after = new.part(int(vertex[tail]) + 1, last + 1)
        if station[tail] >= len(base) - 2:
            shift = -(1.0 - gain[tail]) * offset[tail]
            parts.append(_extension(after, last_foot, shift, base.points))
        else:
            leftovers.append(after)
    if any(len(part) for part in parts if part is not base):
        line.curve = StationCurve.join(parts)
    return leftovers


def _average(base: StationCurve, new: StationCurve, match: Correspondence, vertex: Integer) -> Float:
    """Move stations to the weighted mean, in place; returns the new curve's share in it, ``(n,)``."""
    station = match.station
    added = new.sums.take(vertex, axis=0)
    known = base.sums[:, INFORMATION].take(station)
    gain = added[:, INFORMATION] / (known + added[:, INFORMATION])
    # scatter about the common mean of two groups (Chan, Golub and LeVeque, 1979)
    added[:, SCATTER] += gain * known * match.distance**2
    # most often stations without a gap: a slice is several times as fast as their numbers
    first, last = int(station[0]), int(station[-1])
    rows = slice(first, last + 1) if last - first == len(station) - 1 else station
    base.points[rows] += gain[:, None] * match.offset
    base.sums[rows] += added
    base.marks[rows] |= new.marks.take(vertex, axis=0)
    return np.asarray(gain)


def _extension(part: StationCurve, foot: Float, shift: Float, base: Float) -> StationCurve:
    """Return a part led over from the base's end, up to where it comes back to the base (a closed loop).

    Its vertices past the end come nearest first; ``foot`` is where the base's end falls on the unshifted curve, and
    ``shift`` leads from there to the fused end.
    """
    at_start = squared(base[0] - foot) < squared(base[-1] - foot)
    end = base[0] if at_start else base[-1]
    inner = base[min(2, len(base) - 1)] if at_start else base[max(len(base) - 3, 0)]
    outward = (end - inner) / max(math.sqrt(squared(end - inner)), 1e-9)
    # vertices beside the base's end rather than past it would fold the line back
    ahead = (part.points[:3] + (shift - end)) @ outward >= 0.3
    start = int(ahead.argmax()) if ahead.any() else len(ahead)
    gap = part.points - foot
    away = np.sqrt((gap * gap) @ ONES)
    points = part.points + np.exp(away / -BLEND_LENGTH)[:, None] * shift
    stop = len(part)
    if len(base) > 24 and stop > start:
        other_end = base[-12:] if at_start else base[:12]
        # a loop only if the part comes anywhere near the other end
        if (points.min(axis=0) < other_end.max(axis=0) + 0.6).all() and (
            points.max(axis=0) > other_end.min(axis=0) - 0.6
        ).all():
            near = (((points[:, None, :] - other_end[None, :, :]) ** 2).sum(axis=2) < 0.6**2).any(axis=1)
            if near.any():
                stop = max(int(near.argmax()), start)
    return StationCurve(points[start:stop], part.sums[start:stop], part.marks[start:stop])


def squared(vector: Float) -> float:
    """Return the squared length of a vector ``(2,)``."""
    return float(vector[0] * vector[0] + vector[1] * vector[1])


def beside(base: StationCurve, new: StationCurve, reach: float, angle: float) -> Correspondence:
    """Return the stations of ``base`` beside ``new``."""
    origin = new.points[0]
    return correspond(
        DirectedPoints(base.points - origin, tangents(base.points)),
        np.zeros(len(base), dtype=np.int64),
        DirectedPoints(new.points - origin, tangents(new.points)),
        MatchLimits(reach, angle, END),
    )
