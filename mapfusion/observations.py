"""From the polylines of one frame to observations in the global frame; what is broken is named and left out."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
import shapely
from numpy.typing import NDArray

from mapfusion.config import IntegratorConfig
from mapfusion.curve import INFORMATION, OBSERVATIONS, PLACES, SEEN, SEEN_VIEW, TRACKS, Curve
from mapfusion.elements import ElementKind, FrameMap, RegionOfInterest
from mapfusion.geometry import arc_length, transform_points
from mapfusion.matching import tangents_of_all
from mapfusion.uncertainty import place_mark, track_mark
from mapfusion.views import view_weight

Float = NDArray[np.float64]

Track: TypeAlias = tuple[int, int]
"""A track of a drive: number of the log, id within it. Different logs count their tracks from the same number."""

SURE_SCORE = 0.5
"""A detection with this score is a whole sighting."""


@dataclass(frozen=True)
class Observation:
    """One detected line or ring, in the global frame.

    Attributes:
        kind: what it is.
        track: its log and its id there.
        curve: its vertices in the global frame, of a line one station apart, with what the sighting says there. How
            much of a look at each vertex it answers is the view weight, less below :data:`SURE_SCORE`, where the
            element was in part missed (a track that coasts).
        directions: ``(n, 2) float64``, unit, along the vertices.
    """

    kind: ElementKind
    track: Track
    curve: Curve
    directions: Float

    @property
    def points(self) -> Float:
        """``(n, 2) float64``, metres, global frame."""
        return self.curve.points

    @property
    def sighting(self) -> float:
        """What the sighting counts for: 1 at :data:`SURE_SCORE`, in proportion to the score, at most 1.5."""
        return float(self.curve.seen[0])


def pose_problem(ego_to_global: Float) -> str | None:
    """Say what is wrong with a pose, or None: it must be ``(4, 4)``, finite and rigid."""
    pose = np.asarray(ego_to_global)
    if pose.shape != (4, 4):
        return "pose is not 4 x 4"
    if not np.isfinite(pose).all():
        return "pose is not finite"
    rotation = pose[:3, :3]
    if not np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-3) or np.linalg.det(rotation) < 0:
        return "pose is not rigid"
    return None


def observe(
    frame_map: FrameMap,
    config: IntegratorConfig,
    rejections: Counter[str],
    log: int = 0,
    visible: shapely.Geometry | None = None,
) -> tuple[list[Observation], list[Observation]]:
    """Return the lines and the rings of a frame that can be fused.

    Args:
        frame_map: one instant; only tracked elements are used.
        config: spacing and error model.
        rejections: counted up by reason for every element that is left out.
        log: number of the drive.
        visible: what could be seen, ego frame; None for all of the ROI.

    Returns:
        Lines (clipped to the ROI, resampled) and rings.
    """
    box = shapely.box(*(-frame_map.roi.size / 2), *(frame_map.roi.size / 2))
    rows: list[int] = []
    curves: list[Float] = []
    for row in np.flatnonzero(frame_map.track_ids >= 0).tolist():
        points = np.asarray(frame_map.polylines[row], dtype=np.float64)
        problem = _element_problem(points, frame_map.kinds[row], frame_map.scores[row], config)
        if problem is not None:
            rejections[problem] += 1
            continue
        ring = ElementKind(int(frame_map.kinds[row])).is_ring
        pieces = _ring_pieces(points, box) if ring else _line_pieces(points, box, frame_map.roi)
        if not pieces:
            rejections["ring without area" if ring else "outside the region of interest"] += 1
        for piece in pieces:
            curve = piece if ring else _stations(piece, config.station_spacing)
            if curve is None:
                rejections["line without length"] += 1
                continue
            rows.append(row)
            curves.append(curve)
    observations = _observations(frame_map, rows, curves, config, log, visible)
    return [o for o in observations if not o.kind.is_ring], [o for o in observations if o.kind.is_ring]


def _observations(
    frame_map: FrameMap,
    rows: list[int],
    curves: list[Float],
    config: IntegratorConfig,
    log: int,
    visible: shapely.Geometry | None,
) -> list[Observation]:
    """Say where the points of curves of the ego frame lie and what they are worth, all at once."""
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
    directions = tangents_of_all(points, ends)
    curve = Curve(points, sums, marks)
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


def _element_problem(points: Float, kind: int, score: float, config: IntegratorConfig) -> str | None:
    if kind not in (0, 1, 2):
        return "unknown kind"
    if not (np.isfinite(score) and 0.0 <= score <= 1.0):
        return "score outside [0, 1]"
    if points.ndim != 2 or points.shape[1] != 2 or len(points) < 2:
        return "fewer than two points"
    if len(points) > config.max_points:
        return "too many points"
    if not np.isfinite(points).all():
        return "points not finite"
    if not np.ptp(points, axis=0).any():
        return "line without length"
    return None


def _line_pieces(points: Float, box: shapely.Polygon, roi: RegionOfInterest) -> list[Float]:
    if (np.abs(points) <= roi.size / 2).all():
        return [points]
    inside = shapely.line_merge(shapely.intersection(shapely.LineString(points), box))
    return [shapely.get_coordinates(part) for part in shapely.get_parts(inside) if part.geom_type == "LineString"]


def _ring_pieces(points: Float, box: shapely.Polygon) -> list[Float]:
    """Clip a ring; one that crosses itself is repaired and its largest part kept."""
    if len(points) < 3:
        return []
    polygon = shapely.Polygon(points)
    if not polygon.is_valid:
        polygon = shapely.make_valid(polygon, method="structure", keep_collapsed=False)
    parts = [
        part
        for part in shapely.get_parts(shapely.intersection(polygon, box))
        if part.geom_type == "Polygon" and part.area > 0.1
    ]
    if not parts:
        return []
    return [shapely.get_coordinates(max(parts, key=lambda part: part.area).exterior)]


def _stations(points: Float, spacing: float) -> Float | None:
    distance = arc_length(points)
    if distance[-1] < spacing / 2:
        return None
    count = max(round(distance[-1] / spacing), 1) + 1
    at = np.arange(count) * (distance[-1] / (count - 1))
    return np.stack([np.interp(at, distance, points[:, 0]), np.interp(at, distance, points[:, 1])], axis=1)
