"""True lines and poses of the Argoverse 2 logs among the reference fixtures, for simulated drives."""

from __future__ import annotations

import json
import os
from pathlib import Path

import numpy as np
import pyarrow.feather as feather
import shapely
import shapely.ops

from mapfusion.arrays import Float
from mapfusion.elements import GlobalMap
from tests.mapfusion.simulation import BOUNDARY, CROSSING, DIVIDER, Detector, Drive, element, pose, simulate

PROJECT = Path(__file__).parents[2]
LOGS = (
    Path(os.environ.get("PREDMAPNET_REFERENCE", PROJECT.parent / "shared" / "reference" / "public"))
    / "ground_truth/av2/logs"
)


def log_drive(log: Path, seed: int, frames: int = 40, detector: Detector | None = None) -> Drive:
    """Return a simulated drive of 40 frames at 2 Hz (or as many as the log has) over the log's real lines."""
    return simulate(log_map(log), log_poses(log, frames), np.random.default_rng(seed), detector)


def log_poses(log: Path, frames: int = 40) -> list[Float]:
    """Return the poses of a log at 2 Hz, flat on the ground."""
    table = feather.read_table(log / "city_SE3_egovehicle.feather").sort_by("timestamp_ns")
    stamps = table["timestamp_ns"].to_numpy()
    values = np.stack([table[name].to_numpy() for name in ("qw", "qx", "qy", "qz", "tx_m", "ty_m")], axis=1)
    wanted = np.arange(stamps[0], stamps[-1], 500_000_000)[:frames]
    return [
        pose(x, y, float(np.arctan2(2 * (qw * qz + qx * qy), 1 - 2 * (qy * qy + qz * qz))))
        for qw, qx, qy, qz, x, y in values[np.searchsorted(stamps, wanted)]
    ]


def log_map(log: Path) -> GlobalMap:
    """Return the true map of a log, see :func:`true_map`."""
    return true_map(next((log / "map").glob("log_map_archive_*.json")))


def true_map(path: Path) -> GlobalMap:
    """Return lane boundaries outside junctions, outlines of the drivable area, and crossings."""
    document = json.loads(path.read_text())
    xy = lambda points: np.array([[p["x"], p["y"]] for p in points])  # noqa: E731
    area = shapely.union_all([shapely.Polygon(xy(a["area_boundary"])) for a in document["drivable_areas"].values()])
    edges = [
        np.round(xy(lane[side]), 2)
        for lane in document["lane_segments"].values()
        for side in ("left_lane_boundary", "right_lane_boundary")
        if not lane["is_intersection"]
    ]
    lanes = shapely.line_merge(shapely.union_all([shapely.LineString(edge) for edge in edges]))
    painted = shapely.line_merge(shapely.difference(lanes, shapely.boundary(area).buffer(1.0)))
    elements = [
        element(DIVIDER, shapely.get_coordinates(line)) for line in shapely.get_parts(painted) if line.length > 3
    ]
    for polygon in shapely.get_parts(area):
        elements.extend(
            element(BOUNDARY, shapely.get_coordinates(ring)) for ring in (polygon.exterior, *polygon.interiors)
        )
    for crossing in document["pedestrian_crossings"].values():
        first, second = xy(crossing["edge1"]), xy(crossing["edge2"])
        corners = np.concatenate([first, second[::-1], first[:1]])
        if shapely.Polygon(corners).is_valid:
            elements.append(element(CROSSING, corners))
    return GlobalMap(tuple(elements))
