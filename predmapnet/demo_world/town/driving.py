"""Drives along a path: arcs that join lanes, speeds that a person would drive, and the poses that follow."""

from __future__ import annotations

import numpy as np
from numpy.random import Generator
from scipy.ndimage import gaussian_filter1d

from mapfusion.arrays import Float
from mapfusion.geometry import arc_length
from predmapnet.demo_world.world import Trajectory

KEY_FRAMES = 40
FRAME_SECONDS = 0.5
FIRST_TIMESTAMP = 1_532_402_927_000_000_000
"""Nanoseconds; in the summer in which nuScenes was recorded, a whole number of microseconds."""

PATH_STEP = 0.25
LATERAL_LIMIT = 2.3
ACCELERATION_LIMIT = 1.6
BRAKING_LIMIT = 2.2
"""Metres per second squared."""

FRONT_OVERHANG = 4.0
"""From the rear axle to the front bumper, metres."""


def drive_along_path(random: Generator, path: Float, stops: Float, cruise: float, seed: int) -> Trajectory:
    """Drive along a path ``(n, 2)`` of the rear axle, every :data:`PATH_STEP` metres, and note the pose twice a second.

    ``stops`` are distances along it at which the car may have to stop, ``cruise`` is its highest speed in m/s, and the
    seed sets the time.
    """
    stations = _drive_along(random, path, stops, cruise)
    travelled = arc_length(path)
    positions = np.stack([np.interp(stations, travelled, path[:, axis]) for axis in range(2)], axis=1)
    headings = np.interp(stations, travelled, _headings(path))
    pitch, roll = np.radians(random.normal(0.0, 0.1, (2, KEY_FRAMES)))
    poses = np.tile(np.eye(4), (KEY_FRAMES, 1, 1))
    poses[:, :3, :3] = _rotations(headings, pitch, roll)
    poses[:, :2, 3] = positions
    step = int(FRAME_SECONDS * 1e9)
    return Trajectory(FIRST_TIMESTAMP + seed * 3600 * 10**9 + step * np.arange(KEY_FRAMES, dtype=np.int64), poses)


def _rotations(yaw: Float, pitch: Float, roll: Float) -> Float:
    """Rotation matrices ``(n, 3, 3)`` of yaw about z, then pitch about y, then roll about x."""

    def about(axis: int, angle: Float) -> Float:
        first, second = [(1, 2), (2, 0), (0, 1)][axis]
        matrices = np.tile(np.eye(3), (len(angle), 1, 1))
        matrices[:, first, first] = matrices[:, second, second] = np.cos(angle)
        matrices[:, second, first] = np.sin(angle)
        matrices[:, first, second] = -np.sin(angle)
        return matrices

    return about(2, yaw) @ about(1, pitch) @ about(0, roll)


def turn_between(start: Float, start_direction: Float, end: Float, end_direction: Float, right_radius: float) -> Float:
    """A turn between two lanes: straight on, an arc, straight on. To the right it follows the rounded kerb."""
    first, last = (vector / np.linalg.norm(vector) for vector in (start_direction, end_direction))
    angle = float(np.arctan2(first[0] * last[1] - first[1] * last[0], first @ last))
    if abs(angle) < np.radians(15.0):
        return arc_between(start, first, end, last)
    # Where the two lanes would meet: start + before * first = end - after * last.
    before, after = np.linalg.solve(np.stack([first, last], axis=1), end - start)
    if min(before, after) < 1.0:
        return arc_between(start, first, end, last)
    reach = min(before, after, right_radius * np.tan(-angle / 2) if angle < 0 else np.inf)
    enter, leave = start + (before - reach) * first, end - (after - reach) * last
    return np.concatenate([start[None], enter[None], arc_between(enter, first, leave, last), leave[None], end[None]])


def arc_between(start: Float, first: Float, end: Float, last: Float) -> Float:
    """A cubic Bezier curve between two places and directions (unit length), near a circular arc where one fits."""
    angle = max(float(np.arccos(np.clip(first @ last, -1.0, 1.0))), 1e-3)
    handle = 4 / 3 * np.tan(angle / 4) / (2 * np.sin(angle / 2)) * np.linalg.norm(end - start)
    t = np.linspace(0.0, 1.0, 40)[:, None]
    controls = (start, start + handle * first, end - handle * last, end)
    weights = ((1 - t) ** 3, 3 * t * (1 - t) ** 2, 3 * t**2 * (1 - t), t**3)
    curve: Float = np.sum([weight * control for weight, control in zip(weights, controls, strict=True)], axis=0)
    return curve


def evenly(path: Float) -> Float:
    """The same path with a point every :data:`PATH_STEP` metres."""
    travelled = arc_length(path)
    stations = np.arange(0.0, travelled[-1], PATH_STEP)
    return np.stack([np.interp(stations, travelled, path[:, axis]) for axis in range(2)], axis=1)


def _headings(path: Float) -> Float:
    tangents = np.gradient(path, axis=0)
    return np.unwrap(np.arctan2(tangents[:, 1], tangents[:, 0]))


def _curvature(path: Float) -> Float:
    bend: Float = gaussian_filter1d(np.gradient(_headings(path)), 2.0)
    return np.abs(bend) / PATH_STEP


def sharpest_bend(path: Float) -> float:
    """Largest curvature of an even path, per metre."""
    return float(_curvature(path).max())


def _drive_along(random: Generator, path: Float, stops: Float, cruise: float) -> Float:
    """Distances along the path ``(KEY_FRAMES,)`` at the key frames."""
    limit = np.minimum(cruise, np.sqrt(LATERAL_LIMIT / np.maximum(_curvature(path), 1e-6)))
    waits = np.zeros(len(path))
    for stop in stops:
        index = round(stop / PATH_STEP)
        if stop > 25.0 and waits.sum() == 0.0 and random.random() < 0.3:
            limit[index] = 0.0
            waits[index] = random.uniform(0.8, 2.5)
    speed = _reachable(limit)
    seconds = 2 * PATH_STEP / np.maximum(speed[:-1] + speed[1:], 1e-3)
    clock = np.concatenate([[0.0], np.cumsum(seconds)])
    held = np.flatnonzero(waits)
    times, stations = clock + np.concatenate([[0.0], np.cumsum(waits)[:-1]]), PATH_STEP * np.arange(len(path))
    for index in held:
        # Standing still: the same place at two times.
        times = np.insert(times, index + 1, times[index] + waits[index])
        stations = np.insert(stations, index + 1, stations[index])
    reached: Float = np.interp(FRAME_SECONDS * np.arange(KEY_FRAMES), times, stations)
    return reached


def _reachable(limit: Float) -> Float:
    """The fastest speeds below a limit that acceleration and braking allow."""
    squared = limit**2
    for index in range(1, len(squared)):
        squared[index] = min(squared[index], squared[index - 1] + 2 * ACCELERATION_LIMIT * PATH_STEP)
    for index in range(len(squared) - 2, -1, -1):
        squared[index] = min(squared[index], squared[index + 1] + 2 * BRAKING_LIMIT * PATH_STEP)
    speed: Float = np.sqrt(squared)
    return speed
