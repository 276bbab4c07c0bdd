"""A real Argoverse 2 log as material for the renderer: its map, its drive and its cameras."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import shapely
from shapely import Polygon

from mapfusion.arrays import Float
from predmapnet.datasets.argoverse2 import KEY_FRAME_STRIDE, Argoverse2Scene, Argoverse2Source
from predmapnet.datasets.ground_truth.map_file import read_map_file
from predmapnet.demo_world.world import Crossing, CrossingStyle, Divider, LineStyle, Trajectory, VectorMap
from predmapnet.errors import UserError
from predmapnet.scenes import Rig

REAR_AXLE_HEIGHT = 0.33
"""Metres of the ego origin above the road: Argoverse 2 puts it at the middle of the rear axle."""

_STYLES = {
    "SOLID_WHITE": LineStyle.SOLID,
    "SOLID_YELLOW": LineStyle.SOLID,
    "SOLID_BLUE": LineStyle.SOLID,
    "DASHED_WHITE": LineStyle.DASHED,
    "DASHED_YELLOW": LineStyle.DASHED,
    "DOUBLE_SOLID_WHITE": LineStyle.DOUBLE_SOLID,
    "DOUBLE_SOLID_YELLOW": LineStyle.DOUBLE_SOLID,
    "DOUBLE_DASH_WHITE": LineStyle.DASHED,
    "DOUBLE_DASH_YELLOW": LineStyle.DASHED,
    "SOLID_DASH_WHITE": LineStyle.SOLID_DASHED,
    "SOLID_DASH_YELLOW": LineStyle.SOLID_DASHED,
    "DASH_SOLID_WHITE": LineStyle.SOLID_DASHED,
    "DASH_SOLID_YELLOW": LineStyle.SOLID_DASHED,
}


def _points(records: Sequence[Mapping[str, float]]) -> Float:
    return np.array([[record["x"], record["y"]] for record in records], dtype=np.float64)


def vector_map_of(archive: Mapping[str, Any]) -> VectorMap:
    """Turn an Argoverse 2 map archive into the demo world's terms, heights dropped.

    Args:
        archive: ``log_map_archive_*.json``, parsed. Lane sides without a painted mark are left out; a side that two
            lanes share is painted once.
    """
    roads = [Polygon(_points(area["area_boundary"])) for area in archive["drivable_areas"].values()]
    parts = [part for road in roads for part in shapely.get_parts(shapely.make_valid(road)) if part.area > 0.1]
    dividers: dict[frozenset[tuple[float, ...]], Divider] = {}
    lanes: list[Polygon] = []
    for lane in archive["lane_segments"].values():
        left, right = _points(lane["left_lane_boundary"]), _points(lane["right_lane_boundary"])
        outline = shapely.make_valid(Polygon(np.vstack([left, right[::-1]])))
        lanes += [part for part in shapely.get_parts(outline) if isinstance(part, Polygon) and part.area > 0.1]
        for side, line in (("left", left), ("right", right)):
            mark = lane[f"{side}_lane_mark_type"]
            if mark in _STYLES and len(line) >= 2:
                ends = frozenset(tuple(np.round(end, 1)) for end in (line[0], line[-1]))
                colour = "yellow" if mark.endswith("YELLOW") else "white"
                dividers.setdefault(ends, Divider(line, _STYLES[mark], colour, opposite=colour == "yellow"))
    crossings: list[Crossing] = []
    for index, record in enumerate(archive["pedestrian_crossings"].values()):
        first, second = _points(record["edge1"]), _points(record["edge2"])
        if np.linalg.norm(first[0] - second[-1]) < np.linalg.norm(first[0] - second[0]):
            second = second[::-1]
        outline = Polygon(np.vstack([first, second[::-1]]))
        if outline.is_valid and outline.area > 0.5:
            # The edges of the record run in the walking direction; its paint is not recorded.
            walk = first[-1] - first[0]
            style = list(CrossingStyle)[index % 3]
            crossings.append(Crossing(outline, style, float(np.arctan2(walk[1], walk[0]))))
    return VectorMap(tuple(parts), tuple(lanes), tuple(crossings), tuple(dividers.values()))


@dataclass(frozen=True)
class LoggedDrive:
    """What the renderer needs of a log, and the log itself, which knows the official truth.

    Attributes:
        vector_map: the real map, heights dropped.
        trajectory: the real ego motion on the plane z = 0, without pitch and roll. The ego origin, the middle of the
            rear axle, moves :data:`REAR_AXLE_HEIGHT` above it.
        rig: the real cameras, or None for a log without calibration. Lens distortion is left out: they are pinholes
            with the real intrinsics.
        log: frames of the log in the order of the trajectory.
    """

    vector_map: VectorMap
    trajectory: Trajectory
    rig: Rig | None
    log: Argoverse2Scene


def read_log(folder: Path, stride: int = KEY_FRAME_STRIDE) -> LoggedDrive:
    """Read what the renderer needs of a log: real map, real ego motion, real calibration.

    Args:
        folder: the log's folder, as Argoverse 2 names it.
        stride: take every so many lidar sweeps (10 Hz).

    Raises:
        UserError: the log has no map, or a file is broken.
    """
    log = Argoverse2Source(folder.parent, stride=stride).open(folder.name)
    archives = sorted((folder / "map").glob("log_map_archive_*.json"))
    if not archives:
        raise UserError(f"{folder / 'map'} holds no log_map_archive_*.json, so there is no map to dress.")
    archive, _ = read_map_file(archives[0])
    poses = np.tile(np.eye(4), (len(log), 1, 1))
    for index in range(len(log)):
        pose = log.pose(index)
        yaw = np.arctan2(pose[1, 0], pose[0, 0])
        poses[index, :2, :2] = [[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]]
        poses[index, :3, 3] = pose[0, 3], pose[1, 3], REAR_AXLE_HEIGHT
    rig = log.rig if (folder / "calibration").is_dir() else None
    return LoggedDrive(vector_map_of(archive), Trajectory(log.timestamps.copy(), poses), rig, log)
