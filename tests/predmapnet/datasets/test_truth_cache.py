"""Ground truth on disk: any change of what it depends on changes its key, and damage never gets through."""

import json

import numpy as np
import pytest

from mapfusion.elements import RegionOfInterest
from predmapnet.datasets.ground_truth import cache
from predmapnet.datasets.ground_truth.cache import cache_key, cached_truths
from predmapnet.datasets.ground_truth.nuscenes import NuScenesGroundTruth
from predmapnet.datasets.nuscenes import NuScenesSource

ROI = RegionOfInterest()
POSES = [np.eye(4), np.diag([1.0, -1.0, -1.0, 1.0])]


def moved(poses, distance):
    changed = [pose.copy() for pose in poses]
    changed[1][0, 3] += distance
    return changed


def test_any_input_changes_the_key(monkeypatch):
    keys = [
        cache_key(b"map", POSES, ROI, "nuscenes"),
        cache_key(b"mop", POSES, ROI, "nuscenes"),
        cache_key(b"map", POSES[:1], ROI, "nuscenes"),
        cache_key(b"map", POSES[::-1], ROI, "nuscenes"),
        cache_key(b"map", moved(POSES, 1e-12), ROI, "nuscenes"),
        cache_key(b"map", POSES, RegionOfInterest(60, 30.0001), "nuscenes"),
        cache_key(b"map", POSES, RegionOfInterest(30, 60), "nuscenes"),
        cache_key(b"map", POSES, ROI, "argoverse2"),
    ]
    monkeypatch.setattr(cache, "EXTRACTION_VERSION", cache.EXTRACTION_VERSION + 1)
    keys.append(cache_key(b"map", POSES, ROI, "nuscenes"))
    assert len(set(keys)) == len(keys)
    monkeypatch.undo()
    assert cache_key(b"map", [pose.copy() for pose in POSES], RegionOfInterest(), "nuscenes") == keys[0]


def test_any_change_of_a_map_changes_its_fingerprint(small_map):
    before = NuScenesGroundTruth(small_map).fingerprint
    assert NuScenesGroundTruth(json.loads(json.dumps(small_map))).fingerprint == before
    small_map["node"][0]["x"] += 1e-9
    assert NuScenesGroundTruth(small_map).fingerprint != before


@pytest.fixture
def folder(tmp_path):
    return tmp_path / "cache"


@pytest.fixture
def scene(nuscenes_root):
    return NuScenesSource(nuscenes_root).open("scene-0061")


def same(first, second):
    assert len(first) == len(second)
    for one, two in zip(first, second, strict=True):
        np.testing.assert_array_equal(one.kinds, two.kinds)
        np.testing.assert_array_equal(one.element_ids, two.element_ids)
        for line, other in zip(one.polylines, two.polylines, strict=True):
            np.testing.assert_array_equal(line, other)


def test_what_is_kept_is_what_was_computed(scene, folder):
    fresh = scene.truths(ROI)
    same(scene.truths(ROI, folder), fresh)
    (kept,) = folder.iterdir()
    written = kept.stat().st_mtime_ns
    same(scene.truths(ROI, folder), fresh)
    assert kept.stat().st_mtime_ns == written, "the second time it is read"
    scene.truths(RegionOfInterest(100, 50), folder)
    assert len(list(folder.iterdir())) == 2


@pytest.mark.parametrize("damage", [b"", b"PK", None])
def test_a_damaged_file_is_made_again(scene, folder, damage):
    fresh = scene.truths(ROI, folder)
    (kept,) = folder.iterdir()
    data = kept.read_bytes()
    kept.write_bytes(data[: len(data) // 2] if damage is None else damage)
    same(scene.truths(ROI, folder), fresh)
    assert kept.read_bytes()[:2] == b"PK"


def test_empty_frames_survive(folder, small_map):
    far = np.eye(4)
    far[0, 3] = 1e5
    truths = [NuScenesGroundTruth(small_map).frame(far, ROI)]
    assert len(truths[0].polylines) == 0
    cached_truths(folder, "key", lambda: truths)
    same(cached_truths(folder, "key", lambda: pytest.fail("computed again")), truths)


def test_an_interrupted_write_leaves_nothing(folder, monkeypatch):
    def stop(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr(cache.np, "savez_compressed", stop)
    with pytest.raises(KeyboardInterrupt):
        cached_truths(folder, "key", list)
    assert list(folder.iterdir()) == []
