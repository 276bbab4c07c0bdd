"""Lane graph: the lanes of each stretch of street, by direction."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mapfusion.arrays import Float
from predmapnet.demo_world.town.cross_sections import DRIVEN, CrossSection
from predmapnet.demo_world.town.reference_line import ReferenceLine

WIDE_ENOUGH = 2.0
"""A lane is open where it is at least this wide, metres."""


@dataclass(frozen=True)
class Carriageway:
    """The lanes of one direction between two nodes.

    Attributes:
        lines: ``(lanes, n, 2)`` centre lines in driving direction, from left to right as the driver sees them.
        open_at_start, open_at_end: ``(lanes,) bool``: whether a lane is there at its ends.
        nodes: where it starts and ends; -1 outside the town.
        stop: metres before its end at which cars wait; NaN where they don't.
        main: whether it is more than an alley.
    """

    lines: Float
    open_at_start: NDArray[np.bool_]
    open_at_end: NDArray[np.bool_]
    nodes: tuple[int, int]
    stop: float
    main: bool


def lanes_between(
    line: ReferenceLine,
    section: CrossSection,
    stations: Float,
    direction: int,
    nodes: tuple[int, int],
    stop: float,
    main: bool,
) -> Carriageway | None:
    """Return the carriageway of one direction, +1 along the stations; None where no lane goes that way.

    Args:
        line, section: of the street.
        stations: ``(n,)`` ascending, between the two junctions.
        direction: +1 along the stations.
        nodes: at the start and the end of the stretch, along the stations.
        stop: metres before the end in driving direction.
        main: whether the street is more than an alley.
    """
    edges = section.edges(stations)
    lines, begins, ends = [], [], []
    for row, strip in enumerate(section.strips):
        if strip.use not in DRIVEN or strip.direction != direction:
            continue
        width = edges[row] - edges[row + 1]
        if width.max() < WIDE_ENOUGH:
            continue
        # Cars keep to the part of a wide lane where nobody parks.
        parked = np.minimum(strip.parked, np.maximum(width - 2.2, 0.0))
        at_kerb_above = row == 0 and len(section.strips) > 1
        centre = (edges[row] + edges[row + 1]) / 2 + (parked / 2 if not at_kerb_above else -parked / 2)
        lines.append(line.locate(stations, centre))
        begins.append(width[0] > WIDE_ENOUGH)
        ends.append(width[-1] > WIDE_ENOUGH)
    if not lines or not any(begins) or not any(ends):
        return None
    shaped, start, end = np.array(lines), np.array(begins), np.array(ends)
    if direction == -1:
        return Carriageway(shaped[::-1, ::-1], end[::-1], start[::-1], (nodes[1], nodes[0]), stop, main)
    return Carriageway(shaped, start, end, nodes, stop, main)
