"""Contribution of one map to a merge: its elements, how sure and how exact they are, and where its drive looked."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
import shapely
from scipy.spatial import cKDTree
from scipy.special import logit

from mapfusion.arrays import Float
from mapfusion.elements import MapElement
from mapfusion.ground import inside
from mapfusion.merge.config import MergeConfig

VIEW_LENGTH = 60.0
"""Length of road that a car sees at a time, about, metres."""

LOOK_REACH = 8.0
"""Ground within twice this distance of an element was looked at as often as the element, metres."""


class Looks:
    """Number of frames in which a drive looked at each place, taken from the elements near it.

    Args:
        elements: all that the map has around.
    """

    def __init__(self, elements: Iterable[MapElement]) -> None:
        points, frames = [np.empty((0, 2))], [np.empty(0)]
        for element in elements:
            samples = shapely.get_coordinates(shapely.segmentize(shapely.LineString(element.points), LOOK_REACH))
            points.append(samples)
            frames.append(np.full(len(samples), frames_per_place(element)))
        self._points, self._frames = np.concatenate(points), np.concatenate(frames)
        self._tree = cKDTree(self._points) if len(self._points) else None

    def at(self, points: Float) -> Float:
        """Return the frames for each of ``(n, 2)`` points, metres; one frame where nothing is near."""
        frames = np.ones(len(points))
        if self._tree is not None and len(points):
            distance, nearest = self._tree.query(points, distance_upper_bound=2.0 * LOOK_REACH)
            near = np.isfinite(distance)
            frames[near] = np.maximum(self._frames[nearest[near]], 1.0)
        return frames


def frames_per_place(element: MapElement) -> float:
    """Return the number of frames that saw each place of an element, about: a long one is never seen as a whole."""
    size = float(np.linalg.norm(np.ptp(element.points, axis=0)))
    return element.observations * VIEW_LENGTH / (VIEW_LENGTH + size)


@dataclass(frozen=True)
class Contribution:
    """Contribution of one map to a tile.

    Attributes:
        source: number of the map.
        elements: of one kind, metres, corrected.
        ground: that the map speaks of.
        looks: number of frames that looked at each place.
    """

    source: int
    elements: Sequence[MapElement]
    ground: shapely.Geometry
    looks: Looks


def information(element: MapElement, config: MergeConfig) -> Float:
    """Return the inverse variance of a line at its vertices, ``(n,)``, 1 / m²: stated, or by its number of frames."""
    deviation = element.deviation
    if deviation is None:
        alike = config.default_alike + (1.0 - config.default_alike) / max(element.observations, 1)
        deviation = np.full(len(element.points), config.default_deviation * np.sqrt(alike))
    return np.asarray(1.0 / (deviation**2 + config.floor_deviation**2))


def certainty(element: MapElement, config: MergeConfig) -> float:
    """Return the log-odds that one map gives an element: by its confidence, limited by its number of frames."""
    most = min(config.log_odds_limit, config.hit_log_odds * max(element.observations, 1))
    return float(np.clip(logit(np.clip(element.confidence, 1e-3, 1 - 1e-3)), 0.2, most))


def doubt(contribution: Contribution, points: Float, config: MergeConfig) -> Float:
    """Return the log-odds that a map takes at ``(n, 2)`` points from what it lacks: more where it looked oftener."""
    taken = np.minimum(config.miss_log_odds * contribution.looks.at(points), config.miss_limit)
    return np.asarray(taken * inside(contribution.ground, points))
