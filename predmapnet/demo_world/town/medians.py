"""Medians between the directions: raised ones as islands, and painted gaps as hatched areas."""

from __future__ import annotations

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray
from shapely import Polygon

from predmapnet.demo_world.town.cross_sections import CrossSection, Use
from predmapnet.demo_world.town.habits import Habits
from predmapnet.demo_world.town.reference_line import ReferenceLine
from predmapnet.demo_world.world import Hatching


def _wide_runs(wide: NDArray[np.bool_]) -> list[slice]:
    """Slices of the runs of True that are longer than two."""
    padded = np.concatenate([[False], wide, [False]])
    begins, ends = np.flatnonzero(padded[1:] & ~padded[:-1]), np.flatnonzero(~padded[1:] & padded[:-1])
    return [slice(int(a), int(b)) for a, b in zip(begins, ends, strict=True) if b - a > 2]


def median_islands(
    random: Generator, line: ReferenceLine, section: CrossSection, start: float, end: float
) -> list[Polygon]:
    """Raised medians between two stations, with rounded noses; some stop short of the junction."""
    rows = [row for row, strip in enumerate(section.strips) if strip.use is Use.RAISED]
    if not rows or end - start < 8.0:
        return []
    shorter = [float(random.choice([0.0, random.uniform(0.0, 12.0)])) for _ in range(2)]
    low, high = start + shorter[0], end - shorter[1]
    if high - low < 6.0:
        return []
    stations = np.linspace(low, high, max(4, round(high - low) + 1))
    edges = section.edges(stations)
    found = []
    for row in rows:
        width = edges[row] - edges[row + 1]
        for run in _wide_runs(width > 0.5):
            inset = min(0.12, 0.1 * float(width[run].min()))
            outline = line.band(stations[run], edges[row + 1, run] + inset, edges[row, run] - inset)
            rounding = 0.4 * float(width[run].min())
            island = outline.buffer(-rounding).buffer(rounding, quad_segs=6)
            if island.geom_type == "Polygon" and island.area > 2.0:
                found.append(island)
    return found


def painted_gaps(
    random: Generator, line: ReferenceLine, section: CrossSection, start: float, end: float, habits: Habits
) -> list[Hatching]:
    """Hatching of the painted gaps between two stations; narrow ones, and some streets', stay empty."""
    if random.random() < 0.3:
        return []
    stations = np.linspace(start, end, max(4, round(end - start) + 1))
    edges = section.edges(stations)
    lean = np.radians(float(random.choice([35.0, 45.0, 135.0])))
    found = []
    for row, strip in enumerate(section.strips):
        if strip.use is not Use.GAP:
            continue
        width = edges[row] - edges[row + 1]
        for run in _wide_runs(width > 0.9):
            area = line.band(stations[run], edges[row + 1, run] + 0.25, edges[row, run] - 0.25)
            if area.is_valid and area.area > 3.0:
                heading = line.heading(float(stations[run].mean())) + lean
                found.append(Hatching(area, heading, habits.centre_colour))
    return found
