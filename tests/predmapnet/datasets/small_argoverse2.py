"""An Argoverse 2 log of a car that stands on a straight road, made from nothing."""

import json

import cv2
import numpy as np
import pyarrow
from pyarrow import feather

from predmapnet.datasets.argoverse2_files import ARGOVERSE2_CAMERAS as CAMERAS

SWEEP = 100_000_000
START = 315_966_000_000_000_000


def point(x, y):
    return {"x": x, "y": y, "z": 10.0}


def lane(number, low, high, **neighbours):
    return {
        "id": number,
        "is_intersection": False,
        "lane_type": "VEHICLE",
        "left_lane_boundary": [point(0, high), point(200, high)],
        "right_lane_boundary": [point(0, low), point(200, low)],
        "left_lane_mark_type": "NONE",
        "right_lane_mark_type": "NONE",
        "successors": [],
        "predecessors": [],
        "left_neighbor_id": neighbours.get("left"),
        "right_neighbor_id": neighbours.get("right"),
    }


def write_log(folder, sweeps=9):
    """A car that stands at x = 50 of a straight road of two lanes, each 4 m wide."""
    times = [START + SWEEP * number for number in range(sweeps)]
    folder.mkdir(parents=True)
    ones, zeros = np.ones(sweeps), np.zeros(sweeps)
    poses = {"timestamp_ns": times, "qw": ones, "qx": zeros, "qy": zeros, "qz": zeros}
    poses |= {"tx_m": 50 * ones, "ty_m": 4 * ones, "tz_m": 10 * ones}
    feather.write_feather(pyarrow.table(poses), folder / "city_SE3_egovehicle.feather")
    (folder / "calibration").mkdir()
    count = len(CAMERAS)
    intrinsics = {"sensor_name": CAMERAS, "fx_px": [10.0] * count, "fy_px": [11.0] * count, "cx_px": [8.0] * count}
    intrinsics |= {"cy_px": [4.0] * count, "height_px": [9] * count, "width_px": [16] * count}
    feather.write_feather(pyarrow.table(intrinsics), folder / "calibration" / "intrinsics.feather")
    mounting = {"sensor_name": CAMERAS, "qw": [1.0] * count, "qx": [0.0] * count, "qy": [0.0] * count}
    mounting |= {"qz": [0.0] * count, "tx_m": [1.5] * count, "ty_m": [0.0] * count, "tz_m": [1.4] * count}
    feather.write_feather(pyarrow.table(mounting), folder / "calibration" / "egovehicle_SE3_sensor.feather")
    (folder / "sensors" / "lidar").mkdir(parents=True)
    for time in times:
        (folder / "sensors" / "lidar" / f"{time}.feather").touch()
        for camera in CAMERAS:
            image = folder / "sensors" / "cameras" / camera / f"{time + 20_000_000}.jpg"
            image.parent.mkdir(parents=True, exist_ok=True)
            cv2.imwrite(str(image), np.zeros((9, 16, 3), dtype=np.uint8))
    content = {
        "lane_segments": {"1": lane(1, 0, 4, left=2), "2": lane(2, 4, 8, right=1)},
        "pedestrian_crossings": {
            "7": {"id": 7, "edge1": [point(60, 0), point(60, 8)], "edge2": [point(63, 0), point(63, 8)]}
        },
        "drivable_areas": {"9": {"id": 9, "area_boundary": [point(0, 0), point(200, 0), point(200, 8), point(0, 8)]}},
    }
    (folder / "map").mkdir()
    (folder / "map" / f"log_map_archive_{folder.name}____MIA_city_1.json").write_text(json.dumps(content))
    return folder
