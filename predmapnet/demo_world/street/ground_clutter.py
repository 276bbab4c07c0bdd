"""Clutter of the ground that is no paint of symbols: seams, patches, rails, tracks, dirt, shadows."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import shapely
from numpy.random import Generator

from mapfusion.arrays import Float
from mapfusion.geometry import arc_length
from predmapnet.demo_world.render.paint import cut, offset_line, ribbon
from predmapnet.demo_world.world import Clutter

HALF_LANE = 1.65


@dataclass(frozen=True)
class Lane:
    """The centre line ``(n, 2)`` of a lane, at least 2 m long, metres, in the direction of travel."""

    path: Float

    @property
    def length(self) -> float:
        """Metres."""
        return float(arc_length(self.path)[-1])

    def place(self, shape: Float, station: float) -> Float:
        """Put a shape of the lane's frame (x along, y left) at a station, by the direction that the lane has there."""
        start = min(station, self.length - 2.0)
        ends = cut(self.path, start, start + 2.0)
        step = (ends[-1] - ends[0]) / max(float(np.linalg.norm(ends[-1] - ends[0])), 1e-6)
        placed: Float = shape @ np.array([step, [-step[1], step[0]]]) + ends[0] + (station - start) * step
        return placed

    def part(self, random: Generator, least: float, most: float) -> Float:
        """Any part of the lane between two lengths, ``(k, 2)``, a point every 3 m at least."""
        length = min(float(random.uniform(least, most)), self.length)
        start = float(random.uniform(0.0, self.length - length + 1e-6))
        line = shapely.LineString(cut(self.path, start, start + length))
        points: Float = shapely.get_coordinates(shapely.segmentize(line, 3.0))
        return points


Kind = Callable[[Generator, Clutter, list[Lane], shapely.Geometry, float], Clutter]


def _chosen(random: Generator, lanes: list[Lane], rate: float) -> list[Lane]:
    """Lanes, each as often as ``rate`` per 100 m has it."""
    return [lane for lane in lanes for _ in range(random.poisson(rate * lane.length / 100))]


def _laid(ground: Clutter, patches: list[tuple[str, Float]]) -> Clutter:
    return replace(ground, patches=(*ground.patches, *patches))


def _seams(random: Generator, ground: Clutter, lanes: list[Lane], road: shapely.Geometry, rate: float) -> Clutter:
    """Seams along and across lanes, sealed with tar or open and light."""
    found = []
    material = str(random.choice(["tar", "tar", "asphalt_new", "slab"]))
    for lane in _chosen(random, lanes, rate):
        width, aside = float(random.uniform(0.03, 0.16)), float(random.choice([0.0, HALF_LANE, -HALF_LANE, 0.8]))
        path = lane.part(random, 8.0, 90.0)
        wander = np.cumsum(random.normal(0.0, float(random.choice([0.005, 0.06])), len(path)))[:, None]
        found.append((material, ribbon(path + wander, width, aside + float(random.normal(0.0, 0.2)))))
        if random.random() < 0.5:
            across = np.array([[0.0, -HALF_LANE], [float(random.normal(0.0, 0.3)), HALF_LANE]])
            found.append((material, lane.place(ribbon(across, width), float(random.uniform(0.0, lane.length - 2.0)))))
    return _laid(ground, found)


def _cracks(random: Generator, ground: Clutter, lanes: list[Lane], road: shapely.Geometry, rate: float) -> Clutter:
    """Cracks that wander, and their sealing, in bundles."""
    found = []
    for lane in _chosen(random, lanes, rate):
        at, heading = float(random.uniform(0.0, lane.length)), float(random.choice([0.0, 0.0, np.pi / 2]))
        for _ in range(int(random.integers(1, 6))):
            turns = heading + np.cumsum(random.normal(0.0, 0.35, int(random.integers(6, 40))))
            walk = 0.4 * np.cumsum(np.stack([np.cos(turns), np.sin(turns)], axis=1), axis=0)
            shape = ribbon(walk + random.uniform(-1.6, 1.6, 2), float(random.uniform(0.02, 0.09)))
            found.append(("tar", lane.place(shape, at)))
    return _laid(ground, found)


def _slabs(random: Generator, ground: Clutter, lanes: list[Lane], road: shapely.Geometry, rate: float) -> Clutter:
    """Lanes of concrete, in slabs with joints."""
    found: list[tuple[str, Float]] = []
    joint, pitch = str(random.choice(["tar", "asphalt"])), float(random.uniform(3.5, 6.5))
    everywhere = random.random() < 0.5
    for lane in lanes:
        if everywhere or random.random() < rate:
            found.append(("slab", ribbon(lane.path, 2 * HALF_LANE + 0.2)))
            across = ribbon(np.array([[0.0, -HALF_LANE], [0.0, HALF_LANE]]), 0.07)
            joints = [lane.place(across, station) for station in np.arange(1.0, lane.length - 1.0, pitch)]
            joints += [ribbon(lane.path, 0.06, side * HALF_LANE) for side in (-1, 1)]
            found.append((joint, np.concatenate(joints)))
    return _laid(ground, found)


def _patches(random: Generator, ground: Clutter, lanes: list[Lane], road: shapely.Geometry, rate: float) -> Clutter:
    """Other asphalt: on part of a lane, over all of it, in trenches along and across; some with a rim of tar."""
    found: list[tuple[str, Float]] = []
    for lane in _chosen(random, lanes, rate):
        tone = str(random.choice(["asphalt", "asphalt_old", "asphalt_new", "asphalt_new", "slab"]))
        kind, rim = random.random(), random.random() < 0.4
        if kind < 0.3:
            shape = ribbon(np.array([[0.0, -4.5], [float(random.normal(0.0, 0.8)), 4.5]]), random.uniform(0.4, 1.3))
            shape = shape if kind < 0.2 else shape * [1.0, 0.4]
            pieces, rims = lane.place(shape, random.uniform(0.0, lane.length)), np.zeros((0, 4, 2))
        else:
            width = float(random.uniform(0.5, 1.2) if kind < 0.55 else random.uniform(1.6, 4.0))
            aside = float(random.uniform(-1.0, 1.0) if width < 2.0 else random.normal(0.0, 0.3))
            path = lane.part(random, 2.0, 45.0)
            pieces = ribbon(path, width, aside)
            rims = np.concatenate([ribbon(path, 0.07, aside + side * width / 2) for side in (-1, 1)])
        found += [(tone, pieces)] + ([("tar", rims)] if rim else [])
    return _laid(ground, found)


def _rails(random: Generator, ground: Clutter, lanes: list[Lane], road: shapely.Geometry, rate: float) -> Clutter:
    """Rails of trams in the longest lanes, in asphalt or in a bed of their own."""
    found: list[tuple[str, Float]] = []
    bed = str(random.choice(["", "", "slab", "brick", "asphalt_new"]))
    for lane in lanes[: 2 + int(12 * rate)]:
        if bed:
            found.append((bed, ribbon(lane.path, 2.4)))
        beside = np.concatenate([ribbon(lane.path, 0.22, side * 0.72) for side in (-1, 1)])
        found.append(("asphalt_new" if bed != "asphalt_new" else "slab", beside))
        found.append(("rail", np.concatenate([ribbon(lane.path, 0.08, side * 0.72) for side in (-1, 1)])))
    return _laid(ground, found)


def _tracks(random: Generator, ground: Clutter, lanes: list[Lane], road: shapely.Geometry, rate: float) -> Clutter:
    """Tracks of tyres, wet or worn, and oil between them: soft and darker."""
    stains = []
    wet, gauge, width = int(random.integers(150, 238)), float(random.uniform(0.7, 0.9)), float(random.uniform(0.3, 0.6))
    for lane in lanes:
        if random.random() < rate:
            for aside in (-gauge, gauge, *([0.0] if random.random() < 0.4 else [])):
                stains += [(quad, wet) for quad in ribbon(lane.path, width, aside)]
    return replace(ground, stains=(*ground.stains, *stains))


def _covers(random: Generator, ground: Clutter, lanes: list[Lane], road: shapely.Geometry, rate: float) -> Clutter:
    """Manhole covers, valves and gratings, some in a square of other asphalt."""
    found: list[tuple[str, Float]] = []
    turns = np.linspace(0.0, 2 * np.pi, 8, endpoint=False)
    ring = np.stack([np.cos(turns), np.sin(turns)], axis=1)
    disc = np.stack([ring[[0, 1, 2, 3]], ring[[3, 4, 7, 0]], ring[[4, 5, 6, 7]]])
    square = np.array([[[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]]])
    for lane in _chosen(random, lanes, rate):
        centre, radius = np.array([0.0, float(random.uniform(-2.0, 2.0))]), float(random.choice([0.12, 0.33, 0.4]))
        at = float(random.uniform(0.0, lane.length))
        if random.random() < 0.35:
            tone = str(random.choice(["asphalt_new", "asphalt_old", "slab"]))
            found.append((tone, lane.place(square * (radius + 0.35) + centre, at)))
        shape = disc if random.random() < 0.75 else square * [0.6, 1.0]
        found.append(("iron", lane.place(shape * radius + centre, at)))
    return _laid(ground, found)


def _dirt(random: Generator, ground: Clutter, lanes: list[Lane], road: shapely.Geometry, rate: float) -> Clutter:
    """Leaves, sand and dirt along kerbs, ragged, over the edge of the road and beside it."""
    found: list[tuple[str, Float]] = []
    material = str(random.choice(["leaves", "soil", "gravel", "asphalt_old", "grass"]))
    within = shapely.union_all([shapely.LineString(lane.path).buffer(14.0) for lane in lanes])
    for line in shapely.get_parts(shapely.boundary(road).intersection(within)):
        if line.geom_type != "LineString" or line.length < 4.0:
            continue
        rim = Lane(shapely.get_coordinates(shapely.segmentize(line, 1.2)))
        for _ in range(random.poisson(rate * rim.length / 100)):
            path = rim.part(random, 4.0, 30.0)
            reach = random.uniform(0.05, float(random.uniform(0.3, 1.1)), (2, len(path)))
            left, right = path + (offset_line(path, 1.0) - path) * reach[0, :, None], path
            right = path + (offset_line(path, -1.0) - path) * reach[1, :, None]
            found.append((material, np.stack([right[:-1], right[1:], left[1:], left[:-1]], axis=1)))
    return _laid(ground, found)


def _shadows(random: Generator, ground: Clutter, lanes: list[Lane], road: shapely.Geometry, rate: float) -> Clutter:
    """Shadows with straight edges: of wires, thin and long, and of walls, wide, along the road or across it."""
    shadows = []
    lean = float(random.normal(0.0, 0.25))
    for lane in _chosen(random, lanes, rate):
        wire = random.random() < 0.6
        length, width = float(random.uniform(8.0, 45.0)), float(random.uniform(0.06, 0.2))
        if not wire:
            length, width = float(random.uniform(5.0, 25.0)), float(random.uniform(1.0, 5.0))
        turn = lean + float(random.choice([0.0, 0.0, np.pi / 2]))
        half, middle = length / 2 * np.array([np.cos(turn), np.sin(turn)]), np.array([0.0, random.uniform(-6.0, 6.0)])
        quad = lane.place(ribbon(np.array([middle - half, middle + half]), width), random.uniform(0.0, lane.length))[0]
        shadows.append((quad, 110 if wire else 0))
    return replace(ground, shadows=(*ground.shadows, *shadows))


def _kerb_lines(random: Generator, ground: Clutter, lanes: list[Lane], road: shapely.Geometry, rate: float) -> Clutter:
    """Lines along the kerb that forbid parking, one or two, here and there; no line of a lane."""
    yellow, double = float(random.random() < 0.6), random.random() < 0.5
    corners, coats = [ground.paint], [ground.coats]
    within = shapely.union_all([shapely.LineString(lane.path).buffer(9.0) for lane in lanes])
    for line in shapely.get_parts(shapely.boundary(road.buffer(-0.3)).intersection(within)):
        if line.geom_type == "LineString" and line.length > 6.0 and random.random() < rate:
            path, coat = shapely.get_coordinates(line), [float(random.uniform(0.0, 0.6)), 0.6, yellow]
            quads = np.concatenate([ribbon(path, 0.1, aside) for aside in ((0.0, 0.22) if double else (0.0,))])
            corners.append(quads)
            coats.append(np.tile(coat, (len(quads), 1)))
    return replace(ground, paint=np.concatenate(corners), coats=np.concatenate(coats))


GROUND_KINDS: dict[str, tuple[Kind, float, float]] = {
    "slabs": (_slabs, 0.12, 0.5),
    "patches": (_patches, 0.6, 3.5),
    "rails": (_rails, 0.12, 0.5),
    "seams": (_seams, 0.6, 4.0),
    "cracks": (_cracks, 0.5, 3.0),
    "covers": (_covers, 0.6, 4.0),
    "dirt": (_dirt, 0.4, 2.5),
    "tracks": (_tracks, 0.4, 1.0),
    "shadows": (_shadows, 0.5, 2.5),
    "kerb lines": (_kerb_lines, 0.25, 0.8),
}
"""Kinds from bottom to top: what lays each, the share of cluttered towns that have it, and most per 100 m of lane."""
