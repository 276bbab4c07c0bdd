"""Fixtures of the data set tests: the reference folder, and a small nuScenes data set made from nothing."""

import json
import os
from pathlib import Path

import cv2
import numpy as np
import pytest

PROJECT = Path(__file__).resolve().parents[3]
CAMERAS = ("CAM_FRONT", "CAM_FRONT_RIGHT", "CAM_FRONT_LEFT", "CAM_BACK", "CAM_BACK_LEFT", "CAM_BACK_RIGHT")


@pytest.fixture(scope="session")
def reference():
    """A function that gives a path in the reference folder, and skips the test where it is absent."""

    def find(*parts: str) -> Path:
        root = Path(os.environ.get("PREDMAPNET_REFERENCE", PROJECT.parent / "shared" / "reference" / "public"))
        path = root.joinpath(*parts)
        if not path.exists():
            pytest.skip(f"no reference fixtures at {path}: set PREDMAPNET_REFERENCE to their folder")
        return path

    return find


def square(x, y, width, height):
    return [(x, y), (x + width, y), (x + width, y + height), (x, y + height)]


def map_expansion():
    """A straight road along x with two lanes, one divider, one crossing and a kerbed island beside it."""
    content = {name: [] for name in ("node", "line", "polygon", "road_segment", "lane", "ped_crossing")}
    content |= {"version": "1.3", "road_divider": [], "lane_divider": []}

    def nodes(points):
        tokens = [f"n{len(content['node']) + number}" for number in range(len(points))]
        content["node"] += [{"token": token, "x": x, "y": y} for token, (x, y) in zip(tokens, points, strict=True)]
        return tokens

    def polygon(layer, points):
        token = f"p{len(content['polygon'])}"
        content["polygon"].append({"token": token, "exterior_node_tokens": nodes(points), "holes": []})
        content[layer].append({"token": f"{layer}-{token}", "polygon_token": token})

    def line(layer, points):
        token = f"l{len(content['line'])}"
        content["line"].append({"token": token, "node_tokens": nodes(points)})
        content[layer].append({"token": f"{layer}-{token}", "line_token": token})

    polygon("road_segment", square(0, 0, 200, 8))
    polygon("lane", square(0, 0, 200, 4))
    polygon("lane", square(0, 4, 200, 4))
    polygon("ped_crossing", square(100, 0, 3, 8))
    line("road_divider", [(0, 4), (200, 4)])
    line("lane_divider", [(150, 2), (190, 2)])
    return content


def write_nuscenes(root, version="v1.0-mini", scenes=("scene-0061", "scene-0103"), frames=3):
    """Write a data set of straight drives at 5 m a frame along y = 4, with tiny images."""
    tables = {name: [] for name in ("scene", "log", "sample", "sample_data", "ego_pose", "calibrated_sensor", "sensor")}
    image = np.full((9, 16, 3), 128, dtype=np.uint8)
    for number, channel in enumerate((*CAMERAS, "LIDAR_TOP", "RADAR_FRONT")):
        camera = channel.startswith("CAM")
        intrinsics = [[10.0, 0, 8], [0, 10.0, 4.5], [0, 0, 1]] if camera else []
        tables["sensor"].append({"token": f"sensor{number}", "channel": channel, "modality": "camera"})
        tables["calibrated_sensor"].append(
            {
                "token": f"calibration{number}",
                "sensor_token": f"sensor{number}",
                "translation": [0.9, 0.0, 1.8] if channel == "LIDAR_TOP" else [1.0, 0.1 * number, 1.5],
                # The lidar's x axis points to the right of the car.
                "rotation": [0.5**0.5, 0, 0, -(0.5**0.5)] if channel == "LIDAR_TOP" else [0.5, -0.5, 0.5, -0.5],
                "camera_intrinsic": intrinsics,
            }
        )
    for scene in scenes:
        log = f"log-{scene}"
        tables["log"].append({"token": log, "location": "singapore-onenorth", "logfile": scene})
        samples = [f"{scene}-{frame}" for frame in range(frames)]
        tables["scene"].append(
            {"token": scene, "name": scene, "log_token": log, "nbr_samples": frames, "description": "a drive"}
            | {"first_sample_token": samples[0], "last_sample_token": samples[-1]}
        )
        for frame, sample in enumerate(samples):
            time = 1_500_000_000_000_000 + 500_000 * frame
            after = samples[frame + 1] if frame + 1 < frames else ""
            tables["sample"].append({"token": sample, "timestamp": time, "next": after, "scene_token": scene})
            for number, channel in enumerate((*CAMERAS, "LIDAR_TOP", "RADAR_FRONT")):
                for key_frame in (True, False):
                    token = f"{sample}-{channel}-{key_frame}"
                    name = f"samples/{channel}/{token}.jpg"
                    tables["sample_data"].append(
                        {"token": token, "sample_token": sample, "ego_pose_token": token, "timestamp": time}
                        | {"calibrated_sensor_token": f"calibration{number}", "is_key_frame": key_frame}
                        | {"width": 16, "height": 9, "filename": name}
                    )
                    position = [80.0 + 5 * frame, 4.0, 0.0]
                    tables["ego_pose"].append({"token": token, "rotation": [1.0, 0, 0, 0], "translation": position})
                    if key_frame and channel in CAMERAS:
                        (root / name).parent.mkdir(parents=True, exist_ok=True)
                        cv2.imwrite(str(root / name), image)
    (root / version).mkdir(parents=True)
    for name, records in tables.items():
        (root / version / f"{name}.json").write_text(json.dumps(records, indent=0))
    (root / "maps" / "expansion").mkdir(parents=True, exist_ok=True)
    (root / "maps" / "expansion" / "singapore-onenorth.json").write_text(json.dumps(map_expansion()))
    return root


@pytest.fixture
def nuscenes_root(tmp_path):
    return write_nuscenes(tmp_path / "nuscenes")


@pytest.fixture
def write_nuscenes_data():
    return write_nuscenes


@pytest.fixture
def small_map():
    return map_expansion()
