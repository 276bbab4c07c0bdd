"""``predmapnet evaluate``: map and measure, measure what was written, and refuse what cannot be measured."""

import json
import pickle

import numpy as np
import pytest

from mapfusion.elements import FrameMap, RegionOfInterest
from predmapnet.datasets.nuscenes import NuScenesSource
from predmapnet.evaluation.frames_io import write_frames

ROI = RegionOfInterest()


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
    assert report.read_text().startswith("<!doctype html>")


def test_two_processes_measure_the_same(predmapnet, tiny_root, tmp_path):
    folder = tmp_path / "run"
    folder.mkdir()
    for name in ("scene-0001", "scene-0002"):
        write_frames(folder / f"{name}.parquet", name, truth_as_results(tiny_root, name)[1], {})
    arguments = ["evaluate", folder, "--data-root", tiny_root]
    assert predmapnet(*arguments, "--json", tmp_path / "one.json").code == 0
    assert predmapnet(*arguments, "--json", tmp_path / "two.json", "--jobs", 2).code == 0
    assert (tmp_path / "one.json").read_bytes() == (tmp_path / "two.json").read_bytes()


def test_the_truth_as_results_is_perfect_in_parquet_and_as_a_submission(predmapnet, tiny_root, tmp_path):
    scene, maps = truth_as_results(tiny_root, "scene-0001")
    write_frames(tmp_path / "frames.parquet", "scene-0001", maps, {})
    entries = {
        scene.frame(index).token: {
            "vectors": [line.tolist() for line in frame_map.polylines],
            "scores": frame_map.scores.tolist(),
            "labels": frame_map.kinds.tolist(),
        }
        for index, frame_map in enumerate(maps)
    }
    (tmp_path / "submission.json").write_text(json.dumps({"meta": {}, "results": entries}))
    present = {kind for frame_map in maps for kind in frame_map.kinds.tolist()}
    for name in ("frames.parquet", "submission.json"):
        result = predmapnet("evaluate", tmp_path / name, "--data-root", tiny_root, "--json", tmp_path / "f.json")
        assert result.code == 0, result.err
        figures = json.loads((tmp_path / "f.json").read_text())
        assert figures["scenes"] == 1
        assert figures["chamfer_ap"]["mAP"] == pytest.approx(len(present) / 3)
        assert figures["raster_ap"]["mAP"] == pytest.approx(1.0)
        assert figures["consistency_ap"]["mAP"] == pytest.approx(len(present) / 3)


def test_what_cannot_be_measured_is_said_in_one_message(predmapnet, tiny_root, tmp_path):
    pickled = tmp_path / "pos_predictions.pkl"
    pickled.write_bytes(pickle.dumps({}))
    empty = tmp_path / "empty"
    empty.mkdir()
    _, maps = truth_as_results(tiny_root, "scene-0001")
    write_frames(tmp_path / "other.parquet", "scene-9999", maps, {})
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
