"""Values that no writer of ours leaves, found by mutating files: each is told with its file, and none is taken."""

import json
import shutil

import numpy as np
import pytest

from mapfusion import RegionOfInterest
from predmapnet.datasets.argoverse2 import Argoverse2Source
from predmapnet.datasets.ground_truth.argoverse2 import Argoverse2GroundTruth
from predmapnet.datasets.ground_truth.nuscenes import NuScenesGroundTruth
from predmapnet.datasets.own_logs.source import LogSource
from predmapnet.errors import UserError
from predmapnet.frame_files.pose_file import read_poses
from tests.fuzzing.readers import READERS
from tests.predmapnet.datasets.conftest import map_expansion

HUGE, DEEP = "9" * 400, "[" * 200 + "]" * 200


@pytest.mark.parametrize(
    ("reader", "file", "old", "new", "message"),
    [
        ("nuscenes", "demo_world.json", "7", "-1", "from 0 on"),
        ("nuscenes", "demo_world.json", "7", "null", "'town_seed' is missing"),
        ("nuscenes", "scene.json", '"nbr_samples": 2', '"nbr_samples": -1', "from 0 on"),
        ("nuscenes", "sample.json", "1500000000000000", "1" * 19, "'timestamp'|too large|time of frame"),
        ("nuscenes", "ego_pose.json", "500.0", HUGE, "pose needs|translation"),
        ("nuscenes", "/sensor.json", "sensor-CAM_BACK_LEFT", "sensor-CAM_BACK", "records have the token"),
        ("nuscenes", "calibrated_sensor.json", "sensor-CAM_BACK_LEFT", "sensor-CAM_BACK", "two key frames of CAM_BACK"),
        ("nuscenes", "singapore-onenorth.json", '"x": 400.0', '"x": 1e12', "more than 1e"),
        ("nuscenes", "singapore-onenorth.json", '"x": 400.0', f'"x": {HUGE}', "OverflowError"),
        ("argoverse2", "MIA_city_1.json", '"x": 0', '"x": 1e300', "more than 1e"),
        ("argoverse2", "MIA_city_1.json", '"id": 1', '"id": []', "has ids that are none"),
        ("log", "calibration.json", '"fx": 40.0', f'"fx": {DEEP}', "more than 100 deep"),
        ("log", "calibration.json", '"fx": 40.0', '"fx": 4000.0', "differ as those of no camera"),
        ("log", "calibration.json", '"left"', '"front"', "the name front twice"),
        ("log", "truth.json", '"divider"', "[]", "'kind'"),
        ("log", "truth.json", "-10.0", HUGE, "'points'"),
        ("log", "truth.json", "-10.0", "1e300", "at most 1e"),
        ("log", "georeference.json", "49.0", HUGE, "'latitude'"),
        ("log", "poses.csv", "x,y", "x,x", "two columns x"),
        ("log", "calibration.json", "1.2", "1200", "is that in millimetres"),
        ("nuscenes", "singapore-onenorth.json", '"token": "node-1"', '"token": "node-0"', "node-0 lies in two places"),
        ("poses", "poses.txt", "1500000000.000000 ", "²²²²²²²²²²²²²²²² ", "no number"),
        ("poses", "poses.txt", "1500000000.500000 2.0", "1500000000.500000 1e200", "not a rigid motion"),
        ("poses", "list.json", "2.0", HUGE, "pose needs"),
        ("poses", "matrices.json", "2.0", HUGE, "too large|int too"),
        ("poses", "matrices.json", '"t1"', '"t0"', "the name t0 twice"),
        ("results", "maptr.json", '"cls_name": "divider", "type": 0', '"type": []', "labels"),
        ("results", "superfusion.json", '"t1"', '"t0"', "the name t0 twice"),
        ("results", "streammapnet.json", '"labels": [1', '"labels": [[1, 2]', "labels are no list"),
        ("results", "streammapnet.json", '"scores": [0.9', f'"scores": [{HUGE}', "scores are not numbers"),
        ("results", "maptracker.json", '"global_ids": [3', '"global_ids": [9007199254740993', "whole numbers"),
        ("configuration", "lite.json", '"layers":2', '"layers":1000000000', "semantic_queries.layers"),
        ("configuration", "paper-nuscenes.json", '"width":32', '"width":2147483648', "less than or equal"),
        ("configuration", "lite.json", '"roi_length":60.0', '"roi_length":Infinity', "roi_length"),
        ("configuration", "lite.json", '"decoder":{', '"quirks":[1],"decoder":{', "quirks"),
        ("configuration", "network.json", '"rows": 3', f'"rows": {DEEP}', "more than 100 deep"),
        ("training-run", "position.json", '"step": 3', '"step": "three"', "step"),
        ("training-run", "position.json", '"step": 3', '"step": -3', "below zero"),
        ("training-run", "position.json", '"total_seconds": 0.0', '"total_seconds": -1', "below zero"),
        ("configuration", "lite.json", '"roi_length":60.0', '"roi_length":1e9', "roi_length"),
        ("evaluations", "one.json", '"warnings": ["a note"]', '"warnings": [[]]', "must be texts"),
        ("evaluations", "one.json", '"mAP": 0.5', '"mAP": "high"', "mAP of chamfer_ap is no number"),
        ("evaluations", "one.json", '"scene-1": {', '"scene-1": [], "scene-3": {', "scene-1 is no number"),
    ],
)
def test_an_odd_value_is_told_with_its_file(tmp_path, reader, file, old, new, message):
    files = READERS[reader].write(tmp_path)
    for path in (path for path in files if str(path).endswith(file)):
        text = path.read_text()
        if old in text:
            path.write_text(text.replace(old, new, 1))
            break
    else:
        raise AssertionError(f"no {file} holds {old}")
    with pytest.raises(UserError, match=message) as told:
        READERS[reader].read(tmp_path, path)
    assert len(str(told.value)) < 1000


def test_summaries_of_other_programs_are_no_records_of_a_batch(tmp_path):
    READERS["records"].write(tmp_path)
    for number, content in enumerate(([], {"scene": "x"}, {"scene": "x", "report": {"frames": "many"}})):
        (tmp_path / f"other{number}.summary.json").write_text(json.dumps(content))
    READERS["records"].read(tmp_path, tmp_path)
    assert [scene["scene"] for scene in json.loads((tmp_path / "summary.json").read_text())["scenes"]] == ["a", "b"]


def test_two_logs_of_one_name_are_told_apart(tmp_path):
    for reader, source in (("log", LogSource), ("argoverse2", Argoverse2Source)):
        (tmp_path / reader).mkdir()
        READERS[reader].write(tmp_path / reader)
        logs = tmp_path / reader / "logs"
        shutil.copytree(logs / "log", logs / "val" / "log")
        opened = source(logs)
        assert [(info.name, info.split) for info in opened.scenes()] == [("log", "test"), ("log (2)", "val")]
        assert opened.open("log (2)").info.name == "log (2)"


def test_what_encloses_nothing_does_not_refuse_a_whole_map():
    """A hole of two nodes, a lane with one point on a side, a crossing of two points."""
    nuscenes = map_expansion()
    nuscenes["polygon"][0]["holes"] = [{"node_tokens": ["n0", "n1"]}, {"node_tokens": ["n0"]}]
    assert len(NuScenesGroundTruth(nuscenes).road_segments) == 1
    point = {"x": 0.0, "y": 0.0, "z": 0.0}
    lane = {"id": 1, "is_intersection": False, "left_lane_boundary": [point], "right_lane_boundary": [point]}
    lane |= {"left_neighbor_id": 2, "right_neighbor_id": 2, "predecessors": [], "successors": []}
    crossing = {"edge1": [point], "edge2": [point]}
    argoverse2 = {"lane_segments": {"1": lane}, "pedestrian_crossings": {"1": crossing}, "drivable_areas": {}}
    truth = Argoverse2GroundTruth(argoverse2).frame(np.eye(4), RegionOfInterest())
    assert len(truth.kinds) == 0


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"scores": [90.0, 80.0]}, "most scores lie outside of 0 to 1"),
        ({"vectors": [[[-0.5, 0.1], [0.5, 0.1]]] * 2}, "all points lie between -1 and 1"),
    ],
)
def test_results_on_other_scales_give_no_empty_map(tmp_path, changes, message):
    READERS["results"].write(tmp_path)
    path = tmp_path / "maptracker.json"
    frames = json.loads(path.read_text())["results"]
    results = {f"t{number}": {**frames["t0"], **changes} for number in range(6)}
    path.write_text(json.dumps({"results": results}))
    poses = json.loads((tmp_path / "poses.json").read_text())
    more = [{**poses[0], "token": f"t{n}", "timestamp": poses[0]["timestamp"] + n * 10**8} for n in range(6)]
    (tmp_path / "poses.json").write_text(json.dumps(more))
    with pytest.raises(UserError, match=message):
        READERS["results"].read(tmp_path, path)


def test_a_pose_with_rows_and_columns_exchanged_is_refused(tmp_path):
    READERS["poses"].write(tmp_path)
    path = tmp_path / "matrices.json"
    poses = json.loads(path.read_text())
    for pose in poses.values():
        pose["ego_to_global"] = np.array(pose["ego_to_global"]).T.tolist()
    path.write_text(json.dumps(poses))
    with pytest.raises(UserError, match="rows and columns exchanged"):
        read_poses(path)


def test_a_scene_without_a_figure_is_no_fault_of_the_report(tmp_path):
    """JSON has no NaN: what could not be measured is null in a record."""
    (path, _) = READERS["records"].write(tmp_path)
    path.write_text(path.read_text().replace('"mean_ap": 0.4', '"mean_ap": null'))
    READERS["records"].read(tmp_path, path)
