"""Training drives over real road maps: the same for the same seed, each a log whose images, poses and truth fit."""

import json
from dataclasses import replace

import numpy as np
import pytest
import shapely

from predmapnet.datasets.own_logs.log_check import check_log
from predmapnet.datasets.own_logs.scene import LogScene
from predmapnet.demo_world.rig import LIDAR_TO_EGO
from predmapnet.demo_world.rigs import sample_rig
from predmapnet.errors import UserError
from tests.real_roads.training_drives import draw_all, drive_names, main, map_near, road_drives, world_of, write_drive


@pytest.fixture(scope="module")
def bare_map(tmp_path_factory):
    """Two streets that cross, and nothing painted on them."""
    ends = [[-150, -6], [-5, -6], [-5, -150], [5, -150], [5, -6], [150, -6]]
    content = {
        "road_segments": [{"exterior": ends + [[-x, -y] for x, y in ends], "holes": []}],
        "driveways": [],
        "dividers": [],
    }
    path = tmp_path_factory.mktemp("maps") / "cross.json"
    path.write_text(json.dumps(content))
    return path


@pytest.fixture(scope="module")
def drives(bare_map):
    return list(road_drives(bare_map, 2, 0))


def test_drives_stay_on_the_road_and_come_again_with_their_seed(bare_map, drives):
    assert [drive.name for drive in drives] == drive_names(bare_map, 2, 0) == ["cross-0-1", "cross-0-2"]
    for drive, again in zip(drives, road_drives(bare_map, 2, 0), strict=True):
        np.testing.assert_array_equal(drive.trajectory.ego_to_global, again.trajectory.ego_to_global)
        road = shapely.union_all(drive.painted.road_segments).buffer(0.2)
        assert road.contains(shapely.LineString(drive.trajectory.ego_to_global[:, :2, 3]))
    other = next(road_drives(bare_map, 1, 1))
    assert other.name == "cross-1-1" and other.seed != drives[0].seed


def test_a_map_is_cut_down_to_what_is_near(drives):
    area = shapely.box(20, -40, 60, 40)
    near = map_near(drives[0].painted, area)
    assert shapely.union_all(near.road_segments).bounds == (20.0, -6.0, 60.0, 6.0)
    lines = drives[0].painted.dividers
    assert len(near.dividers) == sum(shapely.LineString(line.points).intersects(area) for line in lines) < len(lines)


@pytest.fixture(scope="module")
def written(drives, tmp_path_factory):
    """A drive of two frames and its folder."""
    whole = drives[0].trajectory
    short = replace(whole, timestamps=whole.timestamps[:2], ego_to_global=whole.ego_to_global[:2])
    drive = replace(drives[0], trajectory=short)
    folder = tmp_path_factory.mktemp("train") / drive.name
    write_drive(drive, folder)
    return drive, folder


def test_a_drive_is_a_log_whose_cameras_stand_where_they_were_drawn(written):
    drive, folder = written
    log, _ = check_log(folder, 2.0)
    assert log is not None and len(log) == 2
    rig = {camera.name: camera for camera in sample_rig(drive.seed)}
    car_to_global = world_of(drive).trajectory.ego_to_global
    for index in range(2):
        frame = log.frame(index)
        for read in frame.rig:
            drawn = rig[read.name]
            lift = np.eye(4)
            lift[2, 3] = -drawn.ground_height
            expected = car_to_global[index] @ lift @ drawn.camera_to_ego
            np.testing.assert_allclose(frame.ego_to_global @ read.camera_to_ego, expected, atol=1e-3)
            assert read.ground_height == pytest.approx(drawn.ground_height, abs=1e-6)
            assert read.width <= 768
            share = read.width / drawn.width
            assert read.intrinsics[0, 0] == pytest.approx(drawn.intrinsics[0, 0] * share, rel=1e-6)


def test_its_truth_are_the_lines_that_it_passes(written):
    drive, folder = written
    truth = LogScene(folder).truth_map()
    assert truth is not None
    kerb = shapely.boundary(shapely.union_all(drive.true_map.road_segments))
    here = shapely.points((drive.trajectory.ego_to_global @ LIDAR_TO_EGO)[:, :2, 3])
    boundaries = [element for element in truth.elements if element.kind.label == "boundary"]
    assert boundaries
    for element in boundaries:
        assert shapely.distance(kerb, shapely.points(element.points)).max() < 0.3
    assert max(shapely.distance(here[0], shapely.points(element.points)).max() for element in boundaries) < 40.0


def test_what_is_no_map_is_told(tmp_path, capsys, monkeypatch):
    with pytest.raises(UserError, match="no road maps"):
        draw_all(tmp_path, tmp_path / "out", 1, 0)
    maps = tmp_path / "road_geometry" / "train"
    maps.mkdir(parents=True)
    (maps / "broken.json").write_text("[1")
    monkeypatch.setenv("PREDMAPNET_REFERENCE", str(tmp_path))
    assert main([str(tmp_path / "out")]) == 2
    assert "broken.json is no road map" in capsys.readouterr().err
