"""Matching of curves: which stations of the map lie beside which vertices of an observed curve."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from mapfusion.arrays import Bool, Float, Integer, Rows


class DirectedPoints(NamedTuple):
    """Points ``(n, 2)`` of curves, metres, with the unit directions of the curves there."""

    points: Float
    directions: Float

    def rows(self, rows: Rows) -> DirectedPoints:
        """Return some of the points."""
        return DirectedPoints(self.points.take(rows, axis=0), self.directions.take(rows, axis=0))


class MatchLimits(NamedTuple):
    """Limits within which a station lies beside a curve: lateral distance (metres) and angle (degrees).

    ``end`` is how far past the first or last vertex a foot may lie, metres.
    """

    reach: float
    angle: float
    end: float


@dataclass(frozen=True)
class Correspondence:
    """Correspondence of stations of the map with a curve beside them.

    Attributes:
        station: ``(n,) int64``, rows of the stations that were compared.
        vertex: ``(n,) int64``, the nearest vertex of the curve.
        offset: ``(n, 2) float64``, metres, from the station to its foot on the curve.
        distance: ``(n,) float64``, length of the offset, metres.
        same_way: ``(n,) bool``, whether both run in the same direction.
    """

    station: Integer
    vertex: Integer
    offset: Float
    distance: Float
    same_way: Bool

    def rows(self, rows: Rows) -> Correspondence:
        """Return some of the stations."""
        return Correspondence(
            self.station.take(rows),
            self.vertex.take(rows),
            self.offset.take(rows, axis=0),
            self.distance.take(rows),
            self.same_way.take(rows),
        )

    def renumbered(self, station: Integer) -> Correspondence:
        """Return it with other numbers of the same stations."""
        return Correspondence(station, self.vertex, self.offset, self.distance, self.same_way)


def correspond(stations: DirectedPoints, owner: Integer, curve: DirectedPoints, limits: MatchLimits) -> Correspondence:
    """Find the stations that lie beside a curve and run along it, each line all of one way or all of the other.

    So a line that folds back on itself (the tip of a gore, the two sides of a narrow island) is matched side by side
    and never with the wrong side, however close both are.

    Args:
        stations: ``n`` of them, near the origin of coordinates (squares of large coordinates lose digits).
        owner: ``(n,)``, number of the line that each station belongs to.
        curve: vertices at equal distances.
        limits: how far apart and how oblique a match may be.

    Returns:
        The stations that match, in their order.
    """
    reach = limits.reach
    (left, low), (right, high) = (
        (curve.points.min(axis=0) - reach).tolist(),
        (curve.points.max(axis=0) + reach).tolist(),
    )
    x, y = stations.points[:, 0], stations.points[:, 1]
    (near,) = ((x > left) & (x < right) & (y > low) & (y < high)).nonzero()
    pairs = _Pairs.of(stations.rows(near), curve)
    lines = owner.take(near)
    count = int(lines.max(initial=-1)) + 1
    only_ahead, some_ahead = pairs.cosine.min(axis=1) > 0.0, pairs.cosine.max(axis=1) > 0.0
    if (only_ahead == some_ahead).all():
        # nothing folds back: each station has a nearest vertex of one way only
        feet = _feet(pairs, pairs.square, only_ahead, limits)
        weight = np.where(only_ahead, reach - feet.distance, feet.distance - reach)
        ahead = (np.bincount(lines[feet.beside], weights=weight[feet.beside], minlength=count) >= 0.0)[lines]
        beside = feet.beside & (ahead == only_ahead)
    else:
        along, against = (
            _feet(pairs, np.where((pairs.cosine > 0.0) == way, pairs.square, np.inf), np.full(len(near), way), limits)
            for way in (True, False)
        )
        support_along, support_against = (
            np.bincount(lines[feet.beside], weights=reach - feet.distance[feet.beside], minlength=count)
            for feet in (along, against)
        )
        ahead = (support_along >= support_against)[lines]
        feet = along.where(ahead, against)
        beside = feet.beside
    (kept,) = beside.nonzero()
    return Correspondence(near, feet.vertex, feet.offset, feet.distance, ahead).rows(kept)


class _Pairs(NamedTuple):
    """Pairs of ``n`` stations and the ``m`` vertices of a curve, all with all, ``(n, m)``.

    ``square`` rises with their distance, ``cosine`` is that of the angle between their directions.
    """

    stations: DirectedPoints
    curve: DirectedPoints
    square: Float
    cosine: Float

    @classmethod
    def of(cls, stations: DirectedPoints, curve: DirectedPoints) -> _Pairs:
        # |p - q|² without |p|², which does not change which q is nearest
        own = curve.points[:, 0] ** 2 + curve.points[:, 1] ** 2
        square = own - 2.0 * (stations.points @ curve.points.T)
        return cls(stations, curve, square, stations.directions @ curve.directions.T)


class _Feet(NamedTuple):
    """Feet of stations: the nearest vertex, the offset ``(n, 2)`` across to the curve and its length, metres.

    ``beside`` says whether the station lies within the limits.
    """

    vertex: Integer
    offset: Float
    distance: Float
    beside: Bool

    def where(self, chosen: Bool, other: _Feet) -> _Feet:
        """Return these feet where ``chosen`` is true, else the other ones."""
        return _Feet(
            np.where(chosen, self.vertex, other.vertex),
            np.where(chosen[:, None], self.offset, other.offset),
            np.where(chosen, self.distance, other.distance),
            np.where(chosen, self.beside, other.beside),
        )


def _feet(pairs: _Pairs, square: Float, ahead: Bool, limits: MatchLimits) -> _Feet:
    """Find the foot of each station.

    ``square (n, m)`` rises with the distance and is infinite for vertices that are no choice; ``ahead (n,)`` says
    whether the station must run along the curve or against it.
    """
    curve = pairs.curve
    vertex = square.argmin(axis=1)
    tangent = curve.directions.take(vertex, axis=0)
    gap = curve.points.take(vertex, axis=0) - pairs.stations.points
    along = gap[:, 0] * tangent[:, 0] + gap[:, 1] * tangent[:, 1]
    offset = gap - along[:, None] * tangent
    distance = np.sqrt(offset[:, 0] ** 2 + offset[:, 1] ** 2)
    last = len(curve.points) - 1
    turn = pairs.cosine.take(np.arange(0, pairs.cosine.size, last + 1) + vertex)
    aligned = np.where(ahead, turn, -turn) > math.cos(math.radians(limits.angle))
    past = ((vertex == 0) & (along > limits.end)) | ((vertex == last) & (along < -limits.end))
    beside = (distance < limits.reach) & aligned & ~past & (np.abs(along) < limits.reach)
    return _Feet(vertex, offset, distance, beside)
