"""Works: the parts of a town, built stretch by stretch before they are assembled into a map."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import shapely
from shapely import Polygon

from mapfusion.arrays import Float
from predmapnet.demo_world.town.junctions import ArmReach
from predmapnet.demo_world.town.lane_graph import Carriageway
from predmapnet.demo_world.world import Crossing, Divider, Hatching


@dataclass
class Works:
    """All that has been built so far; ``lanes`` are polygons with their centre lines."""

    paved: list[shapely.Geometry] = field(default_factory=list)
    islands: list[Polygon] = field(default_factory=list)
    crossings: list[Crossing] = field(default_factory=list)
    dividers: list[Divider] = field(default_factory=list)
    markings: list[Divider] = field(default_factory=list)
    hatchings: list[Hatching] = field(default_factory=list)
    parking: list[Polygon] = field(default_factory=list)
    stop_lines: list[Polygon] = field(default_factory=list)
    lanes: list[tuple[Polygon, Float]] = field(default_factory=list)
    grass: list[Polygon] = field(default_factory=list)
    carriageways: list[Carriageway] = field(default_factory=list)


@dataclass(frozen=True)
class Stretch:
    """A street between two nodes: its index, the stations of both ends, and how far the junctions reach."""

    street: int
    start: float
    end: float
    nodes: tuple[int, int]
    reaches: tuple[ArmReach | None, ArmReach | None]

    def inner(self, of: str) -> tuple[float, float]:
        """Stations between the junctions, by ``clear``, ``stop`` or ``paint``."""
        first, last = (0.0 if reach is None else float(getattr(reach, of)) for reach in self.reaches)
        return self.start + first, self.end - last


def spaced(start: float, end: float, spacing: float = 2.0) -> Float:
    """Stations from ``start`` to ``end``, both included, at most ``spacing`` metres apart; at least two."""
    return np.linspace(start, end, max(2, int(np.ceil((end - start) / spacing)) + 1))
