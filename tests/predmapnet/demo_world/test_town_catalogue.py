from hashlib import md5
from pathlib import Path

import numpy as np
import pytest
import shapely

from predmapnet.demo_world import catalogue
from predmapnet.demo_world.first_towns import first_town
from predmapnet.demo_world.rig import DEMO_RIG, LIDAR_TO_EGO
from predmapnet.demo_world.world import Look
from predmapnet.errors import UserError


def test_splits_share_no_town():
    numbers = [set(numbers) for numbers in catalogue.SPLITS.values()]
    assert sum(len(part) for part in numbers) == len(set.union(*numbers)) == 1020


def test_lists_what_users_can_name():
    names = [info.name for info in catalogue.scene_infos("test")]
    assert names == [f"scene-{number:04d}" for number in range(101, 111)]
    assert len(catalogue.scene_infos()) == 1020
    assert len(catalogue.scene_infos("train")) == 1000


@pytest.mark.parametrize("split", ["val", "test"])
def test_every_look_is_measured(split):
    assert {catalogue.look_of(info.name) for info in catalogue.scene_infos(split)} == set(Look)


def test_training_sees_every_look_about_as_often_as_said():
    looks = [catalogue.look_of(info.name) for info in catalogue.scene_infos("train")]
    for look, share in catalogue.LOOK_SHARES.items():
        assert abs(looks.count(look) / len(looks) - share) < 0.06


def test_the_scene_of_the_readme_is_a_day_scene():
    assert catalogue.look_of("scene-0103") is Look.DAY


@pytest.mark.parametrize(
    ("wrong", "near"),
    [("scene-103", "scene-0103"), ("scene-0193", "scene-0201"), ("Scene_0104", "scene-0104"), ("x", "scene-")],
)
def test_wrong_name_offers_the_nearest(wrong, near):
    with pytest.raises(UserError, match=near):
        catalogue.vector_map(wrong)


def test_wrong_split_lists_the_right_ones():
    with pytest.raises(UserError, match="train, val, test"):
        catalogue.scene_infos("trainval")


def test_cache_follows_the_environment(monkeypatch):
    monkeypatch.setenv("PREDMAPNET_CACHE", "/somewhere/else")
    assert catalogue.default_cache() == Path("/somewhere/else")
    folder = catalogue.scene_folder("scene-0103", catalogue.default_cache())
    assert folder == Path(f"/somewhere/else/demo-world-v{catalogue.WORLD_VERSION}/scene-0103")


def test_cameras_are_mirror_images_of_each_other():
    mirror_ego, mirror_camera = np.diag([1.0, -1.0, 1.0, 1.0]), np.diag([-1.0, 1.0, 1.0, 1.0])
    cameras = {camera.name: camera for camera in DEMO_RIG}
    for name, camera in cameras.items():
        twin = cameras[name.replace("LEFT", "*").replace("RIGHT", "LEFT").replace("*", "RIGHT")]
        np.testing.assert_allclose(mirror_ego @ camera.camera_to_ego @ mirror_camera, twin.camera_to_ego, atol=1e-15)
        np.testing.assert_array_equal(camera.intrinsics, twin.intrinsics)
        assert camera.intrinsics[0, 2] == camera.width / 2


def test_lidar_looks_ahead_with_its_y_axis():
    np.testing.assert_array_equal(LIDAR_TO_EGO[:3, :3] @ [0, 1, 0], [1, 0, 0])
    np.testing.assert_array_equal(LIDAR_TO_EGO[:3, :3] @ [1, 0, 0], [0, -1, 0])


def test_the_first_towns_are_still_what_they_were():
    names = [info.name for info in catalogue.scene_infos(edition=1)]
    assert names == [f"scene-{number:04d}" for number in range(101, 111)]
    for number in range(101, 111):
        vector_map, driven = first_town(number)
        parts = [*vector_map.road_segments, *vector_map.lanes, *vector_map.walkways]
        assert all(part.is_valid for part in (*parts, *(crossing.polygon for crossing in vector_map.crossings)))
        road = shapely.union_all(vector_map.road_segments)
        assert shapely.contains_xy(road, driven.ego_to_global[:, :2, 3]).all()
    vector_map, driven = first_town(103)
    assert len(vector_map.road_segments) == 21
    assert md5(np.round(driven.ego_to_global, 6).tobytes()).hexdigest() == "38f1369487702b6cb8eec962f6ff8e1e"


def test_three_of_five_towns_are_hilly_and_their_cars_stand_on_the_hills():
    hilly, flat = (catalogue.build_world(name) for name in ("scene-0103", "scene-0102"))
    assert flat.terrain is None and not flat.trajectory.ego_to_global[:, 2, 3].any()
    assert hilly.terrain is not None
    poses = hilly.trajectory.ego_to_global
    assert np.allclose(poses[:, 2, 3], hilly.terrain.heights(poses[:, :2, 3])) and np.ptp(poses[:, 2, 3]) > 0.5
    assert 0.55 < np.mean([catalogue._is_hilly(number) for number in catalogue.SPLITS["train"]]) < 0.65
