"""Observations in the global frame from the polylines of one frame; broken ones are counted and left out."""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass

import numpy as np
import shapely

from mapfusion.arrays import Float
from mapfusion.elements import ElementKind, FrameMap
from mapfusion.geometry import clip_line, tangents, transform_points
from mapfusion.integrate.config import IntegratorConfig
from mapfusion.integrate.evidence import Track
from mapfusion.integrate.marks import place_mark, track_mark
from mapfusion.integrate.station_curve import INFORMATION, OBSERVATIONS, PLACES, SEEN, SEEN_VIEW, TRACKS, StationCurve
from mapfusion.integrate.views import view_weight

SURE_SCORE = 0.5
"""Score from which on a detection is a whole sighting."""


@dataclass(frozen=True)
class Observation:
    """Detected line or ring, in the global frame.

    Attributes:
        kind: of the element.
        track: its log and its id there.
        curve: its vertices in the global frame, of a line one station apart, with what the sighting says there. How
            much of a look at each vertex it answers is the view weight, less below :data:`SURE_SCORE`, where the
            element was in part missed (a track that coasts).
        directions: ``(n, 2) float64``, unit, along the vertices.
    """

    kind: ElementKind
    track: Track
    curve: StationCurve
    directions: Float

    @property
    def points(self) -> Float:
        """``(n, 2) float64``, metres, global frame."""
        return self.curve.points

    @property
    def sighting(self) -> float:
        """Weight of the sighting: 1 at :data:`SURE_SCORE`, in proportion to the score, at most 1.5."""
        return float(self.curve.seen[0])


def observe(
    frame_map: FrameMap,
    config: IntegratorConfig,
    rejections: Counter[str],
    log: int = 0,
    visible: shapely.Geometry | None = None,
) -> tuple[list[Observation], list[Observation]]:
    """Return the lines (clipped to the ROI, resampled) and the rings of a frame that can be fused.

    Args:
        frame_map: one instant; only tracked elements are used.
        config: spacing and error model.
        rejections: counted up by reason for every element that is left out.
        log: number of the drive.
        visible: what could be seen, ego frame; None for all of the ROI.
    """
    half = frame_map.roi.size / 2
    box = shapely.box(*-half, *half)
    line_rows: list[int] = []
    ring_rows: list[int] = []
    lines: list[Float] = []
    rings: list[Float] = []
    rows = np.flatnonzero(frame_map.track_ids >= 0).tolist()
    polylines = [np.asarray(frame_map.polylines[row], dtype=np.float64) for row in rows]
    extents = _extents(polylines, config)
    for row, points, extent in zip(rows, polylines, extents, strict=True):
        problem = _element_problem(int(frame_map.kinds[row]), float(frame_map.scores[row]), points, extent, config)
        if problem is not None:
            rejections[problem] += 1
            continue
        ring = int(frame_map.kinds[row]) == ElementKind.PED_CROSSING
        (left, rear), (right, front) = extent
        within = max(-left, right) <= half[0] and max(-rear, front) <= half[1]
        parts = _ring_parts(points, box, within) if ring else [points] if within else clip_line(points, frame_map.roi)
        if not parts:
            rejections["ring without area" if ring else "outside the region of interest"] += 1
        (rings if ring else lines).extend(parts)
        (ring_rows if ring else line_rows).extend([row] * len(parts))
    curves = _stations(lines, config.station_spacing)
    rejections.update({"line without length": len(lines) - len(curves)} if len(curves) < len(lines) else {})
    used = [line_rows[number] for number in curves] + ring_rows
    observations = _observations(frame_map, used, [*curves.values(), *rings], config, log, visible)
    return observations[: len(curves)], observations[len(curves) :]


def _observations(
    frame_map: FrameMap,
    rows: list[int],
    curves: list[Float],
    config: IntegratorConfig,
    log: int,
    visible: shapely.Geometry | None,
) -> list[Observation]:
    """Return curves of the ego frame as observations, all at once."""
    if not rows:
        return []
    local = np.concatenate(curves)
    sizes = [len(curve) for curve in curves]
    ends = np.cumsum(sizes)
    scores = np.asarray(frame_map.scores, dtype=np.float64)[rows]
    deviation = config.deviation_near + config.deviation_per_metre * np.sqrt((local * local).sum(axis=1))
    sums = np.zeros((len(local), 5))
    sums[:, INFORMATION] = np.repeat(np.maximum(scores, 0.05), sizes) / deviation**2
    sums[:, SEEN] = np.repeat(np.minimum(scores / SURE_SCORE, 1.5), sizes)
    answered = np.repeat(np.minimum(scores / SURE_SCORE, 1.0), sizes)
    sums[:, SEEN_VIEW] = answered * _looked_at(frame_map, rows, sizes, local, config, visible)
    sums[:, OBSERVATIONS] = 1.0
    marks = np.empty((len(local), 2), dtype=np.uint64)
    marks[:, PLACES] = place_mark(log, frame_map.ego_to_global[:2, 3])
    ids = frame_map.track_ids[rows].tolist()
    marks[:, TRACKS] = np.repeat(np.array([track_mark(log, track) for track in ids], dtype=np.uint64), sizes)
    points = transform_points(frame_map.ego_to_global, local)
    directions = tangents(points, ends)
    curve = StationCurve(points, sums, marks)
    return [
        Observation(
            kind=ElementKind(kind),
            track=(log, track),
            curve=curve.part(start, stop),
            directions=directions[start:stop],
        )
        for kind, track, start, stop in zip(
            frame_map.kinds[rows].tolist(), ids, [0, *ends[:-1].tolist()], ends.tolist(), strict=True
        )
    ]


def _looked_at(
    frame_map: FrameMap,
    rows: list[int],
    sizes: list[int],
    local: Float,
    config: IntegratorConfig,
    visible: shapely.Geometry | None,
) -> Float:
    """Return the view weights of the points of all curves; what of a ring could not be seen is known by its cells."""
    whole = view_weight(local, frame_map.roi, config)
    if visible is None:
        return whole
    ring = np.repeat(frame_map.kinds[rows] == ElementKind.PED_CROSSING, sizes)
    return np.where(ring, whole, view_weight(local, frame_map.roi, config, visible))


def _well_formed(points: Float, config: IntegratorConfig) -> bool:
    return points.ndim == 2 and points.shape[1] == 2 and 2 <= len(points) <= config.max_points


def _extents(polylines: list[Float], config: IntegratorConfig) -> list[list[list[float]]]:
    """Return the least and the largest coordinates of each polyline, all at once; NaN for those that are no lines."""
    formed = [number for number, points in enumerate(polylines) if _well_formed(points, config)]
    extents = np.full((len(polylines), 2, 2), np.nan)
    if formed:
        sizes = np.array([len(polylines[number]) for number in formed])
        points, first = np.concatenate([polylines[number] for number in formed]), np.cumsum(sizes) - sizes
        extents[formed, 0] = np.minimum.reduceat(points, first)
        extents[formed, 1] = np.maximum.reduceat(points, first)
    plain: list[list[list[float]]] = extents.tolist()
    return plain


def _element_problem(
    kind: int, score: float, points: Float, extent: list[list[float]], config: IntegratorConfig
) -> str | None:
    if kind not in (0, 1, 2):
        return "unknown kind"
    if not 0.0 <= score <= 1.0:
        return "score outside [0, 1]"
    if not _well_formed(points, config):
        if points.ndim != 2 or points.shape[1] != 2:
            return "points are not (n, 2)"
        return "fewer than two points" if len(points) < 2 else "too many points"
    low, high = extent
    if not (math.isfinite(low[0]) and math.isfinite(low[1]) and math.isfinite(high[0]) and math.isfinite(high[1])):
        return "points not finite"
    if low == high:
        return "line without length"
    return None


def _ring_parts(points: Float, box: shapely.Polygon, within: bool) -> list[Float]:
    """Clip a ring and keep its largest part; one that crosses itself is repaired."""
    if len(points) < 3:
        return []
    polygon = shapely.Polygon(points)
    if not polygon.is_valid:
        polygon = shapely.make_valid(polygon, method="structure", keep_collapsed=False)
    parts = [
        part
        for part in shapely.get_parts(polygon if within else shapely.intersection(polygon, box))
        if part.geom_type == "Polygon" and part.area > 0.1
    ]
    if not parts:
        return []
    return [shapely.get_coordinates(max(parts, key=lambda part: part.area).exterior)]


def _stations(lines: list[Float], spacing: float) -> dict[int, Float]:
    """Resample lines ``(k, 2)`` about every ``spacing`` metres, both ends included, all at once.

    Returns stations by number of the line; those without length are missing.
    """
    if not lines:
        return {}
    points = np.concatenate(lines)
    sizes = np.array([len(line) for line in lines])
    first = np.cumsum(sizes) - sizes
    step = np.diff(points, axis=0, prepend=points[:1])
    step[first] = 0.0
    total = np.cumsum(np.sqrt(step[:, 0] ** 2 + step[:, 1] ** 2))
    start, length = total[first], total[first + sizes - 1] - total[first]
    long = length >= spacing / 2
    count = np.where(long, np.maximum(np.rint(length / spacing), 1) + 1, 0).astype(np.int64)
    # one abscissa for all: a line begins well past where the one before it ends
    apart = np.arange(len(lines)) * spacing
    stops = np.cumsum(count)
    number = np.arange(stops[-1]) - np.repeat(stops - count, count)
    at = np.repeat(start + apart, count) + number * np.repeat(length / np.maximum(count - 1, 1), count)
    along = total + np.repeat(apart, sizes)
    stations = np.stack([np.interp(at, along, points[:, 0]), np.interp(at, along, points[:, 1])], axis=1)
    return {line: stations[stops[line] - count[line] : stops[line]] for line in np.flatnonzero(long).tolist()}
