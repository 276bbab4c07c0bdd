"""The training cache: what is in it is what the data set says, and what is damaged, old or missing is noticed."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import cv2
import numpy as np
import pytest

from predmapnet.datasets.nuscenes import NuScenesSource
from predmapnet.datasets.splits import split_names
from predmapnet.demo_world.rigs import sample_rig
from predmapnet.errors import UserError
from predmapnet.frame_cache.fill_cache import expected_bytes
from predmapnet.frame_cache.prepare import (
    DataOptions,
    DataSet,
    _split,
    cache_folder,
    count_frames,
    parse_data_sets,
    prepare_data,
)
from predmapnet.frame_cache.scene_cache import INDEX, CachedScene
from predmapnet.network.calibration import calibrate
from predmapnet.network.image_input import stack_windows
from predmapnet.presets import preset
from predmapnet.scenes import SceneInfo
from tests.predmapnet.datasets.conftest import write_nuscenes

CONFIG = preset("lite")
WIDTH, HEIGHT = 320, 180


@pytest.fixture
def town(tmp_path, monkeypatch):
    """Two short scenes with images that differ by camera and frame, big enough for the network's window."""
    monkeypatch.setenv("PREDMAPNET_CACHE", str(tmp_path / "kept"))
    root = write_nuscenes(tmp_path / "nuscenes")
    table = root / "v1.0-mini" / "sample_data.json"
    records = json.loads(table.read_text())
    for record in records:
        record |= {"width": WIDTH, "height": HEIGHT}
    table.write_text(json.dumps(records))
    calibrations = root / "v1.0-mini" / "calibrated_sensor.json"
    records = json.loads(calibrations.read_text())
    for record in records:
        if record["camera_intrinsic"]:
            record["camera_intrinsic"] = [[200.0, 0, 160], [0, 200.0, 90], [0, 0, 1]]
    calibrations.write_text(json.dumps(records))
    for number, path in enumerate(sorted(root.glob("samples/CAM*/*.jpg"))):
        rows = np.linspace(0, 200, HEIGHT)[:, None, None] * [1.0, 0.5, 0.2]
        picture = np.clip(np.broadcast_to(rows, (HEIGHT, WIDTH, 3)) + 3 * number, 0, 255).astype(np.uint8)
        cv2.imwrite(str(path), picture)
    return root


def prepared(root, cache, report=print, **changes):
    options = DataOptions((DataSet("nuscenes", root),), cache, **changes)
    return prepare_data(options, CONFIG, 1, report)


def fill(root, cache):
    """Fill; return the lines that the user reads."""
    lines = []
    prepared(root, cache, lines.append)
    return lines


def made(lines):
    return int(next(line for line in lines if "in the cache" in line).split(" of them new")[0].split()[-1])


def test_cached_frames_are_the_data_sets(town, tmp_path):
    scenes, validation = prepared(town, tmp_path / "cache")
    assert [scene.name for scene in scenes.scenes] == ["scene-0061"]
    assert [scene.name for scene in validation] == ["scene-0103"]
    original = NuScenesSource(town).open("scene-0061")
    for index in range(3):
        frame, cached = original.frame(index), scenes.scenes[0].frame(index)
        images = {name: cv2.imread(str(path))[:, :, ::-1] for name, path in frame.images.items()}
        windows, valid = stack_windows(images, frame.rig, CONFIG.image)
        assert np.abs(cached.images.astype(int) - windows).mean() < 1.5
        assert (cached.camera_valid == valid).all() and valid.all()
        np.testing.assert_array_equal(cached.ego_to_global, frame.ego_to_global)
        np.testing.assert_array_equal(cached.calibration.ego_to_image, calibrate(frame.rig, CONFIG).ego_to_image)
        truth = original.truth(index, CONFIG.roi)
        assert (cached.truth.kinds == truth.kinds).all() and (cached.truth.element_ids == truth.element_ids).all()
        for line, expected in zip(cached.truth.polylines, truth.polylines, strict=True):
            np.testing.assert_array_equal(line, expected)
    assert scenes.scenes[0].with_crossing.tolist() == [0 in original.truth(i, CONFIG.roi).kinds for i in range(3)]


def test_what_is_there_is_kept_and_what_is_damaged_or_old_is_made_anew(town, tmp_path):
    cache = tmp_path / "cache"
    assert made(fill(town, cache)) == 6
    assert made(fill(town, cache)) == 0
    paths = sorted(path for path in cache.rglob("*.npz") if path.name != INDEX)
    before = paths[0].read_bytes()
    for place in np.linspace(200, len(before) - 200, 12).astype(int):
        paths[0].write_bytes(before[:place] + bytes([before[place] ^ 255]) + before[place + 1 :])
        assert made(fill(town, cache)) in (0, 1)
        CachedScene(paths[0].parent).frame(0)
    paths[0].write_bytes(before[: len(before) // 2])
    paths[1].write_bytes(b"")
    with pytest.raises(UserError, match=r"damaged.*Train again"):
        CachedScene(paths[0].parent).frame(0)
    assert made(fill(town, cache)) == 2
    image = next(town.glob("samples/CAM_BACK/scene-0061-1-*.jpg"))
    cv2.imwrite(str(image), np.random.default_rng(0).integers(0, 255, (HEIGHT, WIDTH, 3), dtype=np.uint8))
    assert made(fill(town, cache)) == 1


def test_a_flipped_bit_in_the_images_is_found(town, tmp_path):
    fill(town, tmp_path / "cache")
    path = sorted(path for path in (tmp_path / "cache").rglob("*.npz") if path.name != INDEX)[0]
    whole = path.read_bytes()
    place = whole.index(b"\xff\xd8\xff") + 900
    path.write_bytes(whole[:place] + bytes([whole[place] ^ 1]) + whole[place + 1 :])
    with pytest.raises(UserError, match="damaged"):
        CachedScene(path.parent).frame(0)
    assert made(fill(town, tmp_path / "cache")) == 1


def test_missing_and_broken_images_mask_their_cameras_and_the_frame_stays(town, tmp_path):
    next(town.glob("samples/CAM_FRONT/scene-0061-1-*.jpg")).unlink()
    broken = next(town.glob("samples/CAM_BACK/scene-0061-1-*.jpg"))
    whole = broken.read_bytes()
    broken.write_bytes(whole[: len(whole) // 2])
    small = next(town.glob("samples/CAM_BACK/scene-0061-2-*.jpg"))
    cv2.imwrite(str(small), np.zeros((9, 16, 3), np.uint8))
    lines = fill(town, tmp_path / "cache")
    assert any("3 images cannot be used" in line for line in lines)
    scene = prepared(town, tmp_path / "cache", lambda _line: None)[0].scenes[0]
    assert [scene.frame(index).camera_valid.sum() for index in range(3)] == [6, 4, 5]
    assert not scene.frame(1).camera_valid[[0, 3]].any() and not scene.frame(1).images[[0, 3]].any()
    broken.write_bytes(whole)
    assert made(fill(town, tmp_path / "cache")) == 1
    for path in town.glob("samples/CAM*/scene-0061-0-*.jpg"):
        path.unlink()
    lines = fill(town, tmp_path / "cache")
    assert any("1 frames without any image" in line for line in lines)
    assert len(prepared(town, tmp_path / "cache", lambda _line: None)[0].scenes[0]) == 2


def test_a_killed_filling_goes_on(town, tmp_path):
    code = (
        "import sys, time; from pathlib import Path; from predmapnet.frame_cache import fill_cache\n"
        "from predmapnet.frame_cache.prepare import DataOptions, DataSet, prepare_data\n"
        "from predmapnet.presets import preset\n"
        "write = fill_cache.write_arrays\n"
        "fill_cache.write_arrays = lambda *a: (write(*a), print('made', flush=True), time.sleep(1.0))\n"
        "root, cache = map(Path, sys.argv[1:])\n"
        "prepare_data(DataOptions((DataSet('nuscenes', root),), cache), preset('lite'), 1)"
    )
    with subprocess.Popen(
        [sys.executable, "-c", code, str(town), str(tmp_path / "cache")], stdout=subprocess.PIPE, text=True
    ) as process:
        while process.stdout.readline() != "made\n":
            pass
        time.sleep(0.1)
        os.kill(process.pid, signal.SIGKILL)
    assert list((tmp_path / "cache").rglob("0*.npz")) and not list((tmp_path / "cache").rglob(INDEX))
    assert 1 <= made(fill(town, tmp_path / "cache")) < 6


def test_without_a_map_a_scene_is_left_out_and_without_any_scene_there_is_nothing_to_train_on(town, tmp_path):
    (town / "maps" / "expansion" / "singapore-onenorth.json").unlink()
    lines = []
    with pytest.raises(UserError, match="no scene to train on"):
        prepared(town, tmp_path / "cache", lines.append)
    assert any("scene-0061 has no map" in line for line in lines)


def test_logs_that_no_split_names_are_all_trained_on(tmp_path, monkeypatch):
    monkeypatch.setenv("PREDMAPNET_CACHE", str(tmp_path / "kept"))
    root = write_nuscenes(tmp_path / "own", scenes=("monday", "tuesday"))
    scenes, validation = prepared(root, tmp_path / "cache")
    assert [scene.name for scene in scenes.scenes] == ["monday", "tuesday"] and validation == []


def test_other_roots_sizes_and_regions_have_caches_of_their_own(town, tmp_path):
    first = prepared(town, tmp_path / "cache")[0].scenes[0].folder
    town.rename(town.with_name("moved"))
    second = prepared(town.with_name("moved"), tmp_path / "cache")[0].scenes[0].folder
    assert first != second
    paper = DataOptions((DataSet("nuscenes", town.with_name("moved")),), tmp_path / "cache")
    wider = CONFIG.model_copy(update={"roi_width": 50.0})
    assert prepare_data(paper, wider, 1)[0].scenes[0].folder not in (first, second)


def test_truth_is_cut_to_the_region_of_the_network(town, tmp_path):
    smaller = CONFIG.model_copy(update={"roi_length": 20.0, "roi_width": 16.0})
    scenes, _ = prepare_data(DataOptions((DataSet("nuscenes", town),), tmp_path / "cache"), smaller, 1)
    whole = prepared(town, tmp_path / "cache")[0].scenes[0].frame(0).truth
    cut, expected = scenes.scenes[0].frame(0).truth, NuScenesSource(town).open("scene-0061").truth(0, smaller.roi)
    assert [line.tolist() for line in cut.polylines] == [line.tolist() for line in expected.polylines]
    assert [line.tolist() for line in cut.polylines] != [line.tolist() for line in whole.polylines]


def test_weights_of_data_sets_are_those_of_their_scenes(town, tmp_path):
    scenes, _ = prepare_data(DataOptions((DataSet("nuscenes", town, 2.5),), tmp_path / "cache"), CONFIG, 1)
    assert scenes.weights == [2.5]


def test_logs_that_published_training_leaves_out_are_left_out():
    left_out = split_names("argoverse2_skipped")[0]
    infos = [SceneInfo(name, "train", 3, "PIT") for name in (left_out, "another")]
    assert _split(infos, 10) == (infos[1:], [])


def test_codes_of_cameras_have_caches_of_their_own_and_other_networks_share_one():
    """Images and calibrations of demo scenes are kept without a question."""
    paper, lite = preset("paper-nuscenes"), preset("lite")
    turned = paper.model_copy(update={"bev": paper.bev.model_copy(update={"cameras": paper.bev.cameras[::-1]})})
    wide = paper.model_copy(update={"image": paper.image.model_copy(update={"width": 600})})
    longer = lite.model_copy(update={"roi_length": 100.0})
    folders = [cache_folder(Path(), "demo", config) for config in (paper, turned, wide, lite, longer)]
    assert len(set(folders)) == 5
    narrow = lite.model_copy(update={"decoder": lite.decoder.model_copy(update={"queries": 10})})
    assert cache_folder(Path(), "demo", narrow) == folders[3]


def test_the_plan_knows_how_many_images_there_are(town):
    nuscenes, demo = DataSet("nuscenes", town, weight=2.0), DataSet("demo")
    assert count_frames(DataOptions((nuscenes,), town), CONFIG) == (6, 36)
    cars = sum(len(sample_rig(number)) for number in (201, 202, 203)) + 2 * 6
    assert count_frames(DataOptions((demo,), town, towns=3, validation=2), CONFIG) == (120, 40 * cars)
    both = DataOptions((nuscenes, demo), town, towns=3, validation=2)
    assert count_frames(both, preset("paper-nuscenes")) == (126, 36 + 40 * 5 * 6)


def test_nuscenes_at_the_papers_size_takes_less_than_20_gb():
    assert 10e9 < expected_bytes(28_130 * 6, preset("paper-nuscenes")) < 20e9


@pytest.mark.parametrize(
    ("names", "roots", "says"),
    [
        (["kitti"], [], "no training data 'kitti'.*nuscenes"),
        (["demo-v1"], [], "no training data 'demo-v1'"),
        (["nuscenes:many"], [], "'many'.*weight"),
        (["nuscenes:-1"], [], "'-1'.*weight"),
        (["nuscenes", "argoverse2"], ["a"], "no --data-root for argoverse2"),
        (["demo"], ["a"], "No --data belongs to --data-root a"),
    ],
)
def test_choices_that_cannot_be_meant_are_refused(names, roots, says):
    with pytest.raises(UserError, match=says):
        parse_data_sets(names, roots)


def test_roots_belong_to_the_data_sets_in_their_order():
    found = parse_data_sets(["nuscenes:3", "demo", "argoverse2:0.5"], ["a", "b"])
    assert found == (DataSet("nuscenes", "a", 3.0), DataSet("demo"), DataSet("argoverse2", "b", 0.5))
    assert str(DataOptions(found, "cache")) == "nuscenes:3, demo, argoverse2:0.5"
