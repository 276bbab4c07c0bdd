"""Two ways of integrating that are in use, written from their descriptions, to compare with."""

from __future__ import annotations

import numpy as np
import shapely

from mapfusion.arrays import Float
from mapfusion.elements import ElementKind, FrameMap, GlobalMap, MapElement
from mapfusion.geometry import arc_length, resample, transform_points


class PairwiseAveraging:
    """Per track id: where a new line lies in a buffer around the old one, take the middle of both; append the rest.

    Crossings of one track become the convex hull of all. Neither evidence nor association across track ids.
    """

    buffer = 2.0

    def __init__(self) -> None:
        self.tracks: dict[int, tuple[ElementKind, Float]] = {}

    def add(self, frame: FrameMap) -> None:
        for kind, track, points in zip(frame.kinds, frame.track_ids, frame.polylines, strict=True):
            new = dense(transform_points(frame.ego_to_global, points))
            old = self.tracks.get(int(track))
            if old is None:
                self.tracks[int(track)] = ElementKind(int(kind)), new
            elif old[0].is_ring:
                hull = shapely.MultiPoint(np.concatenate([old[1], new])).convex_hull
                self.tracks[int(track)] = old[0], shapely.get_coordinates(hull)
            else:
                self.tracks[int(track)] = old[0], self._average(old[1], new)

    def map(self) -> GlobalMap:
        return GlobalMap(tuple(element(kind, points) for kind, points in self.tracks.values() if len(points) > 1))

    def _average(self, old: Float, new: Float) -> Float:
        if (old[-1] - old[0]) @ (new[-1] - new[0]) < 0:
            new = new[::-1]
        line = shapely.LineString(new)
        distance = shapely.distance(shapely.points(old), line)
        foot = shapely.get_coordinates(line.interpolate(shapely.line_locate_point(line, shapely.points(old))))
        near = distance < self.buffer
        merged = np.where(near[:, None], (old + foot) / 2, old)
        reach = shapely.line_locate_point(line, shapely.points(old[near])) if near.any() else np.array([0.0])
        along = arc_length(new)
        before, after = new[along < reach.min() - 0.1], new[along > reach.max() + 0.1]
        return np.concatenate([before, merged, after])


class LastObservationWins:
    """A new line replaces the stretch of the map's line that it overlaps; a new crossing replaces the old one."""

    buffer = 2.0

    def __init__(self) -> None:
        self.elements: list[tuple[ElementKind, Float]] = []

    def add(self, frame: FrameMap) -> None:
        for kind, points in zip(frame.kinds, frame.polylines, strict=True):
            self._replace(ElementKind(int(kind)), dense(transform_points(frame.ego_to_global, points)))

    def map(self) -> GlobalMap:
        return GlobalMap(tuple(element(kind, points) for kind, points in self.elements if len(points) > 1))

    def _replace(self, kind: ElementKind, new: Float) -> None:
        best, share = None, 0.3
        for position, (other, old) in enumerate(self.elements):
            if other is kind:
                shape = shapely.Polygon(old) if kind.is_ring else shapely.LineString(old)
                inside = float((shapely.distance(shapely.points(new), shape) < self.buffer / 2).mean())
                if inside > share:
                    best, share = position, inside
        if best is None:
            self.elements.append((kind, new))
        elif kind.is_ring:
            self.elements[best] = kind, new
        else:
            old = self.elements[best][1]
            if (old[-1] - old[0]) @ (new[-1] - new[0]) < 0:
                new = new[::-1]
            near = np.flatnonzero(shapely.distance(shapely.points(old), shapely.LineString(new)) < self.buffer)
            self.elements[best] = kind, np.concatenate([old[: near[0]], new, old[near[-1] + 1 :]])


def dense(points: Float) -> Float:
    """Return points about one metre apart, at least four, which a ring needs."""
    return resample(points, max(int(arc_length(points)[-1]), 3) + 1)


def element(kind: ElementKind, points: Float) -> MapElement:
    """Return an element without evidence."""
    return MapElement(kind, points, 1.0, 1, 0, 0)
