"""``predmapnet evaluate``: map and measure, measure what was written, and refuse what cannot be measured."""

import json
import pickle
from dataclasses import replace

import numpy as np
import pytest

from mapfusion.elements import FrameMap, RegionOfInterest
from predmapnet.datasets.nuscenes import NuScenesSource
from predmapnet.frame_files.parquet import StoredFrame, write_frames
from tests.cli.tiny_nuscenes import edit_table

ROI = RegionOfInterest()


def stored(maps, scene):
    return [StoredFrame(scene, index, "", frame_map) for index, frame_map in enumerate(maps)]


def truth_as_results(root, name):
    """Per-frame results that are the ground truth itself."""
    scene = NuScenesSource(root).open(name)
    maps = []
    for index in range(len(scene)):
        frame, truth = scene.frame(index), scene.truth(index, ROI)
        count = len(truth.kinds)
        maps.append(
            FrameMap(
                frame.timestamp,
                frame.ego_to_global,
                ROI,
                truth.kinds,
                np.linspace(0.9, 0.6, count),
                np.arange(count),
                truth.polylines,
            )
        )
    return scene, maps


def test_mapping_and_measuring_in_one_go(predmapnet, tiny_root, random_weights, tmp_path):
    figures, report = tmp_path / "figures.json", tmp_path / "report.html"
    arguments = ["evaluate", "--data-root", tiny_root, "--weights", random_weights]
    first = predmapnet(*arguments, "--json", figures, "--report", report)
    assert first.code == 0, first.err
    assert "chamfer AP" in first.out and "frames/s" in first.out
    content = json.loads(figures.read_text())
    assert content["scenes"] == 2 and content["evaluated"]["dataset"] == "nuscenes"
    assert content["stability"]["protocol"] == "anchored" and content["stability"]["interval"] == 2
    assert report.read_text().startswith("<!doctype html>")


def test_two_processes_measure_the_same(predmapnet, tiny_root, tmp_path):
    folder = tmp_path / "run"
    folder.mkdir()
    for name in ("scene-0001", "scene-0002"):
        write_frames(folder / f"{name}.parquet", stored(truth_as_results(tiny_root, name)[1], name), {})
    arguments = ["evaluate", folder, "--data-root", tiny_root]
    assert predmapnet(*arguments, "--json", tmp_path / "one.json").code == 0
    assert predmapnet(*arguments, "--json", tmp_path / "two.json", "--jobs", 2).code == 0
    assert (tmp_path / "one.json").read_bytes() == (tmp_path / "two.json").read_bytes()


def test_the_truth_as_results_is_perfect_in_parquet_and_as_a_submission(predmapnet, tiny_root, tmp_path):
    scene, maps = truth_as_results(tiny_root, "scene-0001")
    write_frames(tmp_path / "frames.parquet", stored(maps, "scene-0001"), {})
    entries = {
        scene.frame(index).token: {
            "vectors": [line.tolist() for line in frame_map.polylines],
            "scores": frame_map.scores.tolist(),
            "labels": frame_map.kinds.tolist(),
        }
        for index, frame_map in enumerate(maps)
    }
    (tmp_path / "submission.json").write_text(json.dumps({"meta": {}, "results": entries}))
    tracked = [
        entry | {"scene_name": "scene-0001", "local_idx": index, "global_ids": maps[index].track_ids.tolist()}
        for index, entry in enumerate(entries.values())
    ]
    (tmp_path / "pos_predictions.json").write_text(json.dumps(tracked))
    present = {kind for frame_map in maps for kind in frame_map.kinds.tolist()}
    for name in ("frames.parquet", "submission.json", "pos_predictions.json"):
        result = predmapnet("evaluate", tmp_path / name, "--data-root", tiny_root, "--json", tmp_path / "f.json")
        assert result.code == 0, result.err
        figures = json.loads((tmp_path / "f.json").read_text())
        assert figures["scenes"] == 1
        assert figures["consistency_ap"]["ids"] == ("formed" if name == "submission.json" else "tracker")
        assert figures["chamfer_ap"]["mAP"] == pytest.approx(len(present) / 3)
        assert figures["raster_ap"]["mAP"] == pytest.approx(1.0)
        assert figures["consistency_ap"]["mAP"] == pytest.approx(len(present) / 3)
        # Elements without ids are fused by where they lie, and the map of the drive is measured, too.
        assert figures["global_map"]["f1@1.0"] > 0.95
        assert figures["global_map_ap"] == {k: v for k, v in figures["place_map_ap"].items() if k != "places"}


def test_scenes_of_one_place_are_measured_as_one_map(predmapnet, tiny_root, tmp_path):
    """Both scenes pass the same road: together they are one map, which has each true element once."""

    def onto_the_same_road(poses):
        for pose in poses:
            x, y, z = pose["translation"]
            pose["translation"] = [x + 20.0, 500.0, z] if y == 600.0 else [x, y, z]

    edit_table(tiny_root, "ego_pose", onto_the_same_road)
    folder = tmp_path / "run"
    folder.mkdir()
    for name in ("scene-0001", "scene-0002"):
        write_frames(folder / f"{name}.parquet", stored(truth_as_results(tiny_root, name)[1], name), {})
    result = predmapnet("evaluate", folder, "--data-root", tiny_root, "--json", tmp_path / "f.json")
    assert result.code == 0, result.err
    assert "global AP, 1 place" in result.out and "global AP, single scenes" in result.out
    figures = json.loads((tmp_path / "f.json").read_text())
    single, across = figures["global_map_ap"]["boundary"], figures["place_map_ap"]["boundary"]
    assert figures["place_map_ap"]["places"] == 1
    assert (single["truths"], single["predictions"]) == (4, 4)
    assert (across["truths"], across["predictions"]) == (2, 2)
    assert across["AP"] == pytest.approx(1.0)


def test_the_new_split_measures_other_scenes(predmapnet, tiny_root, tmp_path):
    folder = tmp_path / "run"
    folder.mkdir()
    for name in ("scene-0001", "scene-0002"):
        write_frames(folder / f"{name}.parquet", stored(truth_as_results(tiny_root, name)[1], name), {})
    measured = {}
    for scheme in ("old", "new"):
        arguments = [
            "--data-root",
            tiny_root,
            "--split-scheme",
            scheme,
            "--split",
            "val",
            "--json",
            tmp_path / "f.json",
        ]
        result = predmapnet("evaluate", folder, *arguments)
        listed = json.loads(predmapnet("scenes", "--json", *arguments[:-2]).out)
        measured[scheme] = [scene["name"] for scene in listed]
        if measured[scheme]:
            assert result.code == 0, result.err
            assert json.loads((tmp_path / "f.json").read_text())["evaluated"]["scenes"] == measured[scheme]
    assert "scene-0001" in measured["new"] and measured["new"] != measured["old"]


def test_truth_is_kept_and_used_again(predmapnet, tiny_root, tmp_path):
    write_frames(tmp_path / "frames.parquet", stored(truth_as_results(tiny_root, "scene-0001")[1], "scene-0001"), {})
    arguments = ["evaluate", tmp_path / "frames.parquet", "--data-root", tiny_root, "--json"]
    assert predmapnet(*arguments, tmp_path / "none.json", "--no-truth-cache").code == 0
    assert not (tmp_path / "cache").exists()
    for name in ("first", "second"):
        assert predmapnet(*arguments, tmp_path / f"{name}.json").code == 0
        assert len(list((tmp_path / "cache" / "ground-truth").iterdir())) == 1
    contents = {(tmp_path / f"{name}.json").read_bytes() for name in ("none", "first", "second")}
    assert len(contents) == 1


def test_nan_in_a_submission_names_frame_and_element(predmapnet, tiny_root, tmp_path):
    scene, maps = truth_as_results(tiny_root, "scene-0001")
    vectors = [line.tolist() for line in maps[2].polylines]
    vectors[1][0][1] = float("nan")
    entry = {"vectors": vectors, "scores": maps[2].scores.tolist(), "labels": maps[2].kinds.tolist()}
    (tmp_path / "submission.json").write_text(json.dumps({"results": {scene.frame(2).token: entry}}))
    result = predmapnet("evaluate", tmp_path / "submission.json", "--data-root", tiny_root)
    assert result.code == 2 and "Scene scene-0001, frame 2, prediction 1" in " ".join(result.err.split()), result.err


def test_frames_of_another_data_set_are_named(predmapnet, tiny_root, tmp_path):
    entry = {"vectors": [], "scores": [], "labels": []}
    known = NuScenesSource(tiny_root).open("scene-0001").frame(0).token
    (tmp_path / "submission.json").write_text(json.dumps({"results": {known: entry, "elsewhere": entry}}))
    result = predmapnet("evaluate", tmp_path / "submission.json", "--data-root", tiny_root)
    assert result.code == 2 and "1 of 2 frames are not in nuscenes" in " ".join(result.err.split())
    assert "elsewhere" in result.err


def test_what_cannot_be_measured_is_said_in_one_message(predmapnet, tiny_root, tmp_path):
    pickled = tmp_path / "pos_predictions.pkl"
    pickled.write_bytes(pickle.dumps({}))
    empty = tmp_path / "empty"
    empty.mkdir()
    _, maps = truth_as_results(tiny_root, "scene-0001")
    write_frames(tmp_path / "other.parquet", stored(maps, "scene-9999"), {})
    for results, message in (
        (pickled, "pickle"),
        (empty, "--save-frames"),
        (tmp_path / "absent.parquet", "no file or folder"),
        (tmp_path / "other.parquet", "scene-9999"),
    ):
        result = predmapnet("evaluate", results, "--data-root", tiny_root, "--json", tmp_path / "f.json")
        assert result.code == 2 and message in result.err, result.err
        assert result.err.count("Error:") == 1
    assert not (tmp_path / "f.json").exists()
    result = predmapnet("evaluate", tmp_path / "other.parquet", "--data-root", tiny_root, "--roi", "100x50")
    assert result.code == 2 and "--roi is for submissions" in result.err


def test_mixtures_and_other_axes_are_refused(predmapnet, tiny_root, tmp_path):
    scene, maps = truth_as_results(tiny_root, "scene-0001")
    folder = tmp_path / "run"
    folder.mkdir()
    write_frames(folder / "scene-0001.parquet", stored(maps, "scene-0001"), {"weights_sha256": "a"})
    other = stored(truth_as_results(tiny_root, "scene-0002")[1], "scene-0002")
    write_frames(folder / "scene-0002.parquet", other, {"weights_sha256": "b"})
    write_frames(tmp_path / "foreign.parquet", stored(maps, "scene-0001"), {"dataset": "argoverse2"})
    wide = [replace(maps[0], roi=RegionOfInterest(100.0, 50.0)), *maps[1:]]
    write_frames(tmp_path / "regions.parquet", stored(wide, "scene-0001"), {})
    turned = [[[y, x] for x, y in np.array([[-28.0, -14.0], [0.0, 9.0], [29.0, 14.0]])] for _ in range(5)]
    entry = {"vectors": turned, "scores": [0.5] * 5, "labels": [1] * 5}
    (tmp_path / "turned.json").write_text(json.dumps({"results": {scene.frame(0).token: entry}}))
    for results, message in (
        (folder, "different weights"),
        (tmp_path / "foreign.parquet", "made of argoverse2, not of nuscenes"),
        (tmp_path / "regions.parquet", "mixes frames of 2 regions"),
        (tmp_path / "turned.json", "(x, y) becomes (y, -x)"),
    ):
        result = predmapnet("evaluate", results, "--data-root", tiny_root)
        assert result.code == 2 and message in " ".join(result.err.split()), result.err


def test_what_was_measured_and_what_is_missing_is_said_and_written(predmapnet, tiny_root, tmp_path):
    _, maps = truth_as_results(tiny_root, "scene-0001")
    write_frames(tmp_path / "frames.parquet", stored(maps, "scene-0001")[:-1], {})
    arguments = ["--data-root", tiny_root, "--json", tmp_path / "f.json", "--report", tmp_path / "r.html"]
    result = predmapnet("evaluate", tmp_path / "frames.parquet", *arguments)
    assert result.code == 0, result.err
    assert "1 of 2 scenes, 60 m x 30 m" in result.out
    assert f"1 of {len(maps)} frames are not in the results" in " ".join(result.err.split())
    content = json.loads((tmp_path / "f.json").read_text())
    evaluated = content["evaluated"]
    assert evaluated["roi_m"] == [60.0, 30.0] and evaluated["scenes_in_split"] == 2
    assert any("not comparable with all of them" in text for text in evaluated["warnings"])
    assert any("no forecasts" in text for text in evaluated["missing"])
    assert list(content["per_scene"]) == ["scene-0001"] and content["per_scene"]["scene-0001"]["frames"] == len(maps)
    assert "predmapnet evaluate" in (tmp_path / "r.html").read_text()
