"""Which observation of a frame belongs to which element of the map."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from mapfusion.config import IntegratorConfig
from mapfusion.lines import FusedLine
from mapfusion.matching import Correspondence, correspond, tangents
from mapfusion.observations import Observation

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
    elements: list[int] = []
    owner, row, points, directions = [], [], [], []
    for element, line in lines.items():
        at = line.curve.points
        inside = np.flatnonzero((at[:, 0] > low[0]) & (at[:, 0] < high[0]) & (at[:, 1] > low[1]) & (at[:, 1] < high[1]))
        if len(inside):
            owner.append(np.full(len(inside), len(elements)))
            elements.append(element)
            row.append(inside)
            points.append(at[inside] - low)
            directions.append(tangents(at)[inside])
    if not elements:
        return None
    return LocalStations(
        np.array(elements),
        np.concatenate(owner),
        np.concatenate(row),
        np.concatenate(points),
        np.concatenate(directions),
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
    owner = local.owner[match.station]
    count = np.bincount(owner, minlength=len(local.elements))
    total = np.bincount(owner, weights=match.distance, minlength=len(local.elements))
    # squares, because only they prefer to keep two parallel lines in order when both observations lie to one side
    squares = np.bincount(owner, weights=match.distance**2, minlength=len(local.elements))
    beside = np.flatnonzero(count)
    fused = [lines[int(local.elements[i])].evidence.tracks.get(observation.track, 0) for i in beside]
    most = max(max(fused), 1)
    found = []
    for position, frames in zip(beside, fused, strict=True):
        element = int(local.elements[position])
        distance = float(total[position] / count[position])
        shorter = min(len(curve), len(lines[element].curve))
        if distance > config.match_distance or count[position] < min(
            config.match_overlap / config.station_spacing, 0.5 * shorter
        ):
            continue
        own = np.flatnonzero(owner == position)
        mismatch = squares[position] / count[position] / config.match_distance**2
        benefit = count[position] * max(1.0 - mismatch + TRACK_BONUS * frames / most, 0.01)
        found.append(
            Candidate(
                element,
                Correspondence(
                    local.row[match.station[own]],
                    match.vertex[own],
                    match.offset[own],
                    match.distance[own],
                    match.same_way[own],
                ),
                float(count[position]),
                distance,
                float(benefit),
            )
        )
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
