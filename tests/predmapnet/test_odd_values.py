"""Values that no writer of ours leaves, found by mutating files: each is told with its file, and none is taken."""

import json

import pytest

from predmapnet.errors import UserError
from tests.fuzzing.readers import READERS

HUGE, DEEP = "9" * 400, "[" * 200 + "]" * 200


@pytest.mark.parametrize(
    ("reader", "file", "old", "new", "message"),
    [
        ("nuscenes", "demo_world.json", "7", "-1", "no town -1"),
        ("nuscenes", "demo_world.json", "7", "null", "'town_seed' is missing"),
        ("nuscenes", "sample.json", "1500000000000000", "1" * 19, "'timestamp'|too large|time of frame"),
        ("nuscenes", "ego_pose.json", "500.0", HUGE, "pose needs|translation"),
        ("nuscenes", "/sensor.json", "sensor-CAM_BACK_LEFT", "sensor-CAM_BACK", "records have the token"),
        ("nuscenes", "calibrated_sensor.json", "sensor-CAM_BACK_LEFT", "sensor-CAM_BACK", "two key frames of CAM_BACK"),
        ("nuscenes", "singapore-onenorth.json", '"x": 400.0', '"x": 1e12', "more than 1e"),
        ("nuscenes", "singapore-onenorth.json", '"x": 400.0', f'"x": {HUGE}', "OverflowError"),
        ("argoverse2", "MIA_city_1.json", '"x": 0', '"x": 1e300', "more than 1e"),
        ("log", "calibration.json", '"fx": 40.0', f'"fx": {DEEP}', "more than 100 deep"),
        ("log", "calibration.json", '"fx": 40.0', '"fx": 4000.0', "differ as those of no camera"),
        ("log", "calibration.json", '"left"', '"front"', "the name front twice"),
        ("log", "truth.json", '"divider"', "[]", "'kind'"),
        ("log", "truth.json", "-10.0", HUGE, "'points'"),
        ("log", "truth.json", "-10.0", "1e300", "at most 1e"),
        ("log", "georeference.json", "49.0", HUGE, "'latitude'"),
        ("log", "poses.csv", "x,y", "x,x", "two columns x"),
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
        ("configuration", "lite.json", '"roi_length":60.0', '"roi_length":Infinity', "roi_length"),
        ("configuration", "lite.json", '"decoder":{', '"quirks":[1],"decoder":{', "quirks"),
        ("configuration", "network.json", '"rows": 3', f'"rows": {DEEP}', "more than 100 deep"),
        ("training-run", "position.json", '"step": 3', '"step": "three"', "step"),
        ("training-run", "position.json", '"step": 3', '"step": -3', "below zero"),
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
