"""``predmapnet evaluate`` on results of people who make mistakes: refused, or said beside the figures."""

import json
from dataclasses import replace

import pytest

from mapfusion.elements import RegionOfInterest
from predmapnet.frame_files.parquet import write_frames
from tests.cli.test_evaluate_command import stored, truth_as_results
from tests.cli.tiny_nuscenes import edit_table

VAL = ("scene-0103", "scene-0916")


@pytest.fixture
def root(tiny_root):
    """The validation part of v1.0-mini, on the same road."""

    def onto_the_same_road(poses):
        for pose in poses:
            pose["translation"][1] = 500.0

    def of_the_validation_split(scenes):
        for scene, name in zip(scenes, VAL, strict=True):
            scene["name"] = name

    edit_table(tiny_root, "scene", of_the_validation_split)
    edit_table(tiny_root, "ego_pose", onto_the_same_road)
    return tiny_root


@pytest.fixture
def results(root):
    """The truth of all frames, as entries of a submission."""
    entries = {}
    for name in VAL:
        scene, maps = truth_as_results(root, name)
        for index, found in enumerate(maps):
            lines = [line.tolist() for line in found.polylines]
            entry = {"vectors": lines, "scores": found.scores.tolist(), "labels": found.kinds.tolist()}
            entries[scene.frame(index).token] = entry
    return entries


def changed(results, key, change):
    return {name: {**entry, key: change(entry[key])} for name, entry in results.items()}


def another_order(results):
    return changed(results, "labels", lambda labels: [{0: 0, 1: 2, 2: 1}[label] for label in labels])


def percent(results):
    return changed(results, "scores", lambda scores: [100.0 * score for score in scores])


def by_place_too(results):
    return results | {"scene-0103/0": next(iter(results.values()))}


def frames_of_argoverse(results):
    return results | {"315967376859506000": next(iter(results.values()))}


def some_normalised(results):
    """Four frames as shares of the region's sides, as some training code holds them."""
    shares = changed(results, "vectors", lambda v: [[[x / 60 + 0.5, y / 30 + 0.5] for x, y in line] for line in v])
    return results | dict(list(shares.items())[:4])


def all_normalised(results):
    return changed(results, "vectors", lambda v: [[[x / 60 + 0.5, y / 30 + 0.5] for x, y in line] for line in v])


@pytest.mark.parametrize(
    ("mistake", "message"),
    [
        (another_order, "elements labelled divider lie on true boundaries"),
        (percent, "not a number from 0 to 1"),
        (by_place_too, "holds frame 0 of scene-0103 as"),
        (frames_of_argoverse, "by their names they are Argoverse 2"),
        (some_normalised, "in 4 of 6 frames with elements, all points lie between 0 and 1"),
        (all_normalised, "so they are normalised"),
    ],
)
def test_a_mistake_is_refused_with_and_without_a_split(predmapnet, root, results, tmp_path, mistake, message):
    (tmp_path / "results.json").write_text(json.dumps({"results": mistake(results)}))
    for split in ([], ["--split", "val"]):
        told = predmapnet("evaluate", "results.json", "--data-root", root, "--json", "f.json", *split)
        assert told.code == 2 and message in " ".join(told.err.split()), told.err
        assert told.err.count("Error:") == 1 and not (tmp_path / "f.json").exists()


def test_what_is_left_out_is_said(predmapnet, root, results, tmp_path):
    """A centerline more in each frame, and a frame that the data set does not hold."""
    with_fourth = changed(changed(results, "labels", lambda v: [*v, 3]), "scores", lambda v: [*v, 0.9])
    with_fourth = changed(with_fourth, "vectors", lambda v: [*v, [[0.0, 0.0], [9.0, 0.0]]])
    with_fourth["f" * 32] = next(iter(results.values()))
    (tmp_path / "results.json").write_text(json.dumps({"results": with_fourth}))
    told = predmapnet("evaluate", "results.json", "--data-root", root, "--json", "f.json", "--split", "val")
    assert told.code == 0, told.err
    warnings = json.loads((tmp_path / "f.json").read_text())["evaluated"]["warnings"]
    assert "6 elements of the class number 3 are left out" in warnings
    assert "1 of 7 frames of the results are not in nuscenes and are left out" in warnings
    assert any("80 %" in text and "--split-scheme new" in text for text in warnings)
    told = predmapnet("evaluate", "results.json", "--data-root", root)
    assert told.code == 2 and "by their names they are nuScenes" in " ".join(told.err.split())


def test_files_that_hold_too_much_are_refused(predmapnet, root, tmp_path):
    first, second = (truth_as_results(root, name)[1] for name in VAL)
    frames = stored(first, VAL[0])
    write_frames(tmp_path / "twice.parquet", [*frames, frames[1]], {})
    for name in ("both", "regions"):
        (tmp_path / name).mkdir()
    write_frames(tmp_path / "both" / f"{VAL[0]}.parquet", [*frames, *stored(second, VAL[1])], {})
    write_frames(tmp_path / "regions" / f"{VAL[0]}.parquet", frames, {})
    shorter = [replace(frame_map, roi=RegionOfInterest(50.0, 30.0)) for frame_map in second]
    write_frames(tmp_path / "regions" / f"{VAL[1]}.parquet", stored(shorter, VAL[1]), {})
    (tmp_path / "map.geojson").write_text('{"type": "FeatureCollection", "features": []}')
    for name, message in (
        ("twice.parquet", "holds frame 1 of scene-0103 twice"),
        ("both", "holds frames of scene-0916, too"),
        ("regions", "different sizes (50 m x 30 m and 60 m x 30 m)"),
        ("map.geojson", "holds no per-frame results"),
    ):
        told = predmapnet("evaluate", name, "--data-root", root)
        assert told.code == 2 and message in " ".join(told.err.split()), told.err
    told = predmapnet("evaluate", "twice.parquet", "--data-root", root, "--weights", "w.safetensors")
    assert told.code == 2 and "--weights is for scenes that are mapped" in " ".join(told.err.split())
