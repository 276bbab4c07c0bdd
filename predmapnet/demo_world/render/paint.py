"""Road paint as quadrilaterals: what the vector map says, laid out as a road crew would."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import shapely
from shapely import LineString, Polygon

from mapfusion.arrays import Float
from mapfusion.geometry import arc_length
from predmapnet.demo_world.world import Crossing, CrossingStyle, Divider, Hatching, LineStyle, VectorMap

DOUBLE_GAP = 0.15
"""Metres of asphalt between the two lines of a double divider."""
DOUBLE_WIDTH = 0.12


@dataclass
class Quads:
    """Painted quadrilaterals, grown while a layout is drawn.

    Attributes:
        corners: list of ``(k, 4, 2)``, metres; edges 0-1 and 2-3 run along the line.
        attributes: list of ``(k, 3)``: wear in [0, 1], albedo of the paint, 1 for yellow and 0 for white.
    """

    corners: list[Float] = field(default_factory=list)
    attributes: list[Float] = field(default_factory=list)

    def add(self, corners: Float, wear: float, albedo: float, yellow: float) -> None:
        """Append ``(k, 4, 2)`` quadrilaterals of one coat of paint."""
        if len(corners):
            self.corners.append(corners)
            self.attributes.append(np.tile([wear, albedo, yellow], (len(corners), 1)))

    def arrays(self) -> tuple[Float, Float]:
        """Return ``(n, 4, 2)`` corners, counter-clockwise, and ``(n, 3)`` attributes."""
        if not self.corners:
            return np.zeros((0, 4, 2)), np.zeros((0, 3))
        corners = np.concatenate(self.corners)
        diagonals = corners[:, 2] - corners[:, 0], corners[:, 3] - corners[:, 1]
        clockwise = diagonals[0][:, 0] * diagonals[1][:, 1] < diagonals[0][:, 1] * diagonals[1][:, 0]
        corners[clockwise] = corners[clockwise][:, [1, 0, 3, 2]]
        return corners, np.concatenate(self.attributes)


def offset_line(points: Float, distance: float) -> Float:
    """Shift a polyline to its left by ``distance`` metres, with mitred corners; ``(n, 2)``."""
    direction = np.diff(points, axis=0)
    direction /= np.maximum(np.linalg.norm(direction, axis=1, keepdims=True), 1e-9)
    before, after = np.vstack([direction[:1], direction]), np.vstack([direction, direction[-1:]])
    if len(points) > 3 and np.allclose(points[0], points[-1]):
        before[0], after[-1] = direction[-1], direction[0]
    mean = before + after
    # Mitre: the shift along the bisector that keeps the distance to both sides, bounded at hairpins.
    mean /= np.maximum(np.einsum("ni,ni->n", mean, mean)[:, None] / 2, 0.5)
    return points + distance * np.stack([-mean[:, 1], mean[:, 0]], axis=1)


def ribbon(points: Float, width: float, shift: float = 0.0) -> Float:
    """Cover a polyline by quadrilaterals of ``width`` metres, its centre shifted to the left by ``shift``.

    Returns:
        ``(n - 1, 4, 2)``; neighbours overlap by 3 cm, so that no seam shows.
    """
    keep = np.concatenate([[True], np.linalg.norm(np.diff(points, axis=0), axis=1) > 1e-3])
    points = points[keep]
    if len(points) < 2:
        return np.zeros((0, 4, 2))
    left, right = offset_line(points, shift + width / 2), offset_line(points, shift - width / 2)
    step = np.diff(points, axis=0)
    overlap = 0.03 * step / np.linalg.norm(step, axis=1, keepdims=True)
    end = overlap.copy()
    end[-1] = 0.0
    return np.stack([right[:-1], right[1:] + end, left[1:] + end, left[:-1]], axis=1)


def cut(points: Float, start: float, stop: float) -> Float:
    """Return the part of a polyline between two distances along it, metres; ``(k, 2)``."""
    distance = arc_length(points)
    inside = distance[(distance > start) & (distance < stop)]
    stations = np.concatenate([[max(start, 0.0)], inside, [min(stop, distance[-1])]])
    return np.stack([np.interp(stations, distance, points[:, axis]) for axis in range(2)], axis=1)


def _dashes(points: Float, width: float, shift: float, gap: float, phase: float) -> Float:
    length = arc_length(points)[-1]
    starts = np.arange(-phase, length, 3.0 + gap)
    pieces = [cut(points, start, start + 3.0) for start in starts if start + 3.0 > 0.2 and start < length - 0.2]
    ribbons = [ribbon(piece, width, shift) for piece in pieces]
    return np.concatenate(ribbons) if ribbons else np.zeros((0, 4, 2))


def _wear(generator: np.random.Generator) -> float:
    """Most paint is slightly worn, some is half gone, a little is nearly missing."""
    kind = generator.uniform()
    if kind < 0.68:
        return float(generator.uniform(0.0, 0.22))
    return float(generator.uniform(0.22, 0.55) if kind < 0.92 else generator.uniform(0.55, 0.85))


def _paint_divider(quads: Quads, divider: Divider, generator: np.random.Generator) -> None:
    yellow = float(divider.colour == "yellow")
    width, gap = generator.uniform(0.12, 0.20), generator.uniform(4.5, 9.0)
    phase, wear, albedo = generator.uniform(0, 5), _wear(generator), generator.uniform(0.45, 0.78)
    aside = (DOUBLE_GAP + DOUBLE_WIDTH) / 2
    points = np.asarray(divider.points, dtype=np.float64)
    starts = [0.0, *(distance for distance, _ in divider.changes), float(arc_length(points)[-1])]
    styles = [divider.style, *(style for _, style in divider.changes)]
    for style, start, stop in zip(styles, starts[:-1], starts[1:], strict=True):
        piece = cut(points, start, stop) if divider.changes else points
        if style is LineStyle.SOLID:
            shapes = ribbon(piece, width)
        elif style is LineStyle.DASHED:
            shapes = _dashes(piece, width, 0.0, gap, phase)
        elif style is LineStyle.DOUBLE_SOLID:
            shapes = np.concatenate([ribbon(piece, DOUBLE_WIDTH, side * aside) for side in (-1, 1)])
        elif style is LineStyle.SOLID_DASHED:
            shapes = np.concatenate(
                [ribbon(piece, DOUBLE_WIDTH, aside), _dashes(piece, DOUBLE_WIDTH, -aside, gap, phase)]
            )
        else:
            continue
        quads.add(shapes, wear, albedo, yellow)


def _paint_hatching(quads: Quads, hatching: Hatching, generator: np.random.Generator) -> None:
    """Parallel stripes over an area, each cut where the area's outline cuts it."""
    stripes = stripes_over(hatching.polygon, hatching.heading, generator.uniform(0.2, 0.6), generator.uniform(1.2, 3.0))
    yellow = float(hatching.colour == "yellow")
    quads.add(stripes, _wear(generator), generator.uniform(0.45, 0.78), yellow)


def stripes_over(polygon: Polygon, heading: float, width: float, period: float) -> Float:
    """Stripes along a heading (radians) over a convex or slightly bent polygon, ``(n, 4, 2)`` metres."""
    along = np.array([np.cos(heading), np.sin(heading)])
    across = np.array([-along[1], along[0]])
    ring = np.asarray(polygon.exterior.coords)
    low, high = (ring @ along).min() - 1.0, (ring @ along).max() + 1.0
    stripes: list[Float] = []
    for centre in np.arange((ring @ across).min() + width / 2, (ring @ across).max(), period):
        ends = []
        for edge in (centre - width / 2, centre + width / 2):
            hit = shapely.get_coordinates(
                LineString([edge * across + low * along, edge * across + high * along]).intersection(polygon)
            )
            if len(hit) >= 2:
                ends.append((hit[0], hit[1]))
        if len(ends) == 2:
            stripes.append(np.array([ends[0][0], ends[0][1], ends[1][1], ends[1][0]]))
    return np.array(stripes) if stripes else np.zeros((0, 4, 2))


def _bars(crossing: Crossing, generator: np.random.Generator) -> Float:
    """Bars across the walking direction, each cut obliquely where the crossing's outline cuts it."""
    across = np.array([np.cos(crossing.heading), np.sin(crossing.heading)])
    along = np.array([-across[1], across[0]])
    ring = np.asarray(crossing.polygon.exterior.coords)
    reach, extent = ring @ along, ring @ across
    width, period = generator.uniform(0.40, 0.50), generator.uniform(0.9, 1.15)
    count = max(1, int((np.ptp(extent) - width) / period) + 1)
    first = extent.min() + (np.ptp(extent) - (count - 1) * period) / 2
    bars: list[Float] = []
    for centre in first + period * np.arange(count):
        ends = []
        for edge in (centre - width / 2, centre + width / 2):
            line = LineString([edge * across + (reach.min() - 1) * along, edge * across + (reach.max() + 1) * along])
            hit = shapely.get_coordinates(line.intersection(crossing.polygon))
            if len(hit) >= 2:
                order = np.argsort(hit @ along)
                ends.append((hit[order[0]], hit[order[-1]]))
        if len(ends) == 2:
            bars.append(np.array([ends[0][0], ends[0][1], ends[1][1], ends[1][0]]))
    return np.array(bars) if bars else np.zeros((0, 4, 2))


def _side_lines(crossing: Crossing, width: float) -> Float:
    """The two lines across the road: the outline's edges that run in the walking direction."""
    across = np.array([np.cos(crossing.heading), np.sin(crossing.heading)])
    ring = np.asarray(shapely.geometry.polygon.orient(crossing.polygon).exterior.coords)
    ring = ring[:-1]
    step = np.roll(ring, -1, axis=0) - ring
    parallel = np.abs(step @ across) > 0.7 * np.linalg.norm(step, axis=1)
    lines = [
        ribbon(np.array([ring[edge], ring[edge] + step[edge]]), width, width / 2)
        for edge in np.flatnonzero(parallel & (np.linalg.norm(step, axis=1) > 0.5))
    ]
    return np.concatenate(lines) if lines else np.zeros((0, 4, 2))


def _paint_crossing(quads: Quads, crossing: Crossing, generator: np.random.Generator) -> None:
    wear, albedo, width = _wear(generator), generator.uniform(0.5, 0.8), generator.uniform(0.2, 0.35)
    wear = wear if crossing.wear is None else crossing.wear
    if crossing.style is not CrossingStyle.LINES:
        quads.add(_bars(crossing, generator), wear, albedo, 0.0)
    if crossing.style is not CrossingStyle.ZEBRA:
        quads.add(_side_lines(crossing, width), min(1.0, wear), albedo, 0.0)


def _rectangle(polygon: Polygon) -> Float | None:
    """Corners of the smallest rectangle round a polygon, its long sides first; ``(4, 2)``."""
    corners = np.asarray(polygon.minimum_rotated_rectangle.exterior.coords)[:4] if polygon.area > 1e-3 else None
    if corners is not None and np.linalg.norm(corners[1] - corners[0]) < np.linalg.norm(corners[2] - corners[1]):
        corners = np.roll(corners, -1, axis=0)
    return corners


def _paint_parking(quads: Quads, bay: Polygon, generator: np.random.Generator) -> None:
    """Thin lines between the places of a strip of bays; they belong to no class of the map."""
    corners = _rectangle(bay)
    if corners is None or generator.uniform() < 0.4:
        return
    long, deep = np.linalg.norm(corners[1] - corners[0]), np.linalg.norm(corners[2] - corners[1])
    pitch = 2.5 if deep > 4.0 else 5.8
    wear, albedo = generator.uniform(0.1, 0.6), generator.uniform(0.4, 0.7)
    for station in np.arange(0.0, long + 0.1, pitch) / max(long, 1e-6):
        start = corners[0] + station * (corners[1] - corners[0])
        stop = corners[3] + station * (corners[2] - corners[3])
        quads.add(ribbon(np.array([start, stop]), 0.1), wear, albedo, 0.0)


def paint_quads(vector_map: VectorMap, seed: int) -> tuple[Float, Float]:
    """Lay out all paint of a map: dividers, markings, hatchings, crossings, stop lines and parking bays.

    The seed decides widths, gaps, age and wear of each element.

    Returns:
        ``(n, 4, 2) float64`` corners, metres, and ``(n, 3) float64``: wear, albedo, yellow or white.
    """
    generator = np.random.default_rng([seed, 11])
    quads = Quads()
    for bay in vector_map.parking:
        _paint_parking(quads, bay, generator)
    for divider in vector_map.dividers:
        _paint_divider(quads, divider, generator)
    for marking in vector_map.markings:
        _paint_divider(quads, marking, generator)
    for hatching in vector_map.hatchings:
        _paint_hatching(quads, hatching, generator)
    for crossing in vector_map.crossings:
        _paint_crossing(quads, crossing, generator)
    for polygon in vector_map.stop_lines:
        corners = _rectangle(polygon)
        if corners is not None:
            middle = (corners + corners[::-1]) / 2
            width = min(0.45, float(np.linalg.norm(corners[2] - corners[1])))
            quads.add(ribbon(np.array([middle[0], middle[1]]), width), _wear(generator), 0.7, 0.0)
    return quads.arrays()
