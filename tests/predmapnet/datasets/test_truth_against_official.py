"""Every ground-truth polyline, in every form, against what the official code made of the same maps and poses.

Case names are taken from the folders, so that other cases of the same layout are read as well.
"""

import json

import numpy as np
import pytest
import shapely

from mapfusion.elements import ElementKind, RegionOfInterest
from mapfusion.geometry import resample
from predmapnet.datasets.argoverse2 import Argoverse2Source
from predmapnet.datasets.ground_truth.nuscenes import NuScenesGroundTruth
from predmapnet.datasets.ground_truth.tracks import POINTS, normalised
from predmapnet.datasets.nuscenes import NuScenesSource
from predmapnet.datasets.poses import combined, pose_matrix, quaternion_of
from predmapnet.datasets.splits import split_names
from tests.predmapnet.datasets.official_forms import permuted, simplified
from tests.predmapnet.datasets.semantic_mask import semantic_mask

pytestmark = pytest.mark.reference

TOLERANCE = 1e-3
"""Metres; what is promised. On the cases that were at hand the largest difference is below 1e-6."""


def nuscenes_cases(folder):
    """Yield (stored case, unstable items, frames as we form them, region, stem) of every nuScenes case."""
    maps = sorted((folder / "maps" / "expansion").glob("*.json"))
    for path in sorted((folder / "gt").glob("*.gt*.json")):
        case = json.loads(path.read_text()) | {"folder": path.parent}
        name = path.name.split(".")[0]
        location = case["location"].split()[0]
        truth = NuScenesGroundTruth(next((file for file in maps if file.stem == location), maps[0]))
        roi = RegionOfInterest(*case["roi_size"])
        frames = [truth.frame(lidar_to_global(frame), roi) for frame in case["frames"]]
        yield case, unstable_items(path), frames, roi, name


def unstable_items(path):
    """What the official code makes differently when a pose moves by nothing, by frame, class and item."""
    listed = path.with_name(path.name.replace(".gt.json", ".unstable_items.json"))
    if listed == path or not listed.exists():
        return {}
    items = json.loads(listed.read_text())["items"]
    return {(item["index"], item["class_id"], item["item"]): item["kind"] for item in items}


def lidar_to_global(frame):
    ego_to_global = pose_matrix(frame["e2g_rotation"], frame["e2g_translation"], "fixture")
    return combined(ego_to_global, pose_matrix(frame["lidar2ego_rotation"], frame["lidar2ego_translation"], "fixture"))


def test_poses_have_the_bits_of_the_official_ones(reference):
    """Corners of crossings hang on them."""
    for path in sorted(reference("ground_truth", "nuscenes", "gt").glob("*.gt.json")):
        for frame in json.loads(path.read_text())["frames"]:
            ours = lidar_to_global(frame)
            assert ours[:3, 3].tolist() == frame["lidar2global_translation"]
            assert quaternion_of(ours[:3, :3]).tolist() == frame["lidar2global_quaternion"]


def argoverse2_cases(folder):
    source = Argoverse2Source(folder / "logs", stride=1)
    for path in sorted((folder / "gt").glob("*.gt*.json")):
        case = json.loads(path.read_text()) | {"folder": path.parent}
        scene = source.open(case["log_id"])
        roi = RegionOfInterest(*case["roi_size"])
        index = {time: row for row, time in enumerate(scene.timestamps.tolist())}
        frames = [scene.truth(index[frame["timestamp_ns"]], roi) for frame in case["frames"]]
        yield case, unstable_items(path), frames, roi, case["log_id"]


CASES = {"nuscenes": nuscenes_cases, "av2": argoverse2_cases}


@pytest.fixture(params=CASES, scope="module")
def cases(request, reference):
    found = list(CASES[request.param](reference("ground_truth", request.param)))
    assert found
    return found


def pieces(truth, kind):
    return [line for line, of in zip(truth.polylines, truth.kinds, strict=True) if of == kind]


def difference(mine, official):
    """Largest distance of corresponding vertices; rings may start anywhere."""
    if len(mine) != len(official):
        return np.inf
    if np.linalg.norm(official[0] - official[-1]) > 1e-3:
        return np.abs(mine - official).max()
    mine, official = mine[:-1], official[:-1]
    return min(np.abs(np.roll(mine, shift, axis=0) - official).max() for shift in range(len(mine)))


def shape_difference(mine, official):
    return shapely.hausdorff_distance(shapely.LineString(mine), shapely.LineString(official))


def nearest(official, candidates):
    return min(candidates, key=lambda line: shape_difference(line, official))


def official_lines(frame, kind, form="raw"):
    return [np.array(line)[:, :2] for line in frame[form][str(kind)]]


def test_every_polyline(cases):
    compared = 0
    for case, unstable, frames, _, name in cases:
        for stored, truth in zip(case["frames"], frames, strict=True):
            for kind in range(3):
                mine, official = pieces(truth, kind), official_lines(stored, kind)
                where = f"{name}, frame {stored['index']}, class {kind}"
                shaky = any(key[:2] == (stored["index"], kind) and what == "shape" for key, what in unstable.items())
                assert len(mine) == len(official) or shaky, where
                for item, line in enumerate(official):
                    compared += 1
                    if unstable.get((stored["index"], kind, item)) == "shape":
                        continue
                    other = nearest(line, mine)
                    # Every ring may carry a redundant collinear vertex; what counts is its shape.
                    ring = kind == 0 or np.allclose(line[0], line[-1], atol=1e-3)
                    gap = shape_difference(other, line) if ring else difference(other, line)
                    assert gap < TOLERANCE, f"{where}, item {item}: {gap} m off"
    assert compared > 0


def test_rings_are_the_same_vertices_in_the_same_direction(cases):
    exact = total = 0
    for case, unstable, frames, _, _ in cases:
        for stored, truth in zip(case["frames"], frames, strict=True):
            for item, line in enumerate(official_lines(stored, 0)):
                if (stored["index"], 0, item) not in unstable:
                    candidates = pieces(truth, 0)
                    total += 1
                    exact += bool(candidates) and difference(nearest(line, candidates), line) < TOLERANCE
    assert exact >= 0.95 * total, f"only {exact} of {total} crossings have the same vertices"


def test_simplified_and_resampled_forms_of_the_official_lines(cases):
    for case, _, _, _, _ in cases:
        for frame in case["frames"]:
            for kind in range(3):
                for raw, short, even in zip(
                    official_lines(frame, kind),
                    official_lines(frame, kind, "eval_simplified"),
                    official_lines(frame, kind, "vec20"),
                    strict=True,
                ):
                    assert shape_difference(simplified(raw), short) < TOLERANCE
                    assert len(simplified(raw)) == len(short)
                    np.testing.assert_allclose(resample(raw, POINTS), even, atol=TOLERANCE)


@pytest.mark.parametrize("data", CASES)
def test_permutations_of_the_official_lines(reference, data):
    compared = 0
    folder = reference("ground_truth", data, "gt")
    for path in sorted(folder.glob("*.permuted_norm.npz")):
        case = json.loads((folder / path.name.replace("permuted_norm.npz", "gt.json")).read_text())
        roi = RegionOfInterest(*case["roi_size"])
        with np.load(path) as stored:
            for key in stored.files:
                index, kind = (int(part) for part in key.removeprefix("frame").split("_class"))
                lines = official_lines(case["frames"][index], kind)
                mine = [permuted(normalised(resample(line, POINTS), roi)) for line in lines]
                np.testing.assert_allclose(np.array(mine).reshape(stored[key].shape), stored[key], atol=1e-9)
                compared += len(lines)
    assert compared > 0


def allowed_pixels(truth):
    """Ends of lines on the border may fall into the next pixel by the last bit; few do."""
    return 12 + len(truth.polylines)


def test_masks(cases):
    for case, unstable, frames, roi, name in cases:
        size = "x".join(f"{side:g}" for side in case["roi_size"])
        suffix = "" if size == "60x30" else f"_{size}"
        stored = np.load(case["folder"] / f"{name}.raster{suffix}.npz")["semantic_mask"]
        assert len(stored) == len(frames) > 0
        for frame, truth, official in zip(case["frames"], frames, stored, strict=True):
            raw = [(kind, line) for kind in range(3) for line in official_lines(frame, kind)]
            kinds = np.array([kind for kind, _ in raw], dtype=np.int64)
            np.testing.assert_array_equal(semantic_mask(kinds, [line for _, line in raw], roi), official)
            own = semantic_mask(truth.kinds, truth.polylines, roi)
            if not any(key[0] == frame["index"] and what == "shape" for key, what in unstable.items()):
                assert np.count_nonzero(own != official) <= allowed_pixels(truth)


def test_the_whole_map_of_a_log_holds_what_its_frames_see(reference):
    for info in (source := Argoverse2Source(reference("ground_truth", "av2", "logs"))).scenes():
        scene = source.open(info.name)
        whole = scene.truth_map()
        for kind in ElementKind:
            lines = shapely.union_all([shapely.LineString(element.points) for element in whole.of_kind(kind)])
            for index in range(0, len(scene), 6):
                pose = scene.pose(index)
                for line in pieces(scene.truth(index, RegionOfInterest()), kind):
                    there = shapely.points(line @ pose[:2, :2].T + pose[:2, 3])
                    # Frames simplify dividers by 0.2 m.
                    assert shapely.distance(there, lines).max() < 0.3


def test_the_real_six_camera_sample(reference):
    """Pose, projection and truth of a real sample as the official data set class returned them."""
    folder = reference("ground_truth", "nuscenes_sample")
    official = json.loads((folder / "get_sample.json").read_text())
    scene = NuScenesSource(folder).open(official["scene_name"])
    (index,) = (index for index in range(len(scene)) if scene.instant(index).token == official["token"])
    frame = scene.frame(index)
    np.testing.assert_allclose(frame.ego_to_global[:3, 3], official["ego2global_translation"], atol=1e-9)
    np.testing.assert_allclose(frame.ego_to_global[:3, :3], official["ego2global_rotation"], atol=1e-12)
    for camera, filename, ego_to_camera, ego_to_image in zip(
        frame.rig, official["img_filenames"], official["ego2cam"], official["ego2img"], strict=True
    ):
        assert frame.images[camera.name] == folder / filename
        projection = np.eye(4)
        projection[:3, :3] = camera.intrinsics
        np.testing.assert_allclose(np.linalg.inv(camera.camera_to_ego), ego_to_camera, atol=1e-9)
        np.testing.assert_allclose(projection @ np.linalg.inv(camera.camera_to_ego), ego_to_image, atol=1e-6)
    truth = scene.truth(frame.index, RegionOfInterest())
    for kind in range(3):
        for line in (np.array(line) for line in official["map_geoms_raw"][str(kind)]):
            assert shape_difference(nearest(line, pieces(truth, kind)), line) < TOLERANCE
    with np.load(folder / "get_sample_raster.npz") as stored:
        mask = stored[stored.files[0]]
    own = semantic_mask(truth.kinds, truth.polylines, RegionOfInterest())
    assert np.count_nonzero(own != mask) <= allowed_pixels(truth)


def test_calibration_of_the_real_sample_against_its_source(reference):
    folder = reference("ground_truth", "nuscenes_sample")
    matrices = json.loads((folder / "pickle_matrices.json").read_text())
    official = json.loads((folder / "get_sample.json").read_text())
    scene = NuScenesSource(folder).open(official["scene_name"])
    (index,) = (index for index in range(len(scene)) if scene.instant(index).token == official["token"])
    frame = scene.frame(index)
    ego_to_global = np.array(matrices["ego2global"])
    for camera in frame.rig:
        stored = ego_to_global @ np.array(matrices[camera.name]["cam2ego"])
        np.testing.assert_allclose(frame.ego_to_global @ camera.camera_to_ego, stored, atol=2e-4)
        np.testing.assert_allclose(camera.intrinsics, np.array(matrices[camera.name]["cam2img"])[:3, :3], atol=1e-9)


LISTS = {
    "nuscenes_old_train": "nuscenes_old_train",
    "nuscenes_old_val": "nuscenes_old_val",
    "nuscenes_test": "nuscenes_test",
    "nuscenes_mini_train": "nuscenes_mini_train",
    "nuscenes_mini_val": "nuscenes_mini_val",
    "nuscenes_new_train": "nuscenes_new_train",
    "nuscenes_new_val": "nuscenes_new_val",
    "nuscenes_converter_skipped_scenes": "nuscenes_skipped",
    "av2_new_train": "argoverse2_new_train",
    "av2_new_val": "argoverse2_new_val",
    "av2_converter_skipped_logs": "argoverse2_skipped",
}


@pytest.mark.parametrize("theirs", LISTS)
def test_split_lists_are_the_published_ones_in_their_order(reference, theirs):
    official = reference("ground_truth", "splits", f"{theirs}.txt").read_text().split()
    assert list(split_names(LISTS[theirs])) == official
