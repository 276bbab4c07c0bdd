"""Heights of the road, known where cars drove: sampled along drives or along lines that have heights already."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from scipy.spatial import cKDTree

from mapfusion.arrays import Float, Integer
from mapfusion.elements import FrameMap, GlobalMap, MapElement
from mapfusion.geometry import arc_length, simplified_rows

SPACING = 1.0
"""Distance between the samples of a road, metres."""

WIDEST_GAP = 30.0
"""Two instants farther apart than this are not connected, metres."""

LONGEST_GAP = 5_000_000_000
"""Two instants farther apart than this are not connected, nanoseconds."""

FLAT = 1e-6
"""Poses whose heights differ by less, metres, were measured in the plane (as those of nuScenes) and know no height."""

NEIGHBOURS = 8
"""Number of samples whose mean is the height of a place, by the inverse square of their distance."""

NEAREST = 0.1
"""Samples nearer than this weigh no more, metres."""

BESIDE = 5.0
"""Places within this distance of a line with heights have its height, metres."""

RISE_TOLERANCE = 0.1
"""Largest error of the heights between the vertices of an element, metres."""


@dataclass(frozen=True)
class RoadHeights:
    """Samples of the road's height, global frame.

    A bridge and the road under it have the same place: an element takes its height only from what was driven while it
    was seen.

    Attributes:
        points: ``(n, 2)``, metres.
        heights: ``(n,)``, metres, z of the global frame.
        times: ``(n,)``, nanoseconds; 0 where any time will do.
        reach: places farther from the samples have no height, metres.
    """

    points: Float = field(default_factory=lambda: np.zeros((0, 2)))
    heights: Float = field(default_factory=lambda: np.zeros(0))
    times: Integer = field(default_factory=lambda: np.zeros(0, dtype=np.int64))
    reach: float = BESIDE

    @classmethod
    def along(cls, frame_maps: Iterable[FrameMap]) -> RoadHeights:
        """Return the heights of the road under the car, from poses in the order of their times, drive by drive.

        Empty if all poses have one height: then they were measured in the plane.
        """
        frames = list(frame_maps)
        if not frames:
            return cls()
        feet = np.array([frame.ego_to_global[:3, :] @ [0.0, 0.0, frame.ground_height, 1.0] for frame in frames])
        if np.ptp([frame.ego_to_global[2, 3] for frame in frames]) < FLAT:
            return cls()
        times = np.array([frame.timestamp for frame in frames], dtype=np.int64)
        steps, pauses = np.linalg.norm(np.diff(feet[:, :2], axis=0), axis=1), np.diff(times)
        joined = (steps <= WIDEST_GAP) & (pauses >= 0) & (pauses <= LONGEST_GAP)
        parts = np.where(joined, np.maximum(np.ceil(steps / SPACING), 1), 1).astype(np.int64)
        row = np.repeat(np.arange(len(parts)), parts)
        share = (np.arange(len(row)) - np.repeat(np.cumsum(parts) - parts, parts)) / parts[row]
        dense = np.vstack([feet[row] + share[:, None] * np.diff(feet, axis=0)[row], feet[-1:]])
        moments = np.append(times[row] + (share * pauses[row]).astype(np.int64), times[-1])
        reach = max(float(np.hypot(*frame.roi.size)) / 2 for frame in frames) + BESIDE
        return cls(dense[:, :2], dense[:, 2], moments, reach)

    @classmethod
    def of_elements(cls, elements: Iterable[MapElement]) -> RoadHeights:
        """Return the heights along elements that have them."""
        dense = [np.zeros((0, 3)), *(_dense(element) for element in elements if element.heights is not None)]
        samples = np.concatenate(dense)
        return cls(samples[:, :2], samples[:, 2], np.zeros(len(samples), dtype=np.int64))

    @cached_property
    def _tree(self) -> cKDTree:
        return cKDTree(self.points)

    def at(self, points: Float) -> Float:
        """Return the heights of ``(n, 2)`` places, metres; NaN out of reach."""
        if not len(self.points) or not len(points):
            return np.full(len(points), np.nan)
        distance, row = self._tree.query(points, min(NEIGHBOURS, len(self.points)))
        distance, row = distance.reshape(len(points), -1), row.reshape(len(points), -1)
        weight = 1.0 / (distance**2 + NEAREST**2)
        heights = (weight * self.heights[row]).sum(axis=1) / weight.sum(axis=1)
        return np.where(distance[:, 0] <= self.reach, heights, np.nan)

    def lifted(self, element: MapElement) -> MapElement:
        """Return an element with heights at all vertices, or as it is where one of them has no height.

        Where the road rises or falls between two vertices, vertices are added.
        """
        driven = (self.times >= element.first_seen) & (self.times <= element.last_seen)
        if self.times.any() and driven.any() and not driven.all():
            seen = RoadHeights(self.points[driven], self.heights[driven], self.times[driven], self.reach)
            return seen.lifted(element)
        station = arc_length(element.points)
        at = _stations(station)
        points = _interpolated(at, station, element.points)
        heights = self.at(points)
        if not len(heights) or np.isnan(heights).any():
            return element
        rows = np.union1d(np.searchsorted(at, station), rises(at, heights))
        deviation = element.deviation
        return replace(
            element,
            points=points[rows],
            heights=heights[rows],
            deviation=None if deviation is None else np.interp(at[rows], station, deviation),
        )

    def lifted_map(self, global_map: GlobalMap) -> GlobalMap:
        """Return a map whose elements have heights where they are known."""
        if not len(self.points):
            return global_map
        return replace(global_map, elements=tuple(map(self.lifted, global_map)))


def mean_heights(fields: Iterable[RoadHeights], points: Float) -> Float:
    """Return the mean over several fields at ``(n, 2)`` places, metres; NaN where none reaches."""
    sampled = np.array([np.full(len(points), np.nan), *(heights.at(points) for heights in fields)])
    known = np.isfinite(sampled)
    count = known.sum(axis=0)
    return np.where(count > 0, np.where(known, sampled, 0.0).sum(axis=0) / np.maximum(count, 1), np.nan)


def filled(heights: Float, points: Float) -> Float | None:
    """Return heights ``(n,)`` at the vertices of a line with NaN interpolated along it; None if all are NaN."""
    known = np.isfinite(heights)
    if not known.any():
        return None
    station = arc_length(points)
    return heights if known.all() else np.interp(station, station[known], heights[known])


def rises(station: Float, heights: Float) -> Integer:
    """Return the rows that keep heights ``(n,)`` along a line, at ascending stations, to within the tolerance."""
    return simplified_rows(np.stack([station, heights], axis=1), RISE_TOLERANCE)


def _dense(element: MapElement) -> Float:
    """Return samples ``(n, 3)`` along an element with heights."""
    assert element.heights is not None
    station = arc_length(element.points)
    table = np.column_stack([element.points, element.heights])
    return _interpolated(_stations(station), station, table)


def _stations(station: Float) -> Float:
    """Return the arc lengths of a line's vertices and of places between them, about :data:`SPACING` apart."""
    inner = np.arange(SPACING, station[-1], SPACING)
    return np.union1d(station, inner)


def _interpolated(at: Float, station: Float, points: Float) -> Float:
    return np.stack([np.interp(at, station, points[:, axis]) for axis in range(points.shape[1])], axis=1)
