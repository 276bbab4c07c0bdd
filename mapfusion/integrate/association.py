"""Which observation of a frame belongs to which element of the map."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from mapfusion.geometry import tangents
from mapfusion.integrate.config import IntegratorConfig
from mapfusion.integrate.fused_line import FusedLine
from mapfusion.integrate.matching import Correspondence, correspond
from mapfusion.integrate.observations import Observation

Float = NDArray[np.float64]
Integer = NDArray[np.int64]

TRACK_BONUS = 0.2
"""What it counts that a track was fused into an element before, on the scale of squared distance over its gate."""


@dataclass(frozen=True)
class Candidate:
    """An observation beside an element: rows of the element's stations, and how well both agree."""

    element: int
    match: Correspondence
    overlap: float
    distance: float
    benefit: float


@dataclass(frozen=True)
class LocalStations:
    """The stations of all elements of one kind near a frame, end to end."""

    elements: Integer
    owner: Integer
    row: Integer
    points: Float
    directions: Float


def gather(lines: Mapping[int, FusedLine], low: Float, high: Float) -> LocalStations | None:
    """Collect the stations inside a box of the global frame, as coordinates from ``low``.

    Args:
        lines: elements by id.
        low, high: ``(2,)``, metres.

    Returns:
        The stations, or None where there are none.
    """
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
        points.take(inside, axis=0) - low,
        tangents(points, ends).take(inside, axis=0),
    )


def candidates(
    observation: Observation,
    lines: Mapping[int, FusedLine],
    local: LocalStations,
    origin: Float,
    config: IntegratorConfig,
) -> list[Candidate]:
    """Return the elements that an observation may belong to."""
    curve = observation.points - origin
    match = correspond(
        local.points,
        local.directions,
        local.owner,
        curve,
        observation.directions,
        reach=1.5 * config.match_distance,
        angle=config.match_angle,
        end=0.6 * config.station_spacing,
    )
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
        found.append(Candidate(element, at_element, float(overlap), distance, benefit))
    return found


def assign(benefits: Sequence[Mapping[int, float]]) -> list[int | None]:
    """Give each observation at most one element and each element at most one observation, best in total.

    Args:
        benefits: per observation, the benefit (> 0) of each element it may belong to.

    Returns:
        The element of each observation, or None.
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
