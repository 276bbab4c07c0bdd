"""Extraction of map elements from fused lines and crossings: stretches with evidence, smoothed and simplified."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import pairwise

import numpy as np
import shapely
from scipy.linalg import solveh_banded
from scipy.special import expit

from mapfusion.arrays import Bool, Float
from mapfusion.corners import drawn_outline
from mapfusion.elements import ElementKind, MapElement
from mapfusion.geometry import arc_length, simplified_rows
from mapfusion.integrate.config import IntegratorConfig
from mapfusion.integrate.evidence import Evidence
from mapfusion.integrate.fused_line import FusedLine
from mapfusion.integrate.fused_ring import FusedRing
from mapfusion.integrate.station_curve import StationCurve
from mapfusion.integrate.uncertainty import line_deviations, ring_deviations
from mapfusion.integrate.views import ViewGrid
from mapfusion.line_repair import closes, hairpins, repaired_rows

LOG_ODDS_LIMIT = 6.0
"""Log-odds are clamped to plus or minus this."""


def log_odds(seen: Float, missed: Float, config: IntegratorConfig) -> Float:
    """Return the log-odds of existence, from sums of sightings and of missed sightings."""
    odds = config.prior_log_odds + config.hit_log_odds * seen - config.miss_log_odds * missed
    return np.clip(odds, -LOG_ODDS_LIMIT, LOG_ODDS_LIMIT)


def line_elements(
    line: FusedLine, views: ViewGrid, parts: Float, config: IntegratorConfig, logs: Mapping[int, str]
) -> list[MapElement]:
    """Return the stretches of a line with enough evidence, as elements.

    ``parts`` are those of the detector's error, ``logs`` the names of the drives by number.
    """
    curve = line.curve
    if line.evidence.observations < config.min_observations:
        return []
    missed = np.maximum(views.at(curve.points) - curve.seen_view, 0.0)
    odds = log_odds(curve.seen, missed, config)
    if curve.seen.max() < config.whole_sightings and np.median(odds) <= 0.0:
        return []
    alive = _supported(odds, config.weak_log_odds) & (curve.information > 1.0 / config.max_deviation**2)
    points = smooth(curve, config)
    deviation = line_deviations(curve, parts, config.common_deviation)
    elements = []
    stretches = _stretches(alive, int(config.max_gap / config.station_spacing))
    for start, stop in (part for stretch in stretches for part in _unfolded(points, *stretch)):
        rows = start + repaired_rows(points[start:stop])
        if len(rows) < 2 or arc_length(points[rows])[-1] < config.min_length:
            continue
        if closes(points[rows]):
            rows = np.append(rows, rows[0])
        rows = rows[simplified_rows(points[rows], config.simplify_tolerance)]
        sure = float(expit(odds[start:stop]).mean())
        elements.append(_element(line.kind, points[rows], sure, line.evidence, deviation[rows], logs))
    return elements


def ring_elements(
    ring: FusedRing, views: ViewGrid, parts: Float, config: IntegratorConfig, logs: Mapping[int, str]
) -> list[MapElement]:
    """Return a crossing as one element, none where the evidence is too little; arguments of :func:`line_elements`."""
    if ring.evidence.observations < config.min_observations:
        return []
    held = np.argwhere(ring.level() > 0)
    outline = ring.outline(config.ring_cell)
    if not len(held) or outline is None or outline.area < config.min_area:
        return []
    held = held[:: max(len(held) // 64, 1)]
    missed = views.at(np.asarray((held + ring.corner + 0.5) * config.ring_cell, dtype=np.float64))
    missed = np.maximum(missed - ring.seen_view[held[:, 0], held[:, 1]], 0.0)
    odds = log_odds(np.array([ring.seen]), np.array([np.median(missed)]), config)[0]
    if odds <= 0.0:
        return []
    points = shapely.get_coordinates(shapely.orient_polygons(drawn_outline(outline)))
    cells = np.floor(points / config.ring_cell).astype(np.int64) - ring.corner
    looked = ring.looked[cells[:, 0].clip(0, ring.looked.shape[0] - 1), cells[:, 1].clip(0, ring.looked.shape[1] - 1)]
    deviation = ring_deviations(ring, looked.astype(np.float64), parts, config.common_deviation)
    return [_element(ring.kind, points, float(expit(odds)), ring.evidence, deviation, logs)]


def smooth(curve: StationCurve, config: IntegratorConfig) -> Float:
    """Smooth a curve as far as its evidence leaves it open (Whittaker's smoother, weighted by information): ``(n, 2)``.

    Minimises ``sum information |z - p|² + sum |second difference of z|² / curvature_deviation²``.
    """
    count = len(curve)
    if count < 3:
        return curve.points
    stiffness = 1.0 / config.curvature_deviation**2
    bands = np.zeros((3, count))
    bands[2] = curve.information
    bands[2, :-2] += stiffness
    bands[2, 1:-1] += 4.0 * stiffness
    bands[2, 2:] += stiffness
    bands[1, 1:-1] -= 2.0 * stiffness
    bands[1, 2:] -= 2.0 * stiffness
    bands[0, 2:] += stiffness
    origin = curve.points[0]
    solved = solveh_banded(bands, curve.information[:, None] * (curve.points - origin))
    return np.asarray(solved + origin, dtype=np.float64)


def _supported(odds: Float, weak: float) -> Bool:
    """Return which stations exist: more likely than not, or weaker but connected to such ones (hysteresis)."""
    strong, possible = odds > 0.0, odds > weak
    stretch = np.cumsum(np.diff(possible, prepend=False))
    return np.asarray(possible & np.isin(stretch, stretch[strong]))


def _stretches(alive: Bool, gap: int) -> list[tuple[int, int]]:
    """Return start and stop (excluded) of the runs of True, with gaps of up to ``gap`` bridged."""
    rows = np.flatnonzero(alive)
    if not len(rows):
        return []
    breaks = np.flatnonzero(np.diff(rows) > gap + 1)
    starts = rows[np.concatenate([[0], breaks + 1])]
    stops = rows[np.concatenate([breaks, [len(rows) - 1]])] + 1
    return list(zip(starts.tolist(), stops.tolist(), strict=True))


def _unfolded(points: Float, start: int, stop: int) -> list[tuple[int, int]]:
    """Cut a stretch where it turns back on itself."""
    edges = [start, *(start + tip for tip in hairpins(points[start:stop])), stop]
    return [(a, min(b + 1, stop)) for a, b in pairwise(edges)]


def _element(
    kind: ElementKind,
    points: Float,
    confidence: float,
    evidence: Evidence,
    deviation: Float | None,
    logs: Mapping[int, str],
) -> MapElement:
    origins: dict[str, list[int]] = {}
    for log, track in evidence.tracks:
        origins.setdefault(logs[log], []).append(track)
    element = MapElement(
        kind=kind,
        points=points,
        confidence=confidence,
        observations=evidence.observations,
        first_seen=evidence.first_seen,
        last_seen=evidence.last_seen,
        deviation=deviation,
    )
    return element.with_origins({log: tuple(tracks) for log, tracks in origins.items()})
