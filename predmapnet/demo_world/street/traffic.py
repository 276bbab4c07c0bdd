"""Vehicles: parked in bays and along kerbs, and driving with and against the ego car."""

from __future__ import annotations

import numpy as np
import shapely
from shapely import Polygon
from shapely.affinity import rotate, translate

from mapfusion.arrays import Float
from predmapnet.demo_world.street.solid_list import Colour, SolidList
from predmapnet.demo_world.world import Trajectory, VectorMap

_LACQUERS: list[Colour] = [
    (0.62, 0.62, 0.62), (0.62, 0.62, 0.60), (0.30, 0.31, 0.32), (0.12, 0.125, 0.13), (0.03, 0.03, 0.033),
    (0.025, 0.026, 0.03), (0.26, 0.02, 0.02), (0.03, 0.06, 0.20), (0.08, 0.13, 0.20), (0.20, 0.17, 0.12),
    (0.04, 0.09, 0.06),
]  # fmt: skip


def vehicle_size(generator: np.random.Generator, heavy: float = 0.12) -> Float:
    """Length, width and height, metres, of a random vehicle; the share ``heavy`` are vans and lorries."""
    kind = generator.uniform()
    if kind < heavy * 0.7:
        return np.array([generator.uniform(5.0, 6.2), 1.98, generator.uniform(2.1, 2.6)])
    if kind < heavy:
        return np.array([generator.uniform(6.8, 8.5), 2.3, generator.uniform(2.8, 3.3)])
    return np.array([generator.uniform(3.9, 4.95), generator.uniform(1.72, 1.92), generator.uniform(1.42, 1.78)])


def lacquer(generator: np.random.Generator) -> Colour:
    """A car's colour; most are white, grey or black."""
    red, green, blue = np.array(_LACQUERS[int(generator.integers(len(_LACQUERS)))]) * generator.uniform(0.85, 1.15)
    return float(red), float(green), float(blue)


def footprint(centre: Float, yaw: float, size: Float) -> Polygon:
    """Outline of a vehicle on the ground."""
    box = shapely.box(-size[0] / 2, -size[1] / 2, size[0] / 2, size[1] / 2)
    return translate(rotate(box, yaw, origin=(0, 0), use_radians=True), centre[0], centre[1])


def ego_corridor(trajectory: Trajectory, width: float = 2.4, beyond: float = 8.0) -> shapely.Geometry:
    """Ground that the ego car sweeps, plus a stretch ahead of its last position."""
    poses = trajectory.ego_to_global
    tail = poses[-1, :2, 3] + beyond * poses[-1, :2, 0]
    head = poses[0, :2, 3] - 4.0 * poses[0, :2, 0]
    return shapely.LineString(np.vstack([head, poses[:, :2, 3], tail])).buffer(width / 2, cap_style="flat")


class Parking:
    """Puts vehicles where nothing else is."""

    def __init__(self, solids: SolidList, forbidden: shapely.Geometry, generator: np.random.Generator) -> None:
        self._solids, self._generator = solids, generator
        self._taken: list[Polygon] = []
        self._forbidden = forbidden
        shapely.prepare(self._forbidden)

    def park(self, centre: Float, yaw: float, size: Float) -> bool:
        """Park one vehicle if its place is free."""
        outline = footprint(centre, yaw, size)
        near = [
            other for other in self._taken if abs(other.centroid.x - centre[0]) + abs(other.centroid.y - centre[1]) < 16
        ]
        if self._forbidden.intersects(outline) or any(outline.distance(other) < 0.25 for other in near):
            return False
        self._taken.append(outline)
        yaw += np.pi * float(self._generator.uniform() < 0.12)
        self._solids.stand("box", centre, size, yaw, lacquer(self._generator), "vehicle")
        return True

    def in_bays(self, bays: tuple[Polygon, ...], share: float, gaps: float = 0.0) -> None:
        """Fill strips of parking bays, places along or across the strip by its depth; the share ``gaps`` stay empty."""
        generator = self._generator
        for bay in bays:
            if gaps and generator.uniform() < gaps:
                continue
            corners = np.asarray(bay.minimum_rotated_rectangle.exterior.coords)[:4]
            if np.linalg.norm(corners[1] - corners[0]) < np.linalg.norm(corners[2] - corners[1]):
                corners = np.roll(corners, -1, axis=0)
            along, across = corners[1] - corners[0], corners[3] - corners[0]
            length, depth = np.linalg.norm(along), np.linalg.norm(across)
            yaw = float(np.arctan2(along[1], along[0]))
            pitch = 2.6 if depth > 4.0 else 6.0
            for station in np.arange(pitch / 2, length - pitch / 2 + 0.1, pitch):
                if generator.uniform() > share:
                    continue
                size = vehicle_size(generator)
                spot = corners[0] + along * (station / length) + across * generator.uniform(0.47, 0.53)
                inside = bay.contains(shapely.Point(spot))
                if inside and size[0 if depth > 4.0 else 1] < depth + 0.3:
                    turned = yaw + (np.pi / 2 if depth > 4.0 else 0.0)
                    self.park(spot, turned + generator.normal(0, 0.015), size)

    def along_kerbs(self, road: shapely.Geometry, sight: shapely.Geometry, share: float) -> None:
        """Park along the road's edge in runs, on the right side of the road as far as that can be told."""
        generator = self._generator
        for polygon in shapely.get_parts(road.buffer(-1.25)):
            for ring in [polygon.exterior, *polygon.interiors]:
                line = shapely.LineString(ring.coords)
                length = line.length
                station, running = generator.uniform(0, 6), False
                while station < length - 6:
                    if generator.uniform() < 0.16:
                        running = generator.uniform() < share
                    station += generator.uniform(5.6, 6.8)
                    if not running or not sight.contains(line.interpolate(station)):
                        continue
                    ends = shapely.get_coordinates([line.interpolate(station + d) for d in (-2.5, 0.0, 2.5)])
                    # Only where the kerb is straight: not in the mouths of junctions.
                    bend = np.linalg.norm((ends[0] + ends[2]) / 2 - ends[1])
                    if bend > 0.12:
                        continue
                    yaw = float(np.arctan2(*(ends[2] - ends[0])[::-1]))
                    self.park(ends[1], yaw + generator.normal(0, 0.02), vehicle_size(generator))


def add_moving_traffic(
    solids: SolidList, vector_map: VectorMap, road: shapely.Geometry, trajectory: Trajectory, seed: int
) -> None:
    """Add moving vehicles that follow the ego car's road: ahead, behind, beside and oncoming.

    Each is a chain of pieces, one per key frame, so that it follows bends; a piece that would leave the road, stand on
    a parked car or come within 6 m of the ego car along its path is left out.
    """
    generator = np.random.default_rng([seed, 41])
    poses, times = trajectory.ego_to_global, (trajectory.timestamps - trajectory.timestamps[0]) * 1e-9
    positions = poses[:, :2, 3]
    ends = np.vstack([positions[0] - 90 * poses[0, :2, 0], positions, positions[-1] + 90 * poses[-1, :2, 0]])
    keep = np.concatenate([[True], np.linalg.norm(np.diff(ends, axis=0), axis=1) > 0.2])
    path = shapely.LineString(ends[keep]).simplify(0.05)
    smooth = shapely.get_coordinates(shapely.segmentize(path, 3.0))
    line = shapely.LineString(smooth)
    ego_station = np.array([line.project(shapely.Point(position)) for position in positions])
    inner = road.buffer(-0.2)
    shapely.prepare(inner)
    standing = _parked(solids)
    plans: list[tuple[float, float, Float]] = []
    ahead, behind = generator.uniform(14, 34), generator.uniform(12, 24)
    if generator.uniform() < 0.5:
        plans.append((0.0, 1.0, ego_station + ahead + 3 * np.sin(times / 4 + generator.uniform(0, 6))))
    if generator.uniform() < 0.5:
        plans.append((0.0, 1.0, ego_station - behind - 2 * np.sin(times / 5 + generator.uniform(0, 6))))
    for _ in range(int(generator.integers(3, 7))):
        lateral = float(generator.choice([3.5, 3.6, 7.0]))
        speed = generator.uniform(6, 13)
        plans.append((lateral, -1.0, generator.uniform(40, line.length) - speed * times))
    for _ in range(int(generator.integers(0, 3))):
        lateral = float(generator.choice([-3.5, 3.5, -3.5]))
        plans.append((lateral, 1.0, ego_station + generator.uniform(-30, 45) + generator.uniform(-2, 2) * times))
    taken: list[list[Polygon]] = [[] for _ in times]
    keep_side = -1.0 if vector_map.left_hand else 1.0
    for lateral, sense, stations in plans:
        size, colour = vehicle_size(generator, heavy=0.15), lacquer(generator)
        for frame, station in enumerate(stations):
            if not 3 < station < line.length - 3:
                continue
            two = shapely.get_coordinates([line.interpolate(station - 1.5), line.interpolate(station + 1.5)])
            direction = (two[1] - two[0]) / max(float(np.linalg.norm(two[1] - two[0])), 1e-6)
            centre = two.mean(axis=0) + keep_side * lateral * np.array([-direction[1], direction[0]])
            yaw = float(np.arctan2(direction[1], direction[0])) + (np.pi if sense < 0 else 0.0)
            outline = footprint(centre, yaw, size)
            ego = footprint(
                positions[frame] + 1.4 * poses[frame, :2, 0], np.arctan2(*poses[frame, 1::-1, 0]), np.array([4.6, 1.9])
            )
            apart = outline.distance(ego)
            blocked = abs(lateral) < 2.5 and apart < 6.0
            if apart < 1.0 or blocked or not inner.contains(outline):
                continue
            if any(outline.distance(other) < 1.5 for other in taken[frame]) or standing.intersects(outline):
                continue
            taken[frame].append(outline)
            start = times[frame]
            stop = times[frame + 1] if frame + 1 < len(times) else np.inf
            step = (stations[min(frame + 1, len(times) - 1)] - station) / max(min(stop, start + 10) - start, 0.05)
            velocity = direction * step + 1e-6
            origin = centre - velocity * start
            lifetime = (-np.inf if frame == 0 else start - 1e-3, stop - 1e-3)
            solids.add("box", (*origin, size[2] / 2), size, yaw, colour, "vehicle", velocity, lifetime)


def _parked(solids: SolidList) -> shapely.Geometry:
    """Outlines of all vehicles that stand, grown by 0.3 m."""
    done = solids.solids()
    rows = np.flatnonzero(done.texture == "vehicle")
    outlines = shapely.union_all(
        [footprint(done.centre[row], done.yaw[row], done.size[row]).buffer(0.3) for row in rows]
    )
    shapely.prepare(outlines)
    return outlines
