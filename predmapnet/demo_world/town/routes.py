"""A drive through a town: lane by lane along the streets, turning at junctions, at speeds that a person would drive."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import shapely
from numpy.random import Generator
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d

from mapfusion.arrays import Float
from mapfusion.geometry import arc_length
from predmapnet.demo_world.town.driving import (
    FRONT_OVERHANG,
    PATH_STEP,
    drive_along_path,
    evenly,
    sharpest_bend,
    turn_between,
)
from predmapnet.demo_world.town.lane_graph import Carriageway
from predmapnet.demo_world.town.mirror import mirrored
from predmapnet.demo_world.town.town import Town
from predmapnet.demo_world.world import Trajectory

SHORTEST_DRIVE = 60.0
"""Metres that the car covers in every scene."""

LONG_ENOUGH = 260.0
"""Metres of path that are enough for a drive."""

MARGIN = 50.0
"""No key frame lies closer than this to where a street leaves the town, metres."""

SEEN = 36.0
"""Farther than the region of interest reaches, metres."""

SHARPEST_BEND = 0.2
"""Curvature that a drive may have, per metre."""

HALF_CAR = 0.85
"""Half of the width between the wheels, metres."""


class NoDriveError(Exception):
    """A town without a drive: its plan is too cramped for a car to get anywhere."""


def drive(town: Town, seed: int) -> Trajectory:
    """Drive through a town for 20 s: 40 key frames, 0.5 s apart, with a small pitch and roll.

    Raises NoDriveError where no street is long enough, traffic stops the car too early, or a loose end is in sight.
    """
    random = np.random.default_rng([0x726F757465, seed])
    path, stops = _draw_path(random, town)
    if town.vector_map.left_hand:
        path = mirrored(path)
    driven = drive_along_path(random, path, stops, float(random.uniform(7.0, 12.0)), seed)
    if arc_length(driven.ego_to_global[:, :2, 3])[-1] <= SHORTEST_DRIVE:
        raise NoDriveError("the drive is too short")
    ends = np.array([way.lines[0][end] for way in town.carriageways for end in (0, -1) if way.nodes[end] < 0])
    ends = mirrored(ends) if town.vector_map.left_hand else ends
    if len(ends) and shapely.MultiPoint(ends).distance(shapely.MultiPoint(driven.ego_to_global[:, :2, 3])) < SEEN:
        raise NoDriveError("the drive sees the end of a street that ends nowhere")
    return driven


def _draw_path(random: Generator, town: Town) -> tuple[Float, Float]:
    """Draw a walk through the town that is long enough and stays on the road.

    Returns the path ``(n, 2)`` of the rear axle at even steps, and the distances along it at which a car may have to
    stop; raises NoDriveError if the town has no such walk.
    """
    road = town.surface.buffer(0.05)
    shapely.prepare(road)
    best: tuple[Float, Float] | None = None
    for _ in range(250):
        ways = _draw_ways(random, town.carriageways)
        if len(ways) < 3:
            continue
        path, stops = _trace(random, ways)
        if len(path) < 40 or sharpest_bend(path) > SHARPEST_BEND or not _on_road(path, road):
            continue
        if len(path) * PATH_STEP > LONG_ENOUGH:
            return path, stops
        if best is None or len(path) > len(best[0]):
            best = path, stops
    if best is None:
        raise NoDriveError("the town has no street that is long enough for a drive")
    return best


def _on_road(path: Float, road: shapely.Geometry) -> bool:
    """Whether both rear wheels stay on the road all the way."""
    tangents = np.gradient(path, axis=0)
    normals = np.stack([-tangents[:, 1], tangents[:, 0]], axis=1) / np.linalg.norm(tangents, axis=1, keepdims=True)
    wheels = np.concatenate([path + HALF_CAR * normals, path - HALF_CAR * normals])[::3]
    return bool(shapely.contains_xy(road, wheels).all())


def _draw_ways(random: Generator, ways: tuple[Carriageway, ...]) -> list[Carriageway]:
    """Start anywhere, turn at random at each junction, never turn back, never leave the town."""
    current = ways[int(random.integers(len(ways)))]
    chosen = [current]
    visited = {id(current)}
    length = _length(current)
    while length < LONG_ENOUGH + 100.0 and current.nodes[1] >= 0:
        options = [
            way
            for way in ways
            if way.nodes[0] == current.nodes[1] and id(way) not in visited and abs(_turn_angle(current, way)) < 2.5
        ]
        options = [way for way in options if way.nodes[1] >= 0 and way.main] or options
        if not options:
            break
        # Turning is drawn more often than going on, because junctions are where maps are difficult.
        weights = np.array([0.8 if abs(_turn_angle(current, way)) < 0.5 else 1.0 for way in options])
        current = options[int(random.choice(len(options), p=weights / weights.sum()))]
        chosen.append(current)
        visited.add(id(current))
        length += _length(current)
    return chosen


def _length(way: Carriageway) -> float:
    return float(arc_length(way.lines[0])[-1])


def _turn_angle(before: Carriageway, after: Carriageway) -> float:
    """Change of heading from one carriageway to the next, radians, positive to the left."""
    first, last = before.lines[0][-1] - before.lines[0][-2], after.lines[0][1] - after.lines[0][0]
    return float(np.angle(complex(*last) / complex(*first)))


def _lane(random: Generator, is_open: NDArray[np.bool_], angle: float | None) -> int:
    """An open lane that suits a turn; any for going straight on."""
    lanes = np.flatnonzero(is_open)
    if angle is None or abs(angle) < 0.6:
        return int(lanes[random.integers(len(lanes))])
    return int(lanes[0] if angle > 0 else lanes[-1])


def _trace(random: Generator, ways: list[Carriageway]) -> tuple[Float, Float]:
    """Join the lanes of the carriageways into one smooth path."""
    angles = [_turn_angle(before, after) for before, after in pairwise(ways)]
    pieces: list[Float] = []
    stop_points: list[Float] = []
    straight_lane: int | None = None
    for index, way in enumerate(ways):
        arriving = angles[index - 1] if index else None
        leaving = angles[index] if index < len(angles) else None
        lane_in = _lane(random, way.open_at_start, arriving)
        if straight_lane is not None and straight_lane < len(way.open_at_start) and way.open_at_start[straight_lane]:
            lane_in = straight_lane
        lane_out = _lane(random, way.open_at_end, leaving)
        if (leaving is None or abs(leaving) < 0.6) and way.open_at_end[lane_in]:
            lane_out = lane_in
        straight_lane = lane_out if leaving is not None and abs(leaving) < 0.6 else None
        line = _lane_line(way, lane_in, lane_out)
        front = MARGIN if way.nodes[0] < 0 else (float(random.uniform(0.0, 25.0)) if index == 0 else 0.0)
        line = _trimmed(line, front, MARGIN if way.nodes[1] < 0 else (3.0 if index == len(ways) - 1 else 0.0))
        if len(line) < 2:
            continue
        if pieces:
            pieces.append(_through_junction(pieces[-1], line, arriving or 0.0))
        pieces.append(line)
        if np.isfinite(way.stop):
            travelled = arc_length(line)
            at = max(travelled[-1] - way.stop - FRONT_OVERHANG, 0.0)
            stop_points.append(np.array([np.interp(at, travelled, line[:, axis]) for axis in range(2)]))
    if not pieces:
        return np.zeros((0, 2)), np.zeros(0)
    path = np.concatenate(pieces)
    keep = np.concatenate([[True], np.linalg.norm(np.diff(path, axis=0), axis=1) > 1e-6])
    path = evenly(path[keep])
    path = evenly(gaussian_filter1d(path, 1.2 / PATH_STEP, axis=0, mode="nearest"))
    stops = [int(np.argmin(np.linalg.norm(path - point, axis=1))) * PATH_STEP for point in stop_points]
    return path, np.array(stops)


def _lane_line(way: Carriageway, lane_in: int, lane_out: int) -> Float:
    """The centre of a lane, with a gentle change to another one where that is needed."""
    share = np.clip((np.linspace(0.0, 1.0, way.lines.shape[1]) - 0.1) / 0.75, 0.0, 1.0)
    blend = (share**3 * (10.0 - 15.0 * share + 6.0 * share**2))[:, None]
    line: Float = (1.0 - blend) * way.lines[lane_in] + blend * way.lines[lane_out]
    return line


def _trimmed(line: Float, front: float, back: float) -> Float:
    travelled = arc_length(line)
    kept: Float = line[(travelled >= front) & (travelled <= travelled[-1] - back)]
    return kept


def _through_junction(before: Float, after: Float, angle: float) -> Float:
    """Join the end of one lane to the start of the next."""
    radius = 6.2 if angle < 0 else np.inf
    return turn_between(before[-1], before[-1] - before[-2], after[0], after[1] - after[0], radius)
