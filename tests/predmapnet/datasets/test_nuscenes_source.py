"""The nuScenes reader: versions, splits, frames, and what it says about damaged data."""

import json
import time
import tracemalloc

import numpy as np
import pytest

from mapfusion.elements import RegionOfInterest
from predmapnet.datasets.nuscenes import NuScenesSource
from predmapnet.datasets.nuscenes_tables import NUSCENES_CAMERAS as CAMERAS
from predmapnet.datasets.splits import split_names
from predmapnet.errors import UserError


def edit(root, table, change, version="v1.0-mini"):
    """Change the records of a table in place and write it back."""
    path = root / version / f"{table}.json"
    records = json.loads(path.read_text())
    change(records)
    path.write_text(json.dumps(records, indent=0))


def test_scenes_and_splits_of_mini(nuscenes_root):
    infos = NuScenesSource(nuscenes_root).scenes()
    assert [(info.name, info.split, info.frames) for info in infos] == [
        ("scene-0061", "train", 3),
        ("scene-0103", "val", 3),
    ]
    assert [info.name for info in NuScenesSource(nuscenes_root).scenes("val")] == ["scene-0103"]


def test_published_split_sizes():
    sizes = {name: len(split_names(f"nuscenes_{name}")) for name in ("old_train", "old_val", "test")}
    assert sizes == {"old_train": 700, "old_val": 150, "test": 150}
    new_train, new_val = set(split_names("nuscenes_new_train")), set(split_names("nuscenes_new_val"))
    assert (len(new_train), len(new_val), len(new_train & new_val)) == (698, 148, 0)
    assert len(new_train & set(split_names("nuscenes_old_val"))) == 117
    assert (len(split_names("argoverse2_new_train")), len(split_names("argoverse2_new_val"))) == (749, 149)


def test_the_new_split_moves_scenes(write_nuscenes_data, tmp_path):
    write_nuscenes_data(tmp_path, "v1.0-trainval", ("scene-0001", "scene-0003", "scene-0410"), frames=1)
    official = {info.name: info.split for info in NuScenesSource(tmp_path).scenes()}
    disjoint = {info.name: info.split for info in NuScenesSource(tmp_path, split_scheme="new").scenes()}
    assert official == {"scene-0001": "train", "scene-0003": "val", "scene-0410": "train"}
    assert disjoint == {"scene-0001": "val", "scene-0003": "train"}


def test_trainval_is_preferred_and_mini_only_taken_alone(write_nuscenes_data, tmp_path):
    write_nuscenes_data(tmp_path, "v1.0-mini")
    assert NuScenesSource(tmp_path).version == "v1.0-mini"
    write_nuscenes_data(tmp_path, "v1.0-trainval", ("scene-0001",))
    assert NuScenesSource(tmp_path).version == "v1.0-trainval"
    with pytest.raises(UserError, match=r"no nuScenes version 'v1.0-tset'; found: v1.0-mini, v1.0-trainval"):
        NuScenesSource(tmp_path, "v1.0-tset")


def test_frames_follow_the_official_convention(nuscenes_root):
    scene = NuScenesSource(nuscenes_root).open("scene-0103")
    assert len(scene) == 3
    frame = scene.frame(1)
    # The origin lies at the lidar's x and y, but at the height of the ego frame.
    np.testing.assert_allclose(frame.ego_to_global[:3, 3], [85.9, 4.0, 0.0])
    assert tuple(camera.name for camera in frame.rig) == CAMERAS == tuple(frame.images)
    np.testing.assert_allclose(frame.rig[0].camera_to_ego[:3, 3], [0.1, 0.0, 1.5], atol=1e-12)
    assert frame.timestamp == 1_500_000_000_500_000_000
    assert "True" in frame.images["CAM_BACK"].name, "only key frames are used"


def test_truth_and_exact_element_ids(nuscenes_root):
    scene = NuScenesSource(nuscenes_root).open("scene-0061")
    truth = scene.truth(2, RegionOfInterest())
    assert truth.kinds.tolist() == [0, 1, 2, 2]
    crossing, divider, *boundaries = truth.polylines
    # The car is at x = 90.9 (lidar), y = 4, heading along x.
    np.testing.assert_allclose([crossing[:, 0].min(), crossing[:, 0].max()], [9.1, 12.1], atol=1e-9)
    np.testing.assert_allclose(divider, [[-30, 0], [30, 0]], atol=1e-9)
    assert sorted(round(float(line[0, 1])) for line in boundaries) == [-4, 4]
    assert truth.element_ids.tolist() == [0, 0, 0, 0]


def test_the_map_of_the_whole_scene(nuscenes_root):
    truth = NuScenesSource(nuscenes_root).open("scene-0061").truth_map()
    # Three frames at x = 80.9, 85.9 and 90.9 see x from 50.9 to 120.9.
    lengths = [truth.length(kind) for kind in range(3)]
    np.testing.assert_allclose(lengths, [8.0, 70.0, 140.0], atol=1e-6)
    assert [len(truth.of_kind(kind)) for kind in range(3)] == [1, 1, 2]
    assert truth.elements[1].observations == 3


def test_the_map_of_a_wider_region_reaches_further(nuscenes_root):
    truth = NuScenesSource(nuscenes_root).open("scene-0061").truth_map(RegionOfInterest(100.0, 50.0))
    assert truth.length(1) == pytest.approx(110.0)


def test_the_map_of_several_scenes_is_one(nuscenes_root):
    """Both drive along the same road: no element comes twice, and each scene's frames count as observations."""
    source, roi = NuScenesSource(nuscenes_root), RegionOfInterest()
    alone, other = (source.open(name).truth_map() for name in ("scene-0061", "scene-0103"))
    both = source.truth_map(["scene-0061", "scene-0103"], roi)
    assert [len(both.of_kind(kind)) for kind in range(3)] == [1, 1, 2]
    ends = [element.points[:, 0] for part in (alone, other) for element in part.of_kind(1)]
    assert both.length(1) == pytest.approx(max(map(np.max, ends)) - min(map(np.min, ends)))
    assert both.elements[1].observations == alone.elements[1].observations + other.elements[1].observations
    (nuscenes_root / "maps").rename(nuscenes_root / "elsewhere")
    assert NuScenesSource(nuscenes_root).truth_map(["scene-0061", "scene-0103"], roi) is None


def test_a_rendered_data_set_is_synthetic_and_lies_in_the_ocean(nuscenes_root):
    real = NuScenesSource(nuscenes_root)
    assert not real.synthetic
    assert real.open("scene-0061").georeference.name == "singapore-onenorth"
    (nuscenes_root / "demo_world.json").write_text('{"synthetic": true, "town_seed": 103}')
    rendered = NuScenesSource(nuscenes_root)
    assert rendered.synthetic
    ((longitude, latitude),) = rendered.open("scene-0061").georeference.to_wgs84(np.zeros((1, 2)))
    assert -50 < latitude < -40 and -124 < longitude < -121


def test_a_split_that_does_not_exist_is_an_error(nuscenes_root):
    with pytest.raises(UserError, match="no split 'vall'"):
        NuScenesSource(nuscenes_root).scenes("vall")


def test_a_missing_image_leaves_the_camera_in_the_rig(nuscenes_root):
    scene = NuScenesSource(nuscenes_root).open("scene-0061")
    scene.frame(0).images["CAM_BACK"].unlink()
    frame = scene.frame(0)
    assert "CAM_BACK" not in frame.images
    assert len(frame.rig) == 6


def test_a_missing_camera_record_leaves_the_camera_in_the_rig(nuscenes_root):
    def drop(records):
        records[:] = [record for record in records if "scene-0061-1-CAM_FRONT-" not in record["token"]]

    edit(nuscenes_root, "sample_data", drop)
    frame = NuScenesSource(nuscenes_root).open("scene-0061").frame(1)
    assert "CAM_FRONT" not in frame.images
    assert frame.rig[0].name == "CAM_FRONT"


@pytest.mark.parametrize(
    ("field", "value", "said"),
    [
        ("translation", [float("nan"), 0, 0], "nan|None"),
        ("rotation", [0.0, 0, 0, 0], "length 0"),
        ("rotation", [1.0, 1.0, 0, 0], "length 1.41421"),
        ("translation", [1.0, 2.0], "translation"),
    ],
)
def test_a_broken_pose_names_scene_frame_file_and_value(nuscenes_root, field, value, said):
    def spoil(records):
        for record in records:
            if record["token"] == "scene-0061-1-LIDAR_TOP-True":
                record[field] = value

    edit(nuscenes_root, "ego_pose", spoil)
    scene = NuScenesSource(nuscenes_root).open("scene-0061")
    scene.frame(0)
    with pytest.raises(UserError, match=rf"scene-0061, frame 1, .*ego_pose\.json: .*({said})"):
        scene.frame(1)


@pytest.mark.parametrize("table", ["scene", "sample", "sample_data", "ego_pose", "calibrated_sensor"])
@pytest.mark.parametrize("content", [b"", b'[\n{"token": "a', None])
def test_damaged_tables_are_named(nuscenes_root, table, content):
    path = nuscenes_root / "v1.0-mini" / f"{table}.json"
    if content is None:
        path.unlink()
    else:
        path.write_bytes(content)
    with pytest.raises(UserError, match=table):
        NuScenesSource(nuscenes_root).open("scene-0061")


def test_a_wrong_scene_name_offers_the_nearest(nuscenes_root):
    with pytest.raises(UserError, match=r"no scene 'scene-0130' .* Did you mean scene-0103"):
        NuScenesSource(nuscenes_root).open("scene-0130")


def test_a_damaged_map_is_an_error_and_a_missing_one_is_not(nuscenes_root):
    path = nuscenes_root / "maps" / "expansion" / "singapore-onenorth.json"
    path.write_text('{"version": "1.3", "node": []}')
    with pytest.raises(UserError, match=r"singapore-onenorth\.json is not a nuScenes map expansion"):
        NuScenesSource(nuscenes_root).open("scene-0061").truth_map()
    path.unlink()
    scene = NuScenesSource(nuscenes_root).open("scene-0061")
    assert scene.truth(0, RegionOfInterest()) is None
    assert scene.truth_map() is None


@pytest.mark.slow
def test_tables_of_trainval_size_open_in_seconds(write_nuscenes_data, tmp_path):
    """2.6 million sample_data and ego_pose records, of which 34,000 samples are key frames."""
    write_nuscenes_data(tmp_path, "v1.0-trainval", tuple(f"scene-{n:04d}" for n in range(1, 3)), frames=40)
    folder = tmp_path / "v1.0-trainval"
    filler = {
        "sample_data": '{\n"token": "%032x",\n"sample_token": "%032x",\n"ego_pose_token": "%032x",\n'
        '"calibrated_sensor_token": "calibration0",\n"timestamp": 1531883530449377,\n"fileformat": "jpg",\n'
        '"is_key_frame": %s,\n"height": 900,\n"width": 1600,\n'
        '"filename": "sweeps/CAM_FRONT/n015-2018-07-18-11-07-57+0800__CAM_FRONT__1531883530449377.jpg",\n'
        '"prev": "0af0feb5b1394b928dd13d648de898f5",\n"next": "07d23c3d1a1f4a8bbd9b6f3b4b6ee0a0"\n},\n',
        "ego_pose": '{\n"token": "%032x",\n"timestamp": 1531883530440378,\n"rotation": [\n-0.7504501527141022,\n'
        "0.0076295847961364415,\n0.00847103369020136,\n-0.6608287216181199\n],\n"
        '"translation": [\n1010.1328353833223,\n610.8111652918716,\n0.0\n]\n},\n',
    }
    records = 2_630_000
    for table, text in filler.items():
        path = folder / f"{table}.json"
        real = path.read_text()
        with path.open("w") as file:
            file.write("[\n")
            for number in range(records):
                if table == "sample_data":
                    # One record in six and a half is a key frame, as in the real tables.
                    flag = "true" if number % 13 < 2 else "false"
                    file.write(text % (number, number // 77, number, flag))
                else:
                    file.write(text % number)
            file.write(real.strip().removeprefix("["))
    size = sum((folder / f"{table}.json").stat().st_size for table in filler)
    start = time.process_time()
    scene = NuScenesSource(tmp_path).open("scene-0002")
    seconds = time.process_time() - start
    assert len(scene) == 40
    tracemalloc.start()
    NuScenesSource(tmp_path).open("scene-0001")
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    print(f"\n{size / 1e9:.2f} GB of tables: {seconds:.1f} s, {peak / 1e6:.0f} MB")
    assert seconds < 15
    assert peak < 500e6
