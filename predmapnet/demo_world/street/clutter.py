"""Clutter: what is on the ground and only looks like an element of the map, drawn town by town."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import shapely
from numpy.random import Generator

from mapfusion.arrays import Float
from mapfusion.geometry import arc_length
from predmapnet.demo_world.render.paint import Quads, cut
from predmapnet.demo_world.street import symbols
from predmapnet.demo_world.street.ground_clutter import GROUND_KINDS, Lane
from predmapnet.demo_world.world import Clutter, Trajectory, VectorMap

BARE_SHARE = 0.2
"""Towns without any clutter."""

NEAR = 48.0
"""Metres from the drive within which the ground is cluttered."""

SHORTEST = 6.0
"""Shorter lanes have no clutter of their own, metres."""

SYMBOLS: dict[str, tuple[Callable[[Generator], Float], float, float, bool]] = {
    "arrows": (symbols.arrow, 0.6, 2.5, False),
    "cycles": (symbols.cycle, 0.3, 1.5, False),
    "writing": (symbols.writing, 0.4, 1.2, False),
    "teeth": (symbols.teeth, 0.3, 0.5, True),
    "bars": (symbols.bars, 0.3, 0.5, True),
    "humps": (symbols.hump, 0.25, 0.7, False),
    "hatchings": (symbols.hatched, 0.4, 1.0, False),
    "boxes": (symbols.keep_clear, 0.3, 0.6, False),
    "zigzags": (symbols.zigzag, 0.2, 0.7, False),
}
"""Paint: what draws it, the share of cluttered towns that have it, most per 100 m of lane, whether only at ends."""


class Rates(NamedTuple):
    """Rates of a town: how many of each kind there are per 100 m of lane; what it lacks is absent."""

    by_kind: dict[str, float]

    @classmethod
    def draw(cls, random: Generator) -> Rates:
        """Draw which kinds a town has, and how many; a share of towns has none."""
        if random.random() < BARE_SHARE:
            return cls({})
        most = {name: (share, rate) for name, (_, share, rate, _) in SYMBOLS.items()}
        most |= {name: (share, rate) for name, (_, share, rate) in GROUND_KINDS.items()}
        return cls(
            {
                name: rate * float(random.uniform(0.15, 1.0)) ** 1.5
                for name, (share, rate) in most.items()
                if random.random() < share
            }
        )


def draw_clutter(vector_map: VectorMap, road: shapely.Geometry, trajectory: Trajectory, seed: int) -> Clutter:
    """Clutter the ground near a drive; the map stays as it is.

    Paint lies on the prepared ``road`` and keeps clear of crossings, whose own paint it would spoil.
    """
    random = np.random.default_rng([seed, 61])
    rates = Rates.draw(random).by_kind
    near = shapely.LineString(trajectory.ego_to_global[:, :2, 3]).buffer(NEAR)
    shapely.prepare(near)
    lanes = [lane for path in vector_map.lane_paths for lane in _near(path, near)]
    lanes.sort(key=lambda lane: -lane.length)
    crossings = shapely.union_all([crossing.polygon.buffer(0.6) for crossing in vector_map.crossings])
    shapely.prepare(crossings)
    paint = Quads()
    for name, (symbol, _, _, at_ends) in SYMBOLS.items():
        for lane in lanes:
            for station in _stations(random, lane, rates.get(name, 0.0), at_ends):
                quads = lane.place(symbol(random), station)
                hull = shapely.MultiPoint(quads.reshape(-1, 2)).convex_hull
                if road.contains(hull) and not crossings.intersects(hull):
                    yellow = float(random.random() < 0.12)
                    paint.add(quads, float(random.uniform(0.0, 0.7)), float(random.uniform(0.4, 0.78)), yellow)
    ground = Clutter()
    for name, (kind, _, _) in GROUND_KINDS.items():
        if name in rates:
            ground = kind(random, ground, lanes, road, rates[name])
    corners, coats = paint.arrays()
    return replace(ground, paint=np.concatenate([ground.paint, corners]), coats=np.concatenate([ground.coats, coats]))


def _near(path: Float, near: shapely.Geometry) -> list[Lane]:
    """The parts of a lane's centre line near the drive, in the direction of travel."""
    inside = np.flatnonzero(shapely.contains_xy(near, path))
    distance = arc_length(path)
    if len(inside) < 2 or distance[inside[-1]] - distance[inside[0]] < SHORTEST:
        return []
    return [Lane(cut(path, distance[inside[0]], distance[inside[-1]]))]


def _stations(random: Generator, lane: Lane, rate: float, at_ends: bool) -> list[float]:
    """Draw the stations at which symbols begin, metres along a lane: anywhere, or only before its end."""
    if at_ends:
        return [lane.length - float(random.uniform(1.0, 9.0))] if random.random() < rate else []
    count = random.poisson(rate * lane.length / 100)
    return [float(station) for station in random.uniform(0.0, max(lane.length - 5.0, 1.0), count)]
