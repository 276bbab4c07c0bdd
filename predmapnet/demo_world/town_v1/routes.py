"""A drive through a town: lane by lane along the roads, turning at junctions, at speeds that a person would drive."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d

from mapfusion.geometry import arc_length
from predmapnet.demo_world.town.driving import (
    FRONT_OVERHANG,
    PATH_STEP,
    arc_between,
    drive_along_path,
    evenly,
    sharpest_bend,
    turn_between,
)
from predmapnet.demo_world.town_v1.junctions import Arm, has_splitter
from predmapnet.demo_world.town_v1.town import Town
from predmapnet.demo_world.world import Trajectory

Float = NDArray[np.float64]

MARGIN = 48.0
"""No key frame lies closer than this to the open end of a road, metres."""

SHARPEST_BEND = 0.17
"""Curvature that a drive may have, per metre."""

KERB_TO_AXLE = 1.9
"""Between the kerb and the middle of the rear axle in a right turn, metres."""

SPLITTER_SWERVE = 0.6
"""How far cars keep to the right of their lane at a splitter island, metres."""


@dataclass(frozen=True)
class Leg:
    """One stretch of road, driven in one direction: +1 along its stations, -1 against them."""

    edge: int
    direction: int


def drive(town: Town, seed: int) -> Trajectory:
    """Drive through a town for 20 s and note the pose twice a second.

    Args:
        town: where.
        seed: the same seed gives the same drive.

    Returns:
        40 key frames, 0.5 s apart, with a small pitch and roll.
    """
    random = np.random.default_rng([0x726F757465, seed])
    path, stops = _draw_path(random, town)
    return drive_along_path(random, path, stops, float(random.uniform(8.0, 12.0)), seed)


def _draw_path(random: Generator, town: Town) -> tuple[Float, Float]:
    """Draw a walk through the town that is long enough, and the path of the rear axle along it.

    Returns:
        The path ``(n, 2)`` at even steps, and the distances along it at which a car may have to stop.
    """
    best: tuple[Float, Float] | None = None
    for _ in range(60):
        legs = _draw_legs(random, town)
        if len(legs) < 3:
            continue
        path, stops = _trace(random, town, legs)
        if best is None or len(path) > len(best[0]):
            best = path, stops
        if len(path) * PATH_STEP > 20.0 * 12.0 + 20.0 and sharpest_bend(path) < SHARPEST_BEND:
            return path, stops
    if best is None:
        raise RuntimeError("the town has no road that is long enough for a drive")
    return best


def _draw_legs(random: Generator, town: Town) -> list[Leg]:
    """Start anywhere, turn at random at each junction, never turn back, never leave the town."""
    edges = town.plan.edges
    start = int(random.integers(len(edges)))
    direction = int(random.choice([-1, 1]))
    if edges[start].nodes[1 if direction == 1 else 0] < 0:
        direction = -direction
    legs = [Leg(start, direction)]
    length = edges[start].end - edges[start].start
    visited = {start}
    while length < 460.0:
        node = edges[legs[-1].edge].nodes[1 if legs[-1].direction == 1 else 0]
        if node < 0:
            break
        options = [Leg(edge, side) for edge, side in town.plan.arms(node) if edge not in visited]
        options = [leg for leg in options if not edges[leg.edge].leaves_town] or options
        if not options:
            break
        # Turning is drawn more often than going on, because junctions are where maps are difficult.
        same_road = np.array([edges[leg.edge].road == edges[legs[-1].edge].road for leg in options])
        weights = np.where(same_road, 1.0, 1.2)
        legs.append(options[int(random.choice(len(options), p=weights / weights.sum()))])
        visited.add(legs[-1].edge)
        length += edges[legs[-1].edge].end - edges[legs[-1].edge].start
    return legs


def _turn_angle(town: Town, leg: Leg, following: Leg) -> float:
    """Change of heading from one leg to the next, radians, positive to the left."""
    headings = []
    for current, at_end in ((leg, True), (following, False)):
        edge = town.plan.edges[current.edge]
        station = edge.end if (current.direction == 1) == at_end else edge.start
        tangent = town.plan.roads[edge.road].direction(np.array([station]))[0] * current.direction
        headings.append(np.arctan2(tangent[1], tangent[0]))
    return float(np.angle(np.exp(1j * (headings[1] - headings[0]))))


def _lane_for(town: Town, leg: Leg, node: int, turn: float | None, usual: int) -> int:
    """The lane to be in at a node: the outermost for a right turn or a roundabout, the innermost for a left turn."""
    lanes = town.plan.roads[town.plan.edges[leg.edge].road].section.lanes
    if node >= 0 and town.plan.nodes[node].is_roundabout:
        return lanes - 1
    if turn is None or abs(turn) < np.radians(35.0):
        return min(usual, lanes - 1)
    return 0 if turn > 0 else lanes - 1


def _trace(random: Generator, town: Town, legs: list[Leg]) -> tuple[Float, Float]:
    """Join the lanes of the legs into one smooth path."""
    turns = [_turn_angle(town, leg, following) for leg, following in pairwise(legs)]
    usual = int(random.integers(3))
    pieces: list[Float] = []
    stop_points: list[Float] = []
    for index, leg in enumerate(legs):
        first, last = _ends(town, leg)
        lane_in = _lane_for(town, leg, first.node, turns[index - 1] if index else None, usual)
        lane_out = _lane_for(town, leg, last.node, turns[index] if index < len(turns) else None, usual)
        lane_line = _lane_line(town, leg, first, last, lane_in, lane_out)
        if index == 0:
            lane_line = _trimmed(lane_line, MARGIN if first.node < 0 else float(random.uniform(0.0, 25.0)), 0.0)
        if index == len(legs) - 1 and last.node < 0:
            lane_line = _trimmed(lane_line, 0.0, MARGIN)
        if len(lane_line) < 2:
            continue
        if pieces:
            pieces.append(_through_junction(town, first.node, pieces[-1], lane_line))
        pieces.append(lane_line)
        if last.node >= 0 and not town.plan.nodes[last.node].is_roundabout:
            stop_points.append(_stop_point(lane_line, last))
    path = np.concatenate(pieces)
    keep = np.concatenate([[True], np.linalg.norm(np.diff(path, axis=0), axis=1) > 1e-6])
    path = evenly(path[keep])
    path = evenly(gaussian_filter1d(path, 1.2 / PATH_STEP, axis=0, mode="nearest"))
    stops = [int(np.argmin(np.linalg.norm(path - point, axis=1))) * PATH_STEP for point in stop_points]
    return path, np.array(stops)


def _ends(town: Town, leg: Leg) -> tuple[Arm, Arm]:
    first, last = town.arms[leg.edge]
    return (first, last) if leg.direction == 1 else (last, first)


def _lane_line(town: Town, leg: Leg, first: Arm, last: Arm, lane_in: int, lane_out: int) -> Float:
    """The centre of the lane between two junctions, with a gentle change of lane where one is needed."""
    edge = town.plan.edges[leg.edge]
    road = town.plan.roads[edge.road]
    begin, finish = (edge.start, edge.end) if leg.direction == 1 else (edge.end, edge.start)
    begin, finish = begin + leg.direction * first.clear, finish - leg.direction * last.clear
    stations = np.linspace(begin, finish, max(2, int(abs(finish - begin)) + 1))
    share = np.clip((np.linspace(0.0, 1.0, len(stations)) - 0.1) / 0.75, 0.0, 1.0)
    blend = share**3 * (10.0 - 15.0 * share + 6.0 * share**2)
    swerves = [SPLITTER_SWERVE if has_splitter(town.plan, road, arm.node) else 0.0 for arm in (first, last)]
    start_offset, end_offset = (
        road.section.lane_centre(lane) + swerve for lane, swerve in zip((lane_in, lane_out), swerves, strict=True)
    )
    offsets = (1.0 - blend) * start_offset + blend * end_offset
    return road.locate(stations, -leg.direction * offsets)


def _trimmed(line: Float, front: float, back: float) -> Float:
    travelled = arc_length(line)
    kept: Float = line[(travelled >= front) & (travelled <= travelled[-1] - back)]
    return kept


def _stop_point(lane_line: Float, arm: Arm) -> Float:
    """Where the rear axle stands when the car waits at the stop line."""
    back = arm.stop - arm.clear + 0.6 + FRONT_OVERHANG
    travelled = arc_length(lane_line)
    at = max(travelled[-1] - back, 0.0)
    return np.array([np.interp(at, travelled, lane_line[:, axis]) for axis in range(2)])


def _through_junction(town: Town, node_index: int, before: Float, after: Float) -> Float:
    """Join the end of one lane to the start of the next: one arc, or the ring of a roundabout."""
    node = town.plan.nodes[node_index]
    start, end = before[-1], after[0]
    start_direction, end_direction = before[-1] - before[-2], after[1] - after[0]
    if not node.is_roundabout:
        return turn_between(start, start_direction, end, end_direction, town.corner_radius + KERB_TO_AXLE)
    radius = (node.island_radius + node.outer_radius) / 2
    enter, leave = (np.arctan2(*(point - node.position)[::-1]) for point in (start, end))
    # Traffic circles anticlockwise; it joins the ring some way behind the arm and leaves it some way before.
    sweep = (leave - enter) % (2 * np.pi)
    margin = min(np.radians(38.0), 0.42 * sweep)
    angles = np.linspace(enter + margin, enter + sweep - margin, max(2, int(np.degrees(sweep - 2 * margin) / 4)))
    spokes = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    ring = node.position + radius * spokes
    along = np.stack([-spokes[:, 1], spokes[:, 0]], axis=1)
    first, last = (vector / np.linalg.norm(vector) for vector in (start_direction, end_direction))
    return np.concatenate(
        [arc_between(start, first, ring[0], along[0]), ring, arc_between(ring[-1], along[-1], end, last)]
    )
