"""Image input: the pixels that reach the network, and the projection of road points into them."""

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from pyarrow import feather
from pydantic import ValidationError

from mapfusion.geometry import inverse_pose
from predmapnet.config import ImageWindowConfig, PredMapNetConfig, WholeImageConfig
from predmapnet.datasets.argoverse2 import GROUND_HEIGHT, Argoverse2Source
from predmapnet.datasets.images import read_image
from predmapnet.datasets.nuscenes import NuScenesSource
from predmapnet.demo_world.rig import DEMO_RIG
from predmapnet.network.calibration import calibrate
from predmapnet.network.image_input import (
    crop_image,
    ego_to_image,
    image_window,
    input_size,
    normalise_images,
    stack_windows,
)
from predmapnet.network.maptracker.reference_points import pillar_points, project_pillars
from predmapnet.network.predmapnet import PredMapNet
from predmapnet.presets import preset
from predmapnet.scenes import Camera
from tests.predmapnet.network.maptracker_reference import FOLDER

WHOLE = WholeImageConfig()
ARGOVERSE = WholeImageConfig(width=608, height=608)
RANDOM = np.random.default_rng(5)


def fixture(*parts: str) -> Path:
    path = FOLDER.parent.joinpath("ground_truth", *parts)
    if not path.exists():
        pytest.skip(f"no reference fixtures at {path}: set PREDMAPNET_REFERENCE")
    return path


def camera(width: int, height: int) -> Camera:
    return replace(DEMO_RIG[0], width=width, height=height)


def stretched(image: np.ndarray, rows: int, columns: int) -> np.ndarray:
    """Bilinear interpolation between pixel centres, in floating point, written out."""
    image = image.astype(np.float64)
    for axis, size in enumerate((rows, columns)):
        count = image.shape[axis]
        place = np.clip((np.arange(size) + 0.5) * count / size - 0.5, 0, count - 1)
        low = np.floor(place).astype(int)
        high = np.minimum(low + 1, count - 1)
        share = (place - low).reshape(-1, *[1] * (2 - axis))
        image = (1 - share) * image.take(low, axis) + share * image.take(high, axis)
    return image


def test_maptracker_takes_whole_images_stretched_without_rounding_or_averaging():
    image = RANDOM.integers(0, 256, (90, 160, 3), dtype=np.uint8)
    small = WholeImageConfig(width=80, height=48)
    window = crop_image(image, camera(160, 90), small)
    assert window.dtype == np.float32
    np.testing.assert_allclose(window, stretched(image, 48, 80), atol=2e-3)
    assert np.abs(window - np.rint(window)).max() > 0.4


def test_an_upright_front_camera_is_stretched_to_the_same_square_as_the_others():
    upright, lying = camera(1550, 2048), camera(2048, 1550)
    for shape in (upright, lying):
        image = np.zeros((shape.height, shape.width, 3), np.uint8)
        image[shape.height // 4 :] = 200
        window = crop_image(image, shape, ARGOVERSE)
        assert window.shape == (608, 608, 3)
        assert (window[:151] == 0).all() and (window[153:] == 200).all()


def test_maptracker_takes_blue_green_red_less_a_mean_and_zeros_at_the_margin():
    small = WholeImageConfig(width=70, height=33)
    images = torch.tensor([10.0, 20.0, 30.0]).expand(2, 33, 70, 3)
    prepared = normalise_images(images, small)
    assert input_size(small) == tuple(prepared.shape[-2:]) == (64, 96)
    expected = torch.tensor([30 - 103.53, 20 - 116.28, 10 - 123.675])
    torch.testing.assert_close(prepared[:, :, :33, :70], expected[None, :, None, None].expand(2, 3, 33, 70))
    assert (prepared[:, :, 33:] == 0).all() and (prepared[:, :, :, 70:] == 0).all()
    assert input_size(WHOLE) == (480, 800) and input_size(ARGOVERSE) == (608, 608)


def test_a_window_is_red_green_blue_of_mean_nought_and_deviation_one():
    config = ImageWindowConfig()
    grey = torch.tensor(config.mean).mul(255).expand(1, 96, 256, 3)
    assert normalise_images(grey, config).abs().max() < 1e-5
    brighter = normalise_images(grey + 255 * torch.tensor(config.deviation), config)
    torch.testing.assert_close(brighter, torch.ones(1, 3, 96, 256))


def test_a_camera_without_an_image_is_black_and_told():
    picture = np.full((450, 800, 3), 7, np.uint8)
    for config in (WholeImageConfig(width=64, height=32), ImageWindowConfig(width=64, height=24)):
        windows, valid = stack_windows({"CAM_FRONT": picture}, DEMO_RIG, config)
        assert valid.tolist() == [name.name == "CAM_FRONT" for name in DEMO_RIG]
        assert (windows[valid] == 7).all() and (windows[~valid] == 0).all()


def test_a_kind_of_image_input_that_does_not_exist_is_named():
    with pytest.raises(ValidationError, match="'fisheye' found using"):
        PredMapNetConfig.model_validate({"image": {"kind": "fisheye"}})
    assert PredMapNetConfig.model_validate({"image": {"kind": "whole"}}).image == WHOLE
    assert PredMapNetConfig.model_validate({"image": {"width": 64}}).image == ImageWindowConfig(width=64)


@given(
    config=st.one_of(
        st.builds(WholeImageConfig, width=st.integers(8, 900), height=st.integers(8, 900)),
        st.builds(ImageWindowConfig, width=st.integers(64, 900), height=st.integers(16, 200)),
    ),
    point=st.tuples(st.floats(-25, 25), st.floats(-14, 14), st.floats(-2.5, 4.5)),
)
@settings(max_examples=60, deadline=None)
def test_a_point_is_found_where_the_stored_image_has_it_scaled_and_cut(config, point):
    for one, matrix in zip(DEMO_RIG, ego_to_image(DEMO_RIG, config), strict=True):
        stored = one.intrinsics @ (inverse_pose(one.camera_to_ego) @ [*point, 1.0])[:3]
        found = matrix @ [*point, 1.0]
        np.testing.assert_allclose(found[2:], [stored[2], 1.0])
        window = image_window(one, config)
        scale = np.array([window.scaled_width / one.width, window.scaled_height / one.height])
        np.testing.assert_allclose(
            found[:2], stored[:2] * scale - [0, window.top * stored[2]], rtol=1e-9, atol=1e-6 * (1 + abs(stored[2]))
        )


@pytest.mark.reference
def test_projections_of_the_real_car_are_the_official_ones():
    sample = json.loads(fixture("nuscenes_sample", "get_sample.json").read_text())
    source = NuScenesSource(fixture("nuscenes_sample"))
    frame = source.open(source.scenes()[0].name).frame(0)
    np.testing.assert_allclose(frame.ego_to_global[:3, 3], sample["ego2global_translation"], atol=1e-9)
    np.testing.assert_allclose(frame.ego_to_global[:3, :3], sample["ego2global_rotation"], atol=1e-12)
    assert [one.name for one in frame.rig] == [name.split("/")[1] for name in sample["img_filenames"]]
    official = np.diag([800 / 1600, 480 / 900, 1.0, 1.0]) @ np.array(sample["ego2img"])
    ours = ego_to_image(frame.rig, WHOLE)
    np.testing.assert_allclose(ours, official, atol=1e-9)

    config = preset("maptracker-nuscenes")
    pillars = pillar_points(config.bev, config.roi)
    positions, hits = project_pillars(torch.from_numpy(ours), input_size(WHOLE), pillars)
    expected, expected_hits = project_pillars(torch.from_numpy(official), input_size(WHOLE), pillars)
    assert torch.equal(hits, expected_hits)
    torch.testing.assert_close(positions[hits], expected[hits], rtol=0, atol=1e-6)


@pytest.mark.reference
def test_the_road_ahead_stands_in_the_upright_front_camera_of_argoverse():
    log = fixture("av2", "logs", "7fab2350-7eaf-3b7e-a39d-6937a4c1bede")
    source = Argoverse2Source(log)
    rig = source.open(log.name).rig
    front = rig[0]
    assert (front.name, front.width, front.height) == ("ring_front_center", 1550, 2048)
    assert all((one.width, one.height) == (2048, 1550) for one in rig[1:])
    table = feather.read_table(log / "calibration" / "intrinsics.feather").to_pylist()
    (known,) = (row for row in table if row["sensor_name"] == "ring_front_center")
    matrices = ego_to_image(rig, ARGOVERSE)
    for distance in (6.0, 12.0, 24.0):
        u, v, depth, _ = matrices[0] @ [distance, 0.0, GROUND_HEIGHT, 1.0]
        below = front.camera_to_ego[2, 3] - GROUND_HEIGHT
        assert depth == pytest.approx(distance - front.camera_to_ego[0, 3], abs=0.1)
        # A level camera in the middle of the car: by the rule of three, scaled by 608 / 1550 and 608 / 2048.
        assert u / depth == pytest.approx(known["cx_px"] * 608 / 1550, abs=6)
        assert v / depth == pytest.approx((known["cy_px"] + known["fy_px"] * below / depth) * 608 / 2048, abs=6)
    config = preset("paper-av2")
    _, hits = project_pillars(torch.from_numpy(matrices), input_size(ARGOVERSE), pillar_points(config.bev, config.roi))
    seen = hits.any(dim=-1)
    assert (seen.float().mean(dim=1) > 0.05).all() and seen.any(dim=0).float().mean() > 0.95


@pytest.mark.reference
def test_real_photographs_arrive_as_the_official_chain_prepares_them():
    source = NuScenesSource(fixture("nuscenes_sample"))
    frame = source.open(source.scenes()[0].name).frame(0)
    images = {name: read_image(path) for name, path in frame.images.items()}
    windows, valid = stack_windows(images, frame.rig, WHOLE)
    prepared = normalise_images(torch.from_numpy(windows), WHOLE)
    assert valid.all() and prepared.shape == (6, 3, 480, 800)
    for one, ours in zip(frame.rig, prepared, strict=True):
        # Read as blue, green, red; stretched as floating-point numbers; the mean taken off last.
        official = cv2.imread(str(frame.images[one.name]), cv2.IMREAD_COLOR).astype(np.float32)
        official = stretched(official, 480, 800) - [103.530, 116.280, 123.675]
        np.testing.assert_allclose(ours.permute(1, 2, 0), official, atol=2e-3)


def test_a_rig_whose_origin_lies_above_the_road_sees_the_same_road():
    config = PredMapNetConfig()
    raised = tuple(replace(one, camera_to_ego=one.camera_to_ego.copy(), ground_height=-0.4) for one in DEMO_RIG)
    for one in raised:
        one.camera_to_ego[2, 3] -= 0.4
    find = PredMapNet(config).view_geometry
    lookup, expected = find(calibrate(raised, config)), find(calibrate(DEMO_RIG, config))
    assert torch.equal(lookup.visible, expected.visible)
    assert torch.equal(lookup.gather.columns, expected.gather.columns)
    torch.testing.assert_close(lookup.gather.weights, expected.gather.weights)
    forgotten = find(calibrate(tuple(replace(one, ground_height=0.0) for one in raised), config))
    assert not torch.equal(forgotten.visible, expected.visible)


@pytest.mark.reference
def test_roads_of_argoverse_lie_where_its_rig_says():
    logs = fixture("av2", "logs")
    heights = []
    for archive in sorted(logs.glob("*/map/log_map_archive_*.json")):
        lanes = json.loads(archive.read_text())["lane_segments"].values()
        sides = ("left_lane_boundary", "right_lane_boundary")
        points = np.array([[p["x"], p["y"], p["z"]] for lane in lanes for side in sides for p in lane[side]])
        source = Argoverse2Source(archive.parents[1])
        scene = source.open(source.scenes()[0].name)
        for index in range(len(scene)):
            pose = inverse_pose(scene.pose(index))
            local = points @ pose[:3, :3].T + pose[:3, 3]
            heights.extend(local[np.hypot(local[:, 0] - 1.5, local[:, 1]) < 2.5, 2])
    assert len(heights) > 50
    assert np.median(heights) == pytest.approx(GROUND_HEIGHT, abs=0.02)
