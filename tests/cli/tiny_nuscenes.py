"""A nuScenes data set of a few frames with small images, written in a fraction of a second."""

import json
import math
from pathlib import Path
from typing import Any

import cv2
import numpy as np

CAMERAS = {
    "CAM_FRONT": 0.0,
    "CAM_FRONT_RIGHT": -55.0,
    "CAM_FRONT_LEFT": 55.0,
    "CAM_BACK": 180.0,
    "CAM_BACK_LEFT": 110.0,
    "CAM_BACK_RIGHT": -110.0,
}
WIDTH, HEIGHT = 256, 144
LIDAR_YAW = [math.sqrt(0.5), 0.0, 0.0, -math.sqrt(0.5)]
"""The lidar of nuScenes is mounted with x to the right."""
STEP_METRES = 4.0
START_TIME = 1_500_000_000_000_000
LOCATION = "singapore-onenorth"
"""The only names that the reader can place on Earth are those of the real maps."""
Record = dict[str, Any]

EMPTY_LAYERS = (
    "drivable_area",
    "road_block",
    "lane",
    "lane_connector",
    "ped_crossing",
    "walkway",
    "stop_line",
    "carpark_area",
    "lane_divider",
    "traffic_light",
    "arcline_path_3",
    "connectivity",
)


def write_tiny_nuscenes(root: Path, scenes: tuple[str, ...] = ("scene-0001",), frames: int = 3) -> Path:
    """Write tables, images of noise and stripes, and a map with one straight road."""
    names = ("scene", "sample", "sample_data", "ego_pose", "calibrated_sensor", "sensor", "log", "map")
    tables: dict[str, list[Record]] = {name: [] for name in names}
    log = {"token": "log", "logfile": "n015", "vehicle": "n015", "date_captured": "2018-07-24", "location": LOCATION}
    tables["log"].append(log)
    tables["map"].append({"token": "map", "log_tokens": ["log"], "category": "semantic_prior", "filename": ""})
    for channel in (*CAMERAS, "LIDAR_TOP"):
        modality = "lidar" if channel == "LIDAR_TOP" else "camera"
        tables["sensor"].append({"token": f"sensor-{channel}", "channel": channel, "modality": modality})
        tables["calibrated_sensor"].append(_calibration(channel))
    for number, scene in enumerate(scenes):
        tokens = [f"{scene}-{index}" for index in range(frames)]
        tables["scene"].append(
            {
                "token": scene,
                "name": scene,
                "log_token": "log",
                "nbr_samples": frames,
                "first_sample_token": tokens[0],
                "last_sample_token": tokens[-1],
                "description": "a straight road",
            }
        )
        for index, token in enumerate(tokens):
            _write_frame(root, tables, scene, token, tokens, index, number)
    folder = root / "v1.0-mini"
    folder.mkdir(parents=True)
    for name, records in tables.items():
        (folder / f"{name}.json").write_text(json.dumps(records, indent=0))
    _write_map(root)
    return root


def image_path(root: Path, scene: str, index: int, camera: str) -> Path:
    """Where the image of one frame lies."""
    return root / "samples" / camera / f"{scene}-{index}.jpg"


def edit_table(root: Path, name: str, change) -> None:
    """Load a table, let ``change(records)`` alter it, write it back (NaN allowed, as other tools write it)."""
    path = root / "v1.0-mini" / f"{name}.json"
    records = json.loads(path.read_text())
    change(records)
    path.write_text(json.dumps(records, indent=0))


def _calibration(channel: str) -> Record:
    record = {"token": f"calibration-{channel}", "sensor_token": f"sensor-{channel}"}
    if channel == "LIDAR_TOP":
        return record | {"translation": [0.9, 0.0, 1.8], "rotation": LIDAR_YAW, "camera_intrinsic": []}
    # The camera frame is x right, y down, z forward: half turns about -x and z, then the yaw.
    yaw = math.radians(CAMERAS[channel])
    forward = (0.5, -0.5, 0.5, -0.5)
    rotation = _multiply((math.cos(yaw / 2), 0.0, 0.0, math.sin(yaw / 2)), forward)
    intrinsics = [[200.0, 0.0, WIDTH / 2], [0.0, 200.0, HEIGHT / 2], [0.0, 0.0, 1.0]]
    place = [1.0 + 0.5 * math.cos(yaw), 0.5 * math.sin(yaw), 1.5]
    return record | {"translation": place, "rotation": list(rotation), "camera_intrinsic": intrinsics}


def _multiply(first: tuple[float, ...], second: tuple[float, ...]) -> tuple[float, ...]:
    a, b, c, d = first
    e, f, g, h = second
    return (
        a * e - b * f - c * g - d * h,
        a * f + b * e + c * h - d * g,
        a * g - b * h + c * e + d * f,
        a * h + b * g - c * f + d * e,
    )


def _write_frame(
    root: Path, tables: dict[str, list[Record]], scene: str, token: str, tokens: list[str], index: int, number: int
) -> None:
    timestamp = START_TIME + index * 500_000
    before, after = (["", *tokens])[index], ([*tokens, ""])[index + 1]
    tables["sample"].append(
        {"token": token, "timestamp": timestamp, "prev": before, "next": after, "scene_token": scene}
    )
    position = [500.0 + STEP_METRES * index, 500.0 + 100.0 * number, 0.0]
    pose = {"token": f"pose-{token}", "timestamp": timestamp, "rotation": [1.0, 0.0, 0.0, 0.0], "translation": position}
    tables["ego_pose"].append(pose)
    random = np.random.default_rng(1000 * number + index)
    for channel in (*CAMERAS, "LIDAR_TOP"):
        path = image_path(root, scene, index, channel)
        tables["sample_data"].append(
            {
                "token": f"data-{token}-{channel}",
                "sample_token": token,
                "ego_pose_token": pose["token"],
                "calibrated_sensor_token": f"calibration-{channel}",
                "timestamp": timestamp,
                "fileformat": "jpg",
                "is_key_frame": True,
                "width": WIDTH,
                "height": HEIGHT,
                "filename": str(path.relative_to(root)),
                "prev": "",
                "next": "",
            }
        )
        if channel != "LIDAR_TOP":
            path.parent.mkdir(parents=True, exist_ok=True)
            image = random.integers(60, 110, (HEIGHT, WIDTH, 3), dtype=np.uint8)
            cv2.line(image, (WIDTH // 2, HEIGHT // 2), (WIDTH // 4 + 9 * index, HEIGHT), (240, 240, 240), 3)
            cv2.imwrite(str(path), image)


def _write_map(root: Path) -> None:
    """One road along x with a divider in the middle of it, in the schema of the map expansion."""
    corners = [(400.0, 490.0), (700.0, 490.0), (700.0, 510.0), (400.0, 510.0)]
    points = [*corners, (400.0, 500.0), (700.0, 500.0)]
    nodes = [{"token": f"node-{i}", "x": x, "y": y} for i, (x, y) in enumerate(points)]
    polygon = {"token": "polygon", "exterior_node_tokens": [f"node-{i}" for i in range(4)], "holes": []}
    document: dict[str, object] = {layer: [] for layer in EMPTY_LAYERS}
    document |= {
        "version": "1.3",
        "canvas_edge": [1585.6, 2025.0],
        "node": nodes,
        "polygon": [polygon],
        "line": [{"token": "line", "node_tokens": ["node-4", "node-5"]}],
        "road_segment": [
            {"token": "segment", "polygon_token": "polygon", "is_intersection": False, "drivable_area_token": ""}
        ],
        "road_divider": [{"token": "divider", "line_token": "line", "road_segment_token": None}],
    }
    folder = root / "maps" / "expansion"
    folder.mkdir(parents=True)
    (folder / f"{LOCATION}.json").write_text(json.dumps(document))
