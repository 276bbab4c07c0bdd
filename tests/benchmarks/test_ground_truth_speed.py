"""Milliseconds per frame of ground truth, as ratios to what the official code took on the same maps and poses.

pytest -m benchmark_only -s tests/benchmarks/test_ground_truth_speed.py
"""

import json
import os
import time
from pathlib import Path

import pytest

from mapfusion.elements import RegionOfInterest
from predmapnet.datasets.argoverse2 import Argoverse2Source
from predmapnet.datasets.ground_truth.argoverse2 import Argoverse2GroundTruth
from predmapnet.datasets.ground_truth.nuscenes import NuScenesGroundTruth
from predmapnet.datasets.poses import pose_matrix

pytestmark = [pytest.mark.benchmark_only, pytest.mark.reference]

PROJECT = Path(__file__).resolve().parents[2]
REFERENCE = Path(os.environ.get("PREDMAPNET_REFERENCE", PROJECT.parent / "shared" / "reference" / "public"))
FOLDER = REFERENCE / "ground_truth"


def cases():
    """Yield name, a function that makes the ground truth anew, poses, the stored case, and the ratio to reach."""
    for path in sorted((FOLDER / "nuscenes" / "gt").glob("*.gt*.json")):
        case = json.loads(path.read_text())
        map_file = next((FOLDER / "nuscenes" / "maps" / "expansion").glob("*.json"))
        poses = [
            pose_matrix(frame["e2g_rotation"], frame["e2g_translation"], path.name)
            @ pose_matrix(frame["lidar2ego_rotation"], frame["lidar2ego_translation"], path.name)
            for frame in case["frames"]
        ]
        yield path.name, lambda file=map_file: NuScenesGroundTruth(file), poses, case, 5.0
    if (FOLDER / "av2" / "logs").is_dir():
        source = Argoverse2Source(FOLDER / "av2" / "logs")
        for path in sorted((FOLDER / "av2" / "gt").glob("*.gt*.json")):
            case = json.loads(path.read_text())
            scene = source.open(case["log_id"])
            map_file = next((FOLDER / "av2" / "logs" / case["log_id"] / "map").glob("log_map_archive_*.json"))
            poses = [scene.pose(index) for index in range(len(scene))]
            yield path.name, lambda file=map_file: Argoverse2GroundTruth(file), poses, case, 10.0


def test_faster_than_the_official_code():
    """Reading the map is counted in: each case starts from the file."""
    if not any(FOLDER.glob("*/gt/*.gt*.json")):
        pytest.skip(f"no ground-truth fixtures in {FOLDER}: set PREDMAPNET_REFERENCE")
    print()
    too_slow = []
    for name, make, poses, case, wanted in cases():
        roi = RegionOfInterest(*case["roi_size"])
        start = time.process_time()
        truth = make()
        for pose in poses:
            truth.frame(pose, roi)
        milliseconds = (time.process_time() - start) / len(poses) * 1e3
        official = case["seconds_per_frame"]["mean"] * 1e3
        ratio = official / milliseconds
        print(f"{name[:52]:52s} {milliseconds:6.2f} ms/frame, official {official:6.1f} ms: {ratio:5.0f} times faster")
        if ratio < wanted:
            too_slow.append(f"{name}: {ratio:.1f} instead of {wanted}")
    assert not too_slow
