"""Association of the observations of one frame with the elements of the map."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import shapely
from scipy.optimize import linear_sum_assignment

from mapfusion.arrays import Float, Integer
from mapfusion.elements import FrameMap
from mapfusion.geometry import tangents
from mapfusion.integrate.config import IntegratorConfig
from mapfusion.integrate.fused_line import FusedLine
from mapfusion.integrate.fused_ring import FusedRing, RingSighting, overlap, room_of, sight
from mapfusion.integrate.matching import Correspondence, DirectedPoints, MatchLimits, correspond
from mapfusion.integrate.observations import Observation

TRACK_BONUS = 0.2
"""Bonus of an element into which the track was fused before, on the scale of squared distance over its gate."""

MATCH_REACH = 1.5
"""Single stations are compared up to this multiple of the match distance, which bounds their mean."""

TAKEN_SHARE = 0.3
"""Share of a stretch of an element from which on it counts as taken by other observations of the frame."""


@dataclass(frozen=True)
class LineCandidate:
    """Candidate element that an observation lies beside.

    Attributes:
        element: its id.
        match: its stations beside vertices of the observation.
        overlap: number of those stations.
        distance: mean lateral distance, metres.
        benefit: of the assignment, more for a longer and closer match.
    """

    element: int
    match: Correspondence
    overlap: float
    distance: float
    benefit: float


@dataclass(frozen=True)
class LocalStations:
    """Stations of all elements of one kind near a frame, end to end, in metres from the box's lower left corner.

    ``owner (n,)`` says which of the elements each belongs to, and ``row (n,)`` its row in that element.
    """

    elements: Integer
    owner: Integer
    row: Integer
    stations: DirectedPoints


def stations_near(lines: Mapping[int, FusedLine], low: Float, high: Float) -> LocalStations | None:
    """Collect the stations inside a box of the global frame, as coordinates from ``low``; None where there are none."""
    if not lines:
        return None
    curves = [line.curve.points for line in lines.values()]
    sizes = np.array([len(curve) for curve in curves])
    ends = np.cumsum(sizes)
    points = np.concatenate(curves)
    x, y = points[:, 0], points[:, 1]
    (inside,) = ((x > low[0]) & (x < high[0]) & (y > low[1]) & (y < high[1])).nonzero()
    if not len(inside):
        return None
    owner = np.repeat(np.arange(len(curves)), sizes).take(inside)
    return LocalStations(
        np.array(list(lines)),
        owner,
        inside - (ends - sizes).take(owner),
        DirectedPoints(points.take(inside, axis=0) - low, tangents(points, ends).take(inside, axis=0)),
    )


def line_candidates(
    observation: Observation,
    lines: Mapping[int, FusedLine],
    local: LocalStations,
    origin: Float,
    config: IntegratorConfig,
) -> list[LineCandidate]:
    """Return the elements that an observation may belong to."""
    curve = observation.points - origin
    limits = MatchLimits(MATCH_REACH * config.match_distance, config.match_angle, 0.6 * config.station_spacing)
    match = correspond(local.stations, local.owner, DirectedPoints(curve, observation.directions), limits)
    if not len(match.station):
        return []
    owner = local.owner.take(match.station)
    count = np.bincount(owner)
    beside = count.nonzero()[0].tolist()
    # squares, because only they prefer to keep two parallel lines in order when both observations lie to one side
    counts, totals, squares = (
        values.tolist()
        for values in (count, np.bincount(owner, match.distance), np.bincount(owner, match.distance * match.distance))
    )
    elements = [int(local.elements[i]) for i in beside]
    fused = [lines[element].evidence.tracks.get(observation.track, 0) for element in elements]
    most = max(max(fused), 1)
    found = []
    for position, element, frames in zip(beside, elements, fused, strict=True):
        overlap = counts[position]
        distance = totals[position] / overlap
        shorter = min(len(curve), len(lines[element].curve.points))
        if distance > config.match_distance or overlap < min(
            config.match_overlap / config.station_spacing, 0.5 * shorter
        ):
            continue
        mismatch = squares[position] / overlap / config.match_distance**2
        benefit = overlap * max(1.0 - mismatch + TRACK_BONUS * frames / most, 0.01)
        own = match if len(beside) == 1 else match.rows((owner == position).nonzero()[0])
        at_element = own.renumbered(local.row.take(own.station))
        found.append(LineCandidate(element, at_element, float(overlap), distance, benefit))
    return found


def best_assignment(benefits: Sequence[Mapping[int, float]]) -> list[int | None]:
    """Give each observation at most one element and each element at most one observation, best in total.

    ``benefits`` hold for each observation the benefit (> 0) of each element it may belong to.
    """
    columns = sorted({element for row in benefits for element in row})
    table = np.zeros((len(benefits), len(columns)))
    place = {element: column for column, element in enumerate(columns)}
    for row, options in enumerate(benefits):
        for element, benefit in options.items():
            table[row, place[element]] = benefit
    chosen: list[int | None] = [None] * len(benefits)
    for row, column in zip(*linear_sum_assignment(table, maximize=True), strict=True):
        if table[row, column] > 0:
            chosen[int(row)] = columns[int(column)]
    return chosen


class LineMatching:
    """Matching of the lines of one kind that a frame shows with the lines of the map.

    Args:
        observations: of one frame.
        lines: of the map near the frame, by id.
        low, high: ``(2,)``, box that the frame looked at, metres.
        config: of the integrator.
    """

    def __init__(
        self,
        observations: Sequence[Observation],
        lines: Mapping[int, FusedLine],
        low: Float,
        high: Float,
        config: IntegratorConfig,
    ) -> None:
        local = stations_near(lines, low, high)
        self._candidates = [
            line_candidates(observation, lines, local, low, config) if local is not None else []
            for observation in observations
        ]
        self._assigned = best_assignment([{c.element: c.benefit for c in found} for found in self._candidates])
        self._taken: dict[int, set[int]] = {}

    def order(self) -> list[int]:
        """Return the numbers of the observations, those with an element of their own first."""
        return sorted(range(len(self._candidates)), key=lambda number: self._assigned[number] is None)

    def choice(self, number: int) -> LineCandidate | None:
        """Return where an observation goes: its own element, or else the first that is free there."""
        candidates, assigned = self._candidates[number], self._assigned[number]
        own = [c for c in candidates if c.element == assigned] or [c for c in candidates if self._free(c)][:1]
        return own[0] if own else None

    def take(self, number: int, chosen: LineCandidate) -> tuple[list[int], list[int]]:
        """Mark the chosen stretch as taken; return the other elements beside the observation.

        First those that the frame shows, too, then the rest, which may be the same line as the chosen one.
        """
        shown: list[int] = []
        twins: list[int] = []
        for other in self._candidates[number]:
            if other.element != chosen.element:
                seen_too = other.element in self._assigned and not self._free(other)
                (shown if seen_too else twins).append(other.element)
        self._taken.setdefault(chosen.element, set()).update(chosen.match.station.tolist())
        return shown, twins

    def untouched(self, element: int) -> bool:
        """Whether nothing of this frame was taken to an element so far."""
        return element not in self._taken

    def _free(self, candidate: LineCandidate) -> bool:
        """Whether little of a candidate's stretch is taken."""
        stations = self._taken.get(candidate.element)
        if stations is None:
            return True
        return len(stations.intersection(candidate.match.station.tolist())) < TAKEN_SHARE * candidate.overlap


@dataclass(frozen=True)
class RingCandidates:
    """Crossings of the map that an observed ring may belong to: ``overlaps``, intersection over union by their ids.

    The sighting has room for the ring, which needs the cells ``low`` to ``high``, and for all of them.
    """

    sighting: RingSighting
    low: Integer
    high: Integer
    overlaps: dict[int, float]


def ring_candidates(
    observations: Sequence[Observation],
    rings: Mapping[int, FusedRing],
    frame_map: FrameMap,
    visible: shapely.Geometry | None,
    config: IntegratorConfig,
) -> list[RingCandidates]:
    """Compare the rings of a frame with the crossings of the map near it, by id."""
    corners = np.array([ring.corner for ring in rings.values()], dtype=np.int64).reshape(-1, 2)
    stops = np.array([ring.stop for ring in rings.values()], dtype=np.int64).reshape(-1, 2)
    ids = list(rings)
    found = []
    for observation in observations:
        low, high = room_of(observation.points, config.ring_cell)
        rows = np.flatnonzero(((corners < high) & (stops > low)).all(axis=1))
        room = np.vstack([corners[rows], low]).min(axis=0), np.vstack([stops[rows], high]).max(axis=0)
        sighting = sight(observation, room, frame_map.ego_to_global, frame_map.roi, config.ring_cell, visible)
        overlaps = {}
        for element in (ids[row] for row in rows.tolist()):
            ring = rings[element]
            share = overlap(ring, sighting)
            # less overlap is enough where the track is known
            if share > config.ring_overlap * (0.5 if observation.track in ring.evidence.tracks else 1.0):
                overlaps[element] = share
        found.append(RingCandidates(sighting, low, high, overlaps))
    return found
