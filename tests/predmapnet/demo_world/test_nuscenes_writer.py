import errno
import json
from dataclasses import replace

import cv2
import numpy as np
import pytest
import shapely

from predmapnet.demo_world.catalogue import build_world, scene_folder, vector_map
from predmapnet.demo_world.nuscenes.map_expansion import build_expansion, draw_prior
from predmapnet.demo_world.nuscenes.tables import build_tables
from predmapnet.demo_world.nuscenes.writer import write_scene
from predmapnet.demo_world.rig import DEMO_RIG
from predmapnet.demo_world.world import Trajectory
from predmapnet.errors import UserError

TABLES = [
    "category",
    "attribute",
    "visibility",
    "instance",
    "sensor",
    "calibrated_sensor",
    "ego_pose",
    "log",
    "scene",
    "sample",
    "sample_data",
    "sample_annotation",
    "map",
]


@pytest.fixture(scope="module")
def world():
    return build_world("scene-0103")


@pytest.fixture(scope="module")
def short_world(world):
    """The first two key frames only: writing them takes seconds."""
    drive = world.trajectory
    return replace(world, trajectory=Trajectory(drive.timestamps[:2], drive.ego_to_global[:2]))


@pytest.fixture(scope="module")
def written(short_world, tmp_path_factory):
    folder = scene_folder("scene-0103", tmp_path_factory.mktemp("cache"))
    write_scene(short_world, folder, world_version=1)
    return folder


def test_tables_are_linked_without_a_gap(world):
    tables = build_tables(world, DEMO_RIG)
    assert sorted(tables) == sorted(TABLES)
    index = {name: {record["token"]: record for record in records} for name, records in tables.items()}
    for name, records in tables.items():
        assert len(index[name]) == len(records), f"{name} repeats a token"
        if name != "visibility":
            assert all(len(token) == 32 and int(token, 16) >= 0 for token in index[name])
    (scene,) = tables["scene"]
    assert scene["nbr_samples"] == len(tables["sample"]) == 40
    assert scene["log_token"] in index["log"]
    assert "demo world" in scene["description"]
    walk, token = [], scene["first_sample_token"]
    while token:
        sample = index["sample"][token]
        assert sample["prev"] == (walk[-1]["token"] if walk else "")
        walk.append(sample)
        token = sample["next"]
    assert walk[-1]["token"] == scene["last_sample_token"]
    assert np.all(np.diff([sample["timestamp"] for sample in walk]) == 500_000)
    assert len(tables["sample_data"]) == 40 * 7
    for data in tables["sample_data"]:
        assert data["timestamp"] == index["sample"][data["sample_token"]]["timestamp"]
        assert index["ego_pose"][data["ego_pose_token"]]["timestamp"] == data["timestamp"]
        sensor = index["calibrated_sensor"][data["calibrated_sensor_token"]]["sensor_token"]
        channel = index["sensor"][sensor]["channel"]
        assert f"/{channel}/" in data["filename"]
        if data["next"]:
            following = index["sample_data"][data["next"]]
            assert following["prev"] == data["token"]
            assert following["calibrated_sensor_token"] == data["calibrated_sensor_token"]


def test_poses_in_the_tables_are_those_of_the_drive(world):
    tables = build_tables(world, DEMO_RIG)
    poses = {record["token"]: record for record in tables["ego_pose"]}
    lidar = [data for data in tables["sample_data"] if "LIDAR_TOP" in data["filename"]]
    for data, expected in zip(lidar, world.trajectory.ego_to_global, strict=True):
        pose = poses[data["ego_pose_token"]]
        w, x, y, z = pose["rotation"]
        np.testing.assert_allclose(pose["translation"], expected[:3, 3])
        forward = [1 - 2 * (y * y + z * z), 2 * (x * y + z * w), 2 * (x * z - y * w)]
        np.testing.assert_allclose(forward, expected[:3, 0], atol=1e-12)


def test_map_expansion_holds_the_map_to_the_last_bit():
    truth = vector_map("scene-0103")
    content = build_expansion("scene-0103", truth)
    nodes = {node["token"]: (node["x"], node["y"]) for node in content["node"]}
    polygons = {polygon["token"]: polygon for polygon in content["polygon"]}
    lines = {line["token"]: line for line in content["line"]}

    def shape(record):
        polygon = polygons[record["polygon_token"]]
        holes = [[nodes[token] for token in hole["node_tokens"]] for hole in polygon["holes"]]
        return shapely.Polygon([nodes[token] for token in polygon["exterior_node_tokens"]], holes)

    for layer, expected in (
        ("road_segment", truth.road_segments),
        ("lane", truth.lanes),
        ("ped_crossing", [crossing.polygon for crossing in truth.crossings]),
        ("walkway", truth.walkways),
        ("stop_line", truth.stop_lines),
        ("carpark_area", truth.parking),
    ):
        assert [shape(record).wkb for record in content[layer]] == [polygon.wkb for polygon in expected]
    for layer, opposite in (("road_divider", True), ("lane_divider", False)):
        expected = [divider.points for divider in truth.dividers if divider.opposite is opposite]
        for record, points in zip(content[layer], expected, strict=True):
            np.testing.assert_array_equal(
                [nodes[token] for token in lines[record["line_token"]]["node_tokens"]], points
            )
    assert all(not record["is_intersection"] for record in content["road_segment"]) is False
    assert set(content["arcline_path_3"]) == {lane["token"] for lane in content["lane"]}


def test_prior_is_drawn_with_north_up():
    prior = draw_prior(vector_map("scene-0103"))
    point = vector_map("scene-0103").road_segments[0].representative_point()
    assert prior[int((800.0 - point.y) * 10), int(point.x * 10)] == 255
    assert prior[0, 0] == 0


def test_written_scene_is_complete(written, short_world):
    assert sorted(path.stem for path in (written / "v1.0-mini").iterdir()) == sorted(TABLES)
    tables = {name: json.loads((written / "v1.0-mini" / f"{name}.json").read_text()) for name in TABLES}
    assert len(tables["sample_data"]) == 14
    for data in tables["sample_data"]:
        path = written / data["filename"]
        if data["fileformat"] == "jpg":
            image = cv2.imread(str(path))
            assert image.shape == (450, 800, 3)
            assert image.std() > 10.0
        else:
            points = np.fromfile(path, np.float32).reshape(-1, 5)
            assert len(points) > 5000
            assert np.isfinite(points).all()
    assert (written / tables["map"][0]["filename"]).is_file()
    truth = json.loads((written / "demo_world.json").read_text())
    assert truth["synthetic"] is True
    assert truth["look"] == short_world.look
    assert truth["town_seed"] == 103
    assert [path.name for path in written.parent.iterdir()] == ["scene-0103"]


def test_the_same_world_gives_the_same_bytes(written, short_world, tmp_path):
    write_scene(short_world, tmp_path / "again", world_version=1)
    files = sorted(path.relative_to(written) for path in written.rglob("*") if path.is_file())
    assert files == sorted(
        path.relative_to(tmp_path / "again") for path in (tmp_path / "again").rglob("*") if path.is_file()
    )
    for file in files:
        assert (written / file).read_bytes() == (tmp_path / "again" / file).read_bytes(), file


def test_ctrl_c_leaves_nothing_behind(short_world, tmp_path):
    def interrupt(done, total, what):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_scene(short_world, tmp_path / "cache" / "scene", world_version=1, progress=interrupt)
    assert list((tmp_path / "cache").iterdir()) == []


def test_a_slower_process_keeps_the_scene_of_the_faster_one(short_world, tmp_path):
    def be_overtaken(done, total, what):
        (tmp_path / "scene").mkdir(exist_ok=True)
        (tmp_path / "scene" / "first").touch()

    write_scene(short_world, tmp_path / "scene", world_version=1, progress=be_overtaken)
    assert [path.name for path in tmp_path.rglob("*")] == ["scene", "first"]


def test_a_cache_that_cannot_be_written_is_the_users_to_mend(short_world, tmp_path):
    (tmp_path / "file").touch()
    with pytest.raises(UserError, match="PREDMAPNET_CACHE"):
        write_scene(short_world, tmp_path / "file" / "scene", world_version=1)


def test_a_full_disk_is_reported_and_cleaned_up(short_world, tmp_path):
    def fill_up(done, total, what):
        raise OSError(errno.ENOSPC, "No space left on device")

    with pytest.raises(UserError, match="No space left"):
        write_scene(short_world, tmp_path / "scene", world_version=1, progress=fill_up)
    assert list(tmp_path.iterdir()) == []
