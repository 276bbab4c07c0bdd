"""From the polylines of one frame to observations in the global frame; what is broken is named and left out."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
import shapely
from numpy.typing import NDArray

from mapfusion.config import IntegratorConfig
from mapfusion.elements import ElementKind, FrameMap, RegionOfInterest
from mapfusion.geometry import arc_length, transform_points
from mapfusion.views import view_weight

Float = NDArray[np.float64]

Track: TypeAlias = tuple[str, int]
"""A track of a drive: name of the log, id within it. Different logs count their tracks from the same number."""

SURE_SCORE = 0.5
"""A detection with this score is a whole sighting."""


@dataclass(frozen=True)
class Observation:
    """One detected line or ring, in the global frame.

    Attributes:
        kind: what it is.
        track: its log and its id there.
        score: in ``[0, 1]``.
        points: ``(n, 2) float64``, metres, global frame; lines have vertices one station apart.
        information: ``(n,) float64``, inverse variance across the line, 1 / m².
        view: ``(n,) float64``, how much of a look at each vertex the sighting answers: the view weight, less below
            :data:`SURE_SCORE`, where the element was in part missed (a track that coasts).
    """

    kind: ElementKind
    track: Track
    score: float
    points: Float
    information: Float
    view: Float

    @property
    def sighting(self) -> float:
        """What the sighting counts for: 1 at :data:`SURE_SCORE`, in proportion to the score, at most 1.5."""
        return min(self.score / SURE_SCORE, 1.5)

    def part(self, start: int, stop: int) -> Observation:
        """Return the observation of vertices ``start`` to ``stop`` (excluded)."""
        piece = slice(start, stop)
        return Observation(
            self.kind, self.track, self.score, self.points[piece], self.information[piece], self.view[piece]
        )


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
    log: str = "",
    visible: shapely.Geometry | None = None,
) -> tuple[list[Observation], list[Observation]]:
    """Return the lines and the rings of a frame that can be fused.

    Args:
        frame_map: one instant; only tracked elements are used.
        config: spacing and error model.
        rejections: counted up by reason for every element that is left out.
        log: name of the drive.
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
    log: str,
    visible: shapely.Geometry | None,
) -> list[Observation]:
    """Say where the points of curves of the ego frame lie and what they are worth, all at once."""
    if not rows:
        return []
    local = np.concatenate(curves)
    ends = np.cumsum([len(curve) for curve in curves])
    deviation = config.deviation_near + config.deviation_per_metre * np.sqrt((local**2).sum(axis=1))
    points = transform_points(frame_map.ego_to_global, local)
    view = whole = view_weight(local, frame_map.roi, config)
    if visible is not None:
        view = view_weight(local, frame_map.roi, config, visible)
    observations = []
    for row, start, stop in zip(rows, [0, *ends[:-1].tolist()], ends.tolist(), strict=True):
        score = float(frame_map.scores[row])
        kind = ElementKind(int(frame_map.kinds[row]))
        looked = whole if kind.is_ring else view  # what of a ring could not be seen is known by its cells
        observations.append(
            Observation(
                kind=kind,
                track=(log, int(frame_map.track_ids[row])),
                score=score,
                points=points[start:stop],
                information=max(score, 0.05) / deviation[start:stop] ** 2,
                view=looked[start:stop] * min(score / SURE_SCORE, 1.0),
            )
        )
    return observations


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
