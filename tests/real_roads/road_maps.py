"""Real road geometry under free licences (``road_geometry`` of the fixtures) as material for the renderer."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import shapely
from scipy.ndimage import gaussian_filter1d
from shapely import Polygon

from mapfusion.arrays import Float
from mapfusion.elements import GlobalMap, RegionOfInterest
from mapfusion.geometry import arc_length, resample
from predmapnet.datasets.ground_truth.whole_map import join_lines, truth_map
from predmapnet.demo_world.rig import LIDAR_TO_EGO
from predmapnet.demo_world.truth import truth_from_vector_map
from predmapnet.demo_world.world import Crossing, CrossingStyle, Divider, LineStyle, Trajectory, VectorMap
from predmapnet.errors import UserError
from predmapnet.scenes import FrameTruth

FRAMES = 40
METRES_PER_FRAME = 4.0
FRAME_NANOSECONDS = 500_000_000
"""8 m/s at 2 Hz."""
MARGIN = 12.0
"""A drive keeps this far from both ends of its lanes, metres."""
JOINT = 0.5
"""A lane path that begins this close to the end of another follows it, metres."""
IN_VIEW = 15.0
"""Metres beside a drive; how much paint lies in it decides which drives are taken."""
RARITY = 5.0
"""A metre of a crossing's outline counts as so many of a divider: crossings are rare."""


@dataclass(frozen=True)
class Truth:
    """What is true along a drive.

    Attributes:
        frame: truth of frame ``index`` of the drive's poses, clipped to a region, ego frame.
        whole: the map of the whole drive, global frame.
    """

    frame: Callable[[int, RegionOfInterest], FrameTruth]
    whole: Callable[[], GlobalMap]


def read_road_map(path: Path) -> tuple[VectorMap, list[Float], VectorMap]:
    """Read one map.

    Returns:
        What is painted; the lane paths ``(n, 2)`` in driving direction; and what counts as true by the rules of
        nuScenes: pieces of a divider joined, lines along the kerb or a median left out.
    """
    content = json.loads(path.read_text())
    dividers = [
        (Divider(np.array(entry["points"]), LineStyle(entry["style"]), entry["colour"], entry["opposite"]), entry)
        for entry in content["dividers"]
        if len(entry["points"]) >= 2
    ]
    paths = [np.array(line) for line in content["lane_paths"]]
    painted = VectorMap(
        road_segments=tuple(
            Polygon(segment["exterior"], [hole for hole in segment["holes"] if len(hole) >= 4])
            for segment in content["road_segments"]
        ),
        lanes=tuple(Polygon(ring) for ring in content["lanes"]),
        crossings=tuple(_crossing(number, Polygon(ring)) for number, ring in enumerate(content["crossings"])),
        dividers=tuple(divider for divider, _ in dividers),
        stop_lines=tuple(Polygon(ring) for ring in content["stop_lines"]),
        lane_paths=tuple(paths),
    )
    between = [divider.points for divider, entry in dividers if not entry["edge"]]
    joined = tuple(Divider(line, LineStyle.SOLID) for line in join_lines(between))
    return painted, paths, replace(painted, dividers=joined)


def _crossing(number: int, polygon: Polygon) -> Crossing:
    """Paint is not recorded; people walk along the longer side."""
    corners = shapely.get_coordinates(polygon.minimum_rotated_rectangle)[:3]
    sides = np.diff(corners, axis=0)
    walk = sides[np.argmax(np.linalg.norm(sides, axis=1))]
    return Crossing(polygon, list(CrossingStyle)[number % 3], float(np.arctan2(walk[1], walk[0])))


def truth_along(true_map: VectorMap, trajectory: Trajectory) -> Truth:
    """Return the truth of a drive by the rules of nuScenes; the ego origin is the centre of the region."""
    truth = truth_from_vector_map(true_map)
    turned = np.eye(4)
    turned[:3, :3] = LIDAR_TO_EGO[:3, :3]
    poses = trajectory.ego_to_global @ turned

    def frame(index: int, roi: RegionOfInterest) -> FrameTruth:
        return truth.frame(poses[index], roi)

    def whole() -> GlobalMap:
        return truth_map(truth, list(zip(trajectory.timestamps.tolist(), poses, strict=True)), RegionOfInterest())

    return Truth(frame, whole)


def drives_along(paths: list[Float], vector_map: VectorMap, count: int) -> list[Trajectory]:
    """Choose drives along lane paths that together see the most paint.

    Args:
        paths: ``(n, 2)`` in driving direction.
        vector_map: what is painted.
        count: how many drives.

    Raises:
        UserError: no chain of paths is long enough for three frames.
    """
    chains = [_chain(paths, start) for start in range(len(paths))]
    chains = [line for line in chains if arc_length(line)[-1] > 2 * MARGIN + 2 * METRES_PER_FRAME]
    if not chains:
        raise UserError("The map holds no lane path that is long enough for a drive.")
    lines = shapely.union_all([shapely.LineString(divider.points) for divider in vector_map.dividers])
    rings = shapely.union_all([crossing.polygon.exterior for crossing in vector_map.crossings])
    trajectories = []
    for _ in range(count):
        corridors = [shapely.LineString(_driven(line)).buffer(IN_VIEW) for line in chains]
        seen = [
            shapely.length(shapely.intersection([lines, rings], corridor)) @ [1.0, RARITY] for corridor in corridors
        ]
        best = int(np.argmax(seen))
        trajectories.append(_trajectory(_driven(chains[best])))
        lines, rings = shapely.difference([lines, rings], corridors[best])
    return trajectories


def _chain(paths: list[Float], start: int) -> Float:
    """Follow the lanes from one path, straight on where there is a choice, never twice along the same path."""
    chain, used = paths[start], {start}
    while arc_length(chain)[-1] < FRAMES * METRES_PER_FRAME + 2 * MARGIN:
        heading = chain[-1] - chain[-2]
        following = [
            (-float(heading @ (path[1] - path[0])) / np.linalg.norm(path[1] - path[0]), row)
            for row, path in enumerate(paths)
            if row not in used and np.linalg.norm(path[0] - chain[-1]) < JOINT
        ]
        if not following:
            break
        row = min(following)[1]
        used.add(row)
        chain = np.concatenate([chain, paths[row][1:]])
    return chain


def _driven(line: Float) -> Float:
    """Positions every quarter metre along the middle of a chain, smoothed as a car drives it."""
    length = arc_length(line)[-1]
    dense = resample(line, int(length / 0.25) + 1)
    smooth = gaussian_filter1d(dense, 6.0, axis=0, mode="nearest")
    last = min(length - MARGIN, MARGIN + (FRAMES - 1) * METRES_PER_FRAME)
    return np.asarray(smooth[int(MARGIN / 0.25) : int(last / 0.25) + 1])


def _trajectory(line: Float) -> Trajectory:
    step = int(METRES_PER_FRAME / 0.25)
    tangents = np.gradient(line, axis=0)[::step]
    positions = line[::step]
    poses = np.tile(np.eye(4), (len(positions), 1, 1))
    yaw = np.arctan2(tangents[:, 1], tangents[:, 0])
    poses[:, 0, 0] = poses[:, 1, 1] = np.cos(yaw)
    poses[:, 1, 0], poses[:, 0, 1] = np.sin(yaw), -np.sin(yaw)
    poses[:, :2, 3] = positions
    return Trajectory(FRAME_NANOSECONDS * np.arange(1, len(poses) + 1, dtype=np.int64), poses)
