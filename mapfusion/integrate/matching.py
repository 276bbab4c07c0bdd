"""Which stretch of one curve lies beside which stretch of another."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray

Float = NDArray[np.float64]
Integer = NDArray[np.int64]


@dataclass(frozen=True)
class Correspondence:
    """Stations of a map beside a curve.

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
    same_way: NDArray[np.bool_]

    def rows(self, rows: NDArray[np.intp]) -> Correspondence:
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


def correspond(
    stations: Float,
    directions: Float,
    owner: Integer,
    curve: Float,
    curve_tangents: Float,
    reach: float,
    angle: float,
    end: float,
) -> Correspondence:
    """Find the stations that lie beside a curve and run along it, each line all of one way or all of the other.

    So a line that folds back on itself (the tip of a gore, the two sides of a narrow island) is matched side by side
    and never with the wrong side, however close both are.

    Args:
        stations: ``(n, 2)``, metres, near the origin of coordinates (squares of large ones lose digits).
        directions: ``(n, 2)``, unit.
        owner: ``(n,)``, number of the line that each station belongs to.
        curve: ``(m, 2)``, metres, vertices at equal distances.
        curve_tangents: ``(m, 2)``, unit.
        reach: largest lateral distance, metres.
        angle: largest angle between the directions, degrees.
        end: how far past the first or last vertex a foot may lie, metres.

    Returns:
        The stations that match, in their order.
    """
    (left, low), (right, high) = (curve.min(axis=0) - reach).tolist(), (curve.max(axis=0) + reach).tolist()
    x, y = stations[:, 0], stations[:, 1]
    (near,) = ((x > left) & (x < right) & (y > low) & (y < high)).nonzero()
    points = stations.take(near, axis=0)
    # |p - q|² without |p|², which does not change which q is nearest
    square = (curve[:, 0] ** 2 + curve[:, 1] ** 2) - 2.0 * (points @ curve.T)
    cosine = directions.take(near, axis=0) @ curve_tangents.T
    one_way, any_way = cosine.min(axis=1) > 0.0, cosine.max(axis=1) > 0.0
    lines = owner.take(near)
    count = int(lines.max(initial=-1)) + 1
    feet = partial(_feet, points, cosine, curve, curve_tangents, reach, angle, end)
    if (one_way == any_way).all():
        # nothing folds back: each station has a nearest vertex of one way only
        vertex, offset, distance, keep = feet(square, one_way)
        weight = np.where(one_way, reach - distance, distance - reach)
        way = (np.bincount(lines[keep], weights=weight[keep], minlength=count) >= 0.0)[lines]
        keep &= way == one_way
    else:
        found = [
            feet(np.where((cosine > 0.0) == ahead, square, np.inf), np.full(len(near), ahead))
            for ahead in (True, False)
        ]
        same, opposite = (
            np.bincount(lines[kept], weights=reach - away[kept], minlength=count) for _, _, away, kept in found
        )
        way = (same >= opposite)[lines]
        vertex, offset, distance, keep = (
            np.where(way if a.ndim == 1 else way[:, None], a, b) for a, b in zip(*found, strict=True)
        )
    (kept,) = keep.nonzero()
    return Correspondence(near, vertex, offset, distance, way).rows(kept)


def _feet(
    points: Float,
    cosine: Float,
    curve: Float,
    curve_tangents: Float,
    reach: float,
    angle: float,
    end: float,
    square: Float,
    ahead: NDArray[np.bool_],
) -> tuple[Integer, Float, Float, NDArray[np.bool_]]:
    """Return nearest vertex, offset, distance, and which stations lie beside the curve.

    Args:
        points: ``(n, 2)``, metres.
        cosine: ``(n, m)``, of the angle between station and vertex.
        curve, curve_tangents, reach, angle, end: of :func:`correspond`.
        square: ``(n, m)``, rises with the distance to each vertex.
        ahead: ``(n,)``, whether the station must run along the curve or against it.
    """
    vertex = square.argmin(axis=1)
    tangent = curve_tangents.take(vertex, axis=0)
    gap = curve.take(vertex, axis=0) - points
    along = gap[:, 0] * tangent[:, 0] + gap[:, 1] * tangent[:, 1]
    offset = gap - along[:, None] * tangent
    distance = np.sqrt(offset[:, 0] ** 2 + offset[:, 1] ** 2)
    turn = cosine.take(np.arange(0, cosine.size, len(curve)) + vertex)
    aligned = np.where(ahead, turn, -turn) > math.cos(math.radians(angle))
    past = ((vertex == 0) & (along > end)) | ((vertex == len(curve) - 1) & (along < -end))
    return vertex, offset, distance, (distance < reach) & aligned & ~past & (np.abs(along) < reach)
