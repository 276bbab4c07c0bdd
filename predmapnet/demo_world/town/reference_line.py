"""The reference line of a street, addressed by station and lateral offset."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import shapely
from numpy.random import Generator
from shapely import Polygon

from mapfusion.arrays import Float

STEP = 2.0
"""Distance between the samples of a reference line, metres."""


@dataclass(frozen=True)
class ReferenceLine:
    """A smooth line sampled by arc length: points and unit tangents ``(n, 2)`` at stations ``(n,)``.

    Stations are metres along it, lateral offsets metres to its left.
    """

    stations: Float
    points: Float
    tangents: Float

    @property
    def length(self) -> float:
        """Metres."""
        return float(self.stations[-1])

    @cached_property
    def shape(self) -> shapely.LineString:
        """The line itself."""
        return shapely.LineString(self.points)

    @cached_property
    def surroundings(self) -> Polygon:
        """The ground within 14 m of the line, which the yards of other streets keep clear of."""
        return self.shape.buffer(14.0)

    def direction(self, stations: Float) -> Float:
        """Unit tangents ``(n, 2)`` at stations ``(n,)``."""
        tangents = np.stack([np.interp(stations, self.stations, self.tangents[:, axis]) for axis in range(2)], axis=1)
        unit: Float = tangents / np.linalg.norm(tangents, axis=1, keepdims=True)
        return unit

    def locate(self, stations: Float, offsets: Float | float = 0.0) -> Float:
        """Map stations and lateral offsets (``(n,)`` each) to ``(n, 2)`` points; straight on beyond both ends."""
        tangents = self.direction(stations)
        normals = np.stack([-tangents[:, 1], tangents[:, 0]], axis=1)
        centre = np.stack([np.interp(stations, self.stations, self.points[:, axis]) for axis in range(2)], axis=1)
        beyond = stations - np.clip(stations, 0.0, self.length)
        aside = normals * np.broadcast_to(np.asarray(offsets, dtype=np.float64), stations.shape)[:, None]
        return centre + aside + tangents * beyond[:, None]

    def heading(self, station: float) -> float:
        """Direction of the line at a station, radians."""
        tangent = self.direction(np.array([station]))[0]
        return float(np.arctan2(tangent[1], tangent[0]))

    def band(self, stations: Float, right: Float, left: Float) -> Polygon:
        """The area between two profiles of lateral offsets, each given at ``stations``."""
        return Polygon(np.concatenate([self.locate(stations, right), self.locate(stations, left)[::-1]]))


def grow_line(start: Float, heading: float, length: float, curvature: Float) -> ReferenceLine:
    """Grow a line of that length from a place and a heading (radians), with curvatures ``(k,)`` per metre.

    Those lie at even spacing along the line and are interpolated between.
    """
    count = max(2, round(length / STEP) + 1)
    stations = np.linspace(0.0, length, count)
    bend = np.interp(stations, np.linspace(0.0, length, len(curvature)), curvature)
    step = stations[1]
    headings = heading + np.concatenate([[0.0], np.cumsum((bend[1:] + bend[:-1]) / 2 * step)])
    tangents = np.stack([np.cos(headings), np.sin(headings)], axis=1)
    middle = headings[:-1] + np.diff(headings) / 2
    steps = step * np.stack([np.cos(middle), np.sin(middle)], axis=1)
    return ReferenceLine(stations, start + np.concatenate([np.zeros((1, 2)), np.cumsum(steps, axis=0)]), tangents)


def draw_curvature(random: Generator, straight_share: float, tightest: float) -> Float:
    """Curvatures for :func:`grow_line`: mostly none, sometimes one bend or a bend and its counter-bend."""
    if random.random() < straight_share:
        return np.zeros(2)
    bend = float(random.choice([-1.0, 1.0])) / float(np.exp(random.uniform(np.log(tightest), np.log(700.0))))
    shapes = ([bend, bend], [0.0, bend, bend, 0.0], [0.0, 0.0, bend, 0.0, -bend, 0.0, 0.0], [0.0, 0.0, 0.0, bend])
    return np.array(shapes[random.integers(len(shapes))])


def reverse_and_join(back: ReferenceLine, ahead: ReferenceLine) -> ReferenceLine:
    """One line from two that begin at the same place in opposite directions."""
    points = np.concatenate([back.points[::-1], ahead.points[1:]])
    tangents = np.concatenate([-back.tangents[::-1], ahead.tangents[1:]])
    return ReferenceLine(
        np.concatenate([back.length - back.stations[::-1], back.length + ahead.stations[1:]]), points, tangents
    )
