"""Roads with known lines, drives along them, and a detector whose errors are known: all from fixed seeds."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import shapely
import shapely.ops

from mapfusion.arrays import Float
from mapfusion.elements import ElementKind, FrameMap, GlobalMap, MapElement, RegionOfInterest
from mapfusion.geometry import arc_length, inverse_pose, resample, transform_points
from mapfusion.ground import CameraSector, ground_within, visible_ground

DIVIDER, BOUNDARY, CROSSING = ElementKind.DIVIDER, ElementKind.BOUNDARY, ElementKind.PED_CROSSING
ROI = RegionOfInterest()


@dataclass(frozen=True)
class Detector:
    """How the simulated detector errs; deviations in metres.

    Of the variance of its displacements ``track_share`` stays as long as a track does and ``slow_share`` changes with
    the way that the car goes, over ``slow_length`` metres; the rest is new in every frame.
    """

    near: float = 0.15
    per_metre: float = 0.35 / 30.0
    jitter: float = 0.03
    end: float = 0.7
    drop_out: float = 0.2
    id_switch: float = 0.05
    ghosts: float = 0.1
    points: int = 20
    track_share: float = 0.0
    slow_share: float = 0.0
    slow_length: float = 20.0

    def scaled(self, deviation: float) -> Detector:
        """Return a detector whose displacements have this deviation on average (0.3 m unless told)."""
        return replace(self, near=self.near * deviation / 0.3, per_metre=self.per_metre * deviation / 0.3)


class LastingErrors:
    """The parts of the displacement that stay from frame to frame, as coefficients ``(2, 3)`` of its shape."""

    def __init__(self, rng: np.random.Generator, detector: Detector) -> None:
        self.rng = rng
        self.detector = detector
        self.of_track: dict[int, Float] = {}
        self.slow: dict[tuple[int, int], tuple[Float, Float]] = {}

    def at(self, track: int, key: tuple[int, int], car: Float) -> Float:
        """Return the coefficients for a piece of a true element and its track, seen from ``car`` ``(2,)``."""
        coefficients = np.zeros((2, 3))
        if self.detector.track_share:
            if track not in self.of_track:
                self.of_track[track] = self.rng.normal(size=(2, 3))
            coefficients += np.sqrt(self.detector.track_share) * self.of_track[track]
        if self.detector.slow_share:
            fresh = self.rng.normal(size=(2, 3))
            if key in self.slow:
                before, seen_from = self.slow[key]
                kept = np.exp(-np.linalg.norm(car - seen_from) / self.detector.slow_length)
                fresh = kept * before + np.sqrt(1.0 - kept**2) * fresh
            self.slow[key] = fresh, car
            coefficients += np.sqrt(self.detector.slow_share) * fresh
        return coefficients


@dataclass(frozen=True)
class Ghost:
    """Something that was never there: where, which kind, in which frames it was reported."""

    kind: ElementKind
    points: Float
    frames: tuple[int, ...]


@dataclass(frozen=True)
class Drive:
    """What the simulated detector reported on one drive, and what is true."""

    truth: GlobalMap
    frames: tuple[FrameMap, ...]
    ghosts: tuple[Ghost, ...] = field(default=())


def element(kind: ElementKind, points: Float) -> MapElement:
    """Return a true element."""
    return MapElement(kind, np.asarray(points, dtype=np.float64), 1.0, 1, 0, 0)


def pose(x: float, y: float, heading: float) -> Float:
    """Return ``ego_to_global`` of a car on the plane."""
    matrix = np.eye(4)
    matrix[:2, :2] = [[np.cos(heading), -np.sin(heading)], [np.sin(heading), np.cos(heading)]]
    matrix[:2, 3] = [x, y]
    return matrix


class Road:
    """A smooth winding centre line; lines are given by station and offset to the left."""

    def __init__(self, rng: np.random.Generator, length: float = 420.0) -> None:
        self.s = np.arange(0.0, length, 0.5)
        curvature = np.zeros_like(self.s)
        for wavelength in (90.0, 150.0, 260.0):
            curvature += rng.normal(0.0, 0.005) * np.sin(2 * np.pi * (self.s / wavelength + rng.random()))
        self.heading = rng.uniform(-np.pi, np.pi) + np.cumsum(curvature) * 0.5
        self.points = 1000.0 * rng.normal(size=2) + 0.5 * np.cumsum(
            np.stack([np.cos(self.heading), np.sin(self.heading)], axis=1), axis=0
        )

    def at(self, s: Float, d: Float | float) -> Float:
        """Return points at stations ``s`` and offsets ``d``."""
        heading = np.interp(s, self.s, self.heading)
        centre = np.stack([np.interp(s, self.s, self.points[:, axis]) for axis in range(2)], axis=1)
        return np.asarray(centre + np.asarray(d)[..., None] * np.stack([-np.sin(heading), np.cos(heading)], axis=1))

    def along(self, start: float, stop: float, d: float) -> Float:
        """Return a line of constant offset."""
        return self.at(np.linspace(start, stop, max(int((stop - start) / 1.0), 2)), d)

    def pose(self, s: float, d: float) -> Float:
        """Return the pose of a car at a station and an offset, driving along the road."""
        x, y = self.at(np.array([s]), d)[0]
        return pose(x, y, float(np.interp(s, self.s, self.heading)))


def town_road(rng: np.random.Generator) -> tuple[GlobalMap, Road]:
    """Return a road of two lanes each way with two junctions, crossings, a double divider and an island."""
    road = Road(rng)
    elements: list[MapElement] = []
    junctions = [120.0, 270.0]
    edges = [0.0, *(edge for s in junctions for edge in (s - 14.0, s + 14.0)), 400.0]
    for start, stop in zip(edges[::2], edges[1::2], strict=True):
        middle = (-0.15, 0.15) if start > 0 else (0.0,)
        elements.extend(element(DIVIDER, road.along(start, stop, d)) for d in (-3.5, *middle, 3.5))
    for side in (-1, 1):
        previous: Float | None = None
        start = 0.0
        for s in [*junctions, None]:
            pieces = [] if previous is None else [previous]
            stop = 400.0 if s is None else s - 10.0
            pieces.append(road.along(start, stop, side * 7.0))
            if s is not None:
                turn = np.linspace(0.0, np.pi / 2, 10)
                pieces.append(road.at(s - 10.0 + 5.0 * np.sin(turn), side * (12.0 - 5.0 * np.cos(turn))))
                pieces.append(road.at(np.full(20, s - 5.0), side * np.linspace(13.0, 40.0, 20)))
                elements.append(element(BOUNDARY, np.concatenate(pieces)))
                previous = np.concatenate(
                    [
                        road.at(np.full(20, s + 5.0), side * np.linspace(40.0, 13.0, 20)),
                        road.at(s + 10.0 - 5.0 * np.sin(turn[::-1]), side * (12.0 - 5.0 * np.cos(turn[::-1]))),
                    ]
                )
                start = s + 10.0
                elements.append(element(DIVIDER, road.at(np.full(30, s), side * np.linspace(14.0, 40.0, 30))))
            else:
                elements.append(element(BOUNDARY, np.concatenate(pieces)))
    for s in junctions:
        for at in (s - 13.0, s + 10.0):
            corners = road.at(np.array([at, at + 3.0, at + 3.0, at, at]), np.array([-6.5, -6.5, 6.5, 6.5, -6.5]))
            elements.append(element(CROSSING, corners))
        corners = road.at(
            np.array([s - 4.5, s + 4.5, s + 4.5, s - 4.5, s - 4.5]), np.array([9.0, 9.0, 12.5, 12.5, 9.0])
        )
        elements.append(element(CROSSING, corners))
    around = np.linspace(0.0, 2 * np.pi, 49)
    squash = np.sign(np.cos(around)) * np.abs(np.cos(around)) ** 0.5
    elements.append(element(BOUNDARY, road.at(60.0 + 9.0 * squash, 11.0 + 1.2 * np.sin(around))))
    return GlobalMap(tuple(elements)), road


def simulate(
    truth: GlobalMap,
    poses: list[Float],
    rng: np.random.Generator,
    detector: Detector | None = None,
    period: float = 0.5,
    trucks: Sequence[Sequence[Float]] | None = None,
) -> Drive:
    """Drive along poses and report what the detector makes of the true elements in the ROI.

    ``trucks`` are the outlines, global frame, that stand in the way in each frame; frames then say what is visible.
    """
    detector = detector or Detector()
    track_of: dict[tuple[int, int], int] = {}
    next_track = 0
    live: list[tuple[ElementKind, Float, list[int], int, int]] = []
    ghosts: list[tuple[ElementKind, Float, list[int], int, int]] = []
    frames = []
    lasting = LastingErrors(rng, detector)
    box = shapely.box(*(-ROI.size / 2), *(ROI.size / 2))
    for number, ego_to_global in enumerate(poses):
        global_to_ego = inverse_pose(ego_to_global)
        visible: tuple[Float, ...] | None = None
        open_ground: shapely.Geometry = box
        if trucks is not None:
            things = [transform_points(global_to_ego, truck) for truck in trucks[number]]
            visible = visible_ground(ROI, [CameraSector(np.zeros(2))], things)
            open_ground = ground_within(visible)
        found: list[tuple[int, float, int, Float]] = []
        for row, true in enumerate(truth):
            local = transform_points(global_to_ego, true.points)
            for part, piece in enumerate(visible_pieces(true.kind, local, open_ground)):
                if rng.random() < detector.drop_out:
                    continue
                key = (row, part)
                if key not in track_of or rng.random() < detector.id_switch:
                    track_of[key], next_track = next_track, next_track + 1
                stays = lasting.at(track_of[key], key, ego_to_global[:2, 3])
                score = rng.uniform(0.4, 0.95)
                found.append((int(true.kind), score, track_of[key], _err(true.kind, piece, rng, detector, stays)))
        for _ in range(rng.poisson(detector.ghosts * max(len(found), 1) / 1.5)):
            kind = ElementKind(int(rng.integers(3)))
            points = transform_points(ego_to_global, _ghost(kind, rng))
            live.append((kind, points, [], next_track, int(rng.integers(1, 3))))
            ghosts.append(live[-1])
            next_track += 1
        for kind, points, seen, track, _ in live:
            for piece in visible_pieces(kind, transform_points(global_to_ego, points), box)[:1]:
                seen.append(number)
                found.append((int(kind), rng.uniform(0.4, 0.7), track, _err(kind, piece, rng, detector)))
        live = [ghost for ghost in live if len(ghost[2]) < ghost[4]]
        frames.append(
            FrameMap(
                timestamp=1_700_000_000_000_000_000 + int(number * period * 1e9),
                ego_to_global=ego_to_global,
                roi=ROI,
                kinds=np.array([f[0] for f in found], dtype=np.int64),
                scores=np.array([f[1] for f in found]),
                track_ids=np.array([f[2] for f in found], dtype=np.int64),
                polylines=tuple(f[3] for f in found),
                visible=visible,
            )
        )
    return Drive(truth, tuple(frames), tuple(Ghost(g[0], g[1], tuple(g[2])) for g in ghosts))


def town_drive(seed: int, frames: int = 40, detector: Detector | None = None) -> Drive:
    """Return a drive of 40 frames at 2 Hz and about 30 km/h along a town road."""
    rng = np.random.default_rng(seed)
    truth, road = town_road(rng)
    poses = [road.pose(30.0 + 4.5 * number, -1.75 + 0.2 * np.sin(number / 5)) for number in range(frames)]
    return simulate(truth, poses, rng, detector)


def visible_pieces(kind: ElementKind, local: Float, box: shapely.Polygon) -> list[Float]:
    """Clip an element of the ego frame to the ROI; ends of under a metre are left out."""
    if kind.is_ring:
        parts = shapely.get_parts(shapely.intersection(shapely.make_valid(shapely.Polygon(local)), box))
        return [shapely.get_coordinates(p.exterior) for p in parts if p.geom_type == "Polygon" and p.area > 1.0]
    clipped = shapely.intersection(shapely.LineString(local), box)
    if clipped.geom_type == "MultiLineString":
        clipped = shapely.line_merge(clipped)
    parts = shapely.get_parts(clipped)
    return [shapely.get_coordinates(p) for p in parts if p.geom_type == "LineString" and p.length > 1.0]


def _err(
    kind: ElementKind, piece: Float, rng: np.random.Generator, detector: Detector, stays: Float | float = 0.0
) -> Float:
    """Displace a piece smoothly: one offset, a turn and a bend for the whole, little jitter per point.

    The vertices run either way and start anywhere; ``stays``, what of the displacement lasts, goes with the place.
    """
    if not kind.is_ring:
        length = arc_length(piece)[-1]
        line = shapely.LineString(piece)
        start, stop = np.abs(rng.normal(0.0, detector.end, 2)).clip(0.0, length / 4)
        piece = shapely.get_coordinates(shapely.ops.substring(line, start, length - stop))
        points = resample(piece, detector.points)
        way = -1.0 if rng.random() < 0.3 else 1.0
        points = points if way > 0 else points[::-1]
    else:
        count = len(piece) - 1
        points = resample(np.roll(piece[:-1], rng.integers(count), axis=0)[np.r_[0:count, 0]], detector.points + 1)
        way = -1.0 if rng.random() < 0.5 else 1.0
        points = points if way > 0 else points[::-1]
    u = np.linspace(-1.0, 1.0, len(points))
    if kind.is_ring:
        u = np.sin(np.pi * u)
    deviation = detector.near + detector.per_metre * np.linalg.norm(points, axis=1)
    new = np.sqrt(1.0 - detector.track_share - detector.slow_share) * rng.normal(size=(2, 3))
    shape = np.sqrt([0.6, 0.25 * 3.0, 0.15 * 2.0]) * (new + stays * np.array([1.0, way, 1.0]))
    error = shape[:, 0:1] + shape[:, 1:2] * u + shape[:, 2:3] * np.cos(np.pi * u)
    noisy = points + (deviation * error).T + rng.normal(0.0, detector.jitter, points.shape)
    if kind.is_ring:
        noisy[-1] = noisy[0]
    return np.asarray(np.clip(noisy, -ROI.size / 2, ROI.size / 2))


def _ghost(kind: ElementKind, rng: np.random.Generator) -> Float:
    centre = rng.uniform(-0.4, 0.4, 2) * ROI.size
    heading = rng.normal(0.0, 0.5)
    turn = np.array([[np.cos(heading), -np.sin(heading)], [np.sin(heading), np.cos(heading)]])
    if kind.is_ring:
        shape = np.array([[-2, -4], [2, -4], [2, 4], [-2, 4], [-2, -4]]) * rng.uniform(0.7, 1.3)
    else:
        x = np.linspace(-0.5, 0.5, 10) * rng.uniform(6.0, 25.0)
        shape = np.stack([x, rng.normal(0.0, 0.01) * x**2], axis=1)
    return np.asarray(shape @ turn.T + centre)
