"""The real street among the fixtures: real photographs, and lines traced from labelled lidar."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import shapely
from numpy.typing import NDArray

from mapfusion.elements import ElementKind, GlobalMap, MapElement, RegionOfInterest
from mapfusion.geometry import inverse_pose, transform_points
from predmapnet.scenes import FrameTruth
from tests.real_roads.log_folder import LogScene, Poses, Truth, read_poses

Float = NDArray[np.float64]

SHORTEST = 1.0
"""Pieces of a true line in the region that are shorter are left out, metres."""


def open_street(folder: Path, own_instants: bool = True) -> LogScene:
    """Open the street as a scene with its truth."""
    poses = read_poses(folder / "poses.csv")
    return LogScene(folder, truth_of_lines(read_lines(folder / "truth.json"), poses), own_instants)


def read_lines(path: Path) -> list[tuple[ElementKind, Float]]:
    """Read the true lines, global frame."""
    kinds = {kind.label: kind for kind in ElementKind}
    return [
        (kinds[element["kind"]], np.array(element["points"], dtype=np.float64))
        for element in json.loads(path.read_text())["elements"]
    ]


def truth_of_lines(lines: list[tuple[ElementKind, Float]], poses: Poses) -> Truth:
    """Return lines of the global frame as the truth of a drive: cut by the region, in the ego frame."""

    def frame(index: int, roi: RegionOfInterest) -> FrameTruth:
        global_to_ego = inverse_pose(poses.ego_to_global[index])
        region = shapely.box(*(-roi.size / 2), *(roi.size / 2))
        kinds, pieces, rows = [], [], []
        for row, (kind, points) in enumerate(lines):
            inside = shapely.intersection(shapely.LineString(transform_points(global_to_ego, points)), region)
            for part in shapely.get_parts(inside):
                if part.geom_type == "LineString" and part.length >= SHORTEST:
                    kinds.append(kind)
                    pieces.append(shapely.get_coordinates(part))
                    rows.append(row)
        return FrameTruth(np.array(kinds, dtype=np.int64), tuple(pieces), np.array(rows, dtype=np.int64))

    def whole() -> GlobalMap:
        first, last = int(poses.timestamps[0]), int(poses.timestamps[-1])
        elements = (MapElement(kind, points, 1.0, len(poses.timestamps), first, last) for kind, points in lines)
        return GlobalMap(tuple(elements), {"ground_truth": True})

    return Truth(frame, whole)
