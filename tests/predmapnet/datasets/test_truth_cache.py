"""Ground truth on disk: any change of what it depends on changes its key, and damage never gets through."""

import json
from pathlib import Path

import numpy as np
import pytest

from mapfusion.elements import RegionOfInterest
from predmapnet.datasets.ground_truth import cache
from predmapnet.datasets.ground_truth.cache import cache_key, cached_truths
from predmapnet.datasets.ground_truth.nuscenes import NuScenesGroundTruth
from predmapnet.datasets.nuscenes import NuScenesSource
from predmapnet.errors import UserError

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
    monkeypatch.setattr(cache, "code_fingerprint", lambda: b"code of another version")
    keys.append(cache_key(b"map", POSES, ROI, "nuscenes"))
    assert len(set(keys)) == len(keys)
    monkeypatch.undo()
    assert cache_key(b"map", [pose.copy() for pose in POSES], RegionOfInterest(), "nuscenes") == keys[0]


def test_any_change_of_a_map_changes_its_fingerprint(small_map):
    before = NuScenesGroundTruth(small_map).fingerprint
    assert NuScenesGroundTruth(json.loads(json.dumps(small_map))).fingerprint == before
    small_map["node"][0]["x"] += 1e-9
    assert NuScenesGroundTruth(small_map).fingerprint != before


def test_any_change_of_the_code_or_of_a_library_changes_its_fingerprint(tmp_path, monkeypatch):
    fingerprints = {cache.code_fingerprint()}
    for path in Path(cache.__file__).parent.glob("*.py"):
        (tmp_path / path.name).write_bytes(path.read_bytes())
    monkeypatch.setattr(cache, "__file__", str(tmp_path / "cache.py"))
    compute = cache.code_fingerprint.__wrapped__
    assert compute() in fingerprints, "where the code lies does not matter"
    with (tmp_path / "crossings.py").open("a") as file:
        file.write("\n")
    fingerprints.add(compute())
    for library, name in ((cache.np, "__version__"), (cache.shapely, "__version__"), (cache.shapely, "geos_version")):
        monkeypatch.setattr(library, name, "another")
        fingerprints.add(compute())
    assert len(fingerprints) == 5


def test_the_truth_follows_every_change_of_map_and_poses(nuscenes_root, folder):
    """The cache may only ever give what would be computed now."""

    def check():
        scene = NuScenesSource(nuscenes_root).open("scene-0061")
        same(scene.truths(ROI, folder), scene.truths(ROI))
        return len(list(folder.iterdir()))

    assert check() == check() == 1
    expansion = nuscenes_root / "maps" / "expansion" / "singapore-onenorth.json"
    expansion.write_text(expansion.read_text().replace('"x": 103', '"x": 102.5'))
    assert check() == 2
    poses = nuscenes_root / "v1.0-mini" / "ego_pose.json"
    poses.write_text(poses.read_text().replace("85.0", "85.25"))
    assert check() == 3


def test_a_cache_that_cannot_be_written_is_named(scene, tmp_path):
    (tmp_path / "file").touch()
    with pytest.raises(UserError, match=r"cannot be kept in .*set PREDMAPNET_CACHE"):
        scene.truths(ROI, tmp_path / "file" / "cache")


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
