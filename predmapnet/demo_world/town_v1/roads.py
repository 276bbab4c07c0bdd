"""A road: a smooth reference line and what lies beside it, addressed by station and lateral offset."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import shapely
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline
from shapely import Polygon

from predmapnet.demo_world.world import LineStyle

Float = NDArray[np.float64]

STEP = 1.0
"""Distance between the samples of a reference line, metres."""


@dataclass(frozen=True)
class CrossSection:
    """What a road looks like across, the same on both sides of its reference line. Right-hand traffic.

    Attributes:
        lanes: number of lanes each way.
        lane_width: metres.
        median: distance between the innermost lanes, metres; 0 where only paint separates them.
        shoulder: distance between the outermost lane and the kerb, metres.
        centre_style, lane_style: paint between the directions and between the lanes of one direction.
        centre_colour: colour of the paint between the directions.
    """

    lanes: int
    lane_width: float
    median: float
    shoulder: float
    centre_style: LineStyle
    lane_style: LineStyle
    centre_colour: str

    @property
    def half_width(self) -> float:
        """From the reference line to the kerb, metres."""
        return self.median / 2 + self.lanes * self.lane_width + self.shoulder

    def lane_centre(self, lane: int) -> float:
        """From the reference line to the centre of a lane, metres; lane 0 is the innermost."""
        return self.median / 2 + (lane + 0.5) * self.lane_width

    def lane_edge(self, lane: int) -> float:
        """From the reference line to the inner edge of a lane, metres."""
        return self.median / 2 + lane * self.lane_width


@dataclass(frozen=True)
class Road:
    """A reference line sampled by arc length, with its cross-section.

    Stations are metres along the line; lateral offsets are metres to its left. Traffic along the line keeps to
    negative offsets (right), traffic against it to positive ones.

    Attributes:
        stations: ``(n,) float64``.
        points: ``(n, 2) float64``, metres.
        tangents: ``(n, 2) float64``, unit length.
        section: the cross-section.
    """

    stations: Float
    points: Float
    tangents: Float
    section: CrossSection

    @property
    def length(self) -> float:
        """Metres."""
        return float(self.stations[-1])

    def locate(self, stations: Float, offsets: Float | float = 0.0) -> Float:
        """Map stations and lateral offsets (``(n,)`` each) to ``(n, 2)`` points."""
        tangents = self.direction(stations)
        normals = np.stack([-tangents[:, 1], tangents[:, 0]], axis=1)
        centre = np.stack([np.interp(stations, self.stations, self.points[:, axis]) for axis in range(2)], axis=1)
        return centre + normals * np.broadcast_to(np.asarray(offsets, dtype=np.float64), stations.shape)[:, None]

    def direction(self, stations: Float) -> Float:
        """Unit tangents ``(n, 2)`` at stations ``(n,)``."""
        tangents = np.stack([np.interp(stations, self.stations, self.tangents[:, axis]) for axis in range(2)], axis=1)
        unit: Float = tangents / np.linalg.norm(tangents, axis=1, keepdims=True)
        return unit

    def line(self, start: float, end: float, offset: float = 0.0) -> Float:
        """Parallel line ``(n, 2)`` between two stations (in either order), a vertex about every two metres."""
        count = max(2, 1 + int(np.ceil(abs(end - start) / (2 * STEP))))
        return self.locate(np.linspace(start, end, count), offset)

    def strip(self, start: float, end: float, right: float, left: float) -> Polygon:
        """The area between two stations and two lateral offsets."""
        return Polygon(np.concatenate([self.line(start, end, right), self.line(end, start, left)]))

    def band(self, stations: Float, right: Float, left: Float) -> Polygon:
        """The area between two profiles of lateral offsets, each given at ``stations``."""
        dense = np.union1d(stations, np.arange(stations[0], stations[-1], 2 * STEP))
        edges = [self.locate(dense, np.interp(dense, stations, profile)) for profile in (right, left)]
        return Polygon(np.concatenate([edges[0], edges[1][::-1]]))


def road_through(knots: Float, section: CrossSection) -> tuple[Road, Float]:
    """Lay a road with continuous curvature through given points.

    Args:
        knots: ``(k, 2)``, metres.
        section: its cross-section.

    Returns:
        The road, and the stations ``(k,)`` at which it passes the knots.
    """
    parameter = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(knots, axis=0), axis=1))])
    spline = CubicSpline(parameter, knots)
    fine = np.union1d(np.linspace(0.0, parameter[-1], int(parameter[-1] * 10)), parameter)
    samples = spline(fine)
    travelled = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(samples, axis=0), axis=1))])
    stations = np.linspace(0.0, travelled[-1], int(travelled[-1] / STEP) + 1)
    at = np.interp(stations, travelled, fine)
    tangents = spline(at, 1)
    tangents /= np.linalg.norm(tangents, axis=1, keepdims=True)
    return Road(stations, spline(at), tangents, section), np.interp(parameter, fine, travelled)


def parts(geometry: shapely.Geometry, minimum_area: float) -> list[Polygon]:
    """Polygons of a geometry, without crumbs below ``minimum_area`` square metres."""
    return [part for part in shapely.get_parts(geometry) if part.geom_type == "Polygon" and part.area >= minimum_area]
