"""Calibration is an input of every frame: any cars, cameras and orders of cameras, mixed in a batch."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from predmapnet.datasets.argoverse2_files import ARGOVERSE2_CAMERAS
from predmapnet.datasets.nuscenes_tables import NUSCENES_CAMERAS
from predmapnet.demo_world.rig import DEMO_RIG
from predmapnet.errors import UserError
from predmapnet.network.calibration import calibrate, collate_calibrations, pad_cameras
from predmapnet.network.small.backbone import STRIDE
from predmapnet.network.small.ground_lookup import find_on_ground, ground_points, to_ground
from predmapnet.network.state import FrameInputs
from tests.predmapnet.small_networks import small_config, small_network


def moved(rig, metres):
    """The rig higher above the road, looking further down."""
    cameras = []
    for camera in rig:
        pose = camera.camera_to_ego.copy()
        pose[2, 3] += metres
        angle = 0.1 * metres
        pose[:3, :3] = pose[:3, :3] @ [[1, 0, 0], [0, np.cos(angle), np.sin(angle)], [0, -np.sin(angle), np.cos(angle)]]
        cameras.append(replace(camera, camera_to_ego=pose, intrinsics=camera.intrinsics * [[1.1], [1.1], [1]]))
    return tuple(cameras)


CARS = (DEMO_RIG, moved(DEMO_RIG, 0.8)[2:4], DEMO_RIG[:1])


def network_and_config(name, **sections):
    bev = {} if name == "lite" else {"cameras": NUSCENES_CAMERAS}
    return small_network(small_config(name, **{"bev": bev, **sections}))


def inputs_of(rig, config, seed=0):
    generator = torch.Generator().manual_seed(seed)
    image = config.image
    images = torch.randn(1, len(rig), 3, image.height, image.width, generator=generator)
    pose = torch.eye(4, dtype=torch.float64)[None]
    return FrameInputs(images, torch.ones(1, len(rig), dtype=torch.bool), pose, calibrate(rig, config))


def in_one_batch(frames, padding=0.0):
    cameras = max(frame.images.shape[1] for frame in frames)
    images = torch.full((len(frames), cameras, *frames[0].images.shape[2:]), padding)
    for whole, frame in zip(images, frames, strict=True):
        whole[: frame.images.shape[1]] = frame.images[0]
    return FrameInputs(
        images=images,
        camera_valid=pad_cameras([frame.camera_valid[0].numpy() for frame in frames]),
        ego_to_global=torch.cat([frame.ego_to_global for frame in frames]),
        calibration=collate_calibrations([frame.calibration for frame in frames]),
    )


@pytest.mark.parametrize("name", ["lite", "paper-nuscenes"])
@torch.no_grad()
def test_cars_in_one_batch_see_what_each_sees_alone(name):
    network = network_and_config(name)
    frames = [inputs_of(rig, network.config, seed) for seed, rig in enumerate(CARS)]
    for padding in (0.0, torch.nan):
        together = network(in_one_batch(frames, padding))
        for number, frame in enumerate(frames):
            alone = network(frame)
            torch.testing.assert_close(together.segmentation[number], alone.segmentation[0], rtol=1e-4, atol=1e-5)
            torch.testing.assert_close(
                together.layers[-1].points[number], alone.layers[-1].points[0], rtol=1e-4, atol=1e-5
            )


@torch.no_grad()
def test_lite_takes_one_to_eight_cameras_of_any_name_in_any_order():
    network = network_and_config("lite")
    eight = tuple(replace(camera, name=f"c{i}") for i, camera in enumerate(DEMO_RIG + moved(DEMO_RIG, 0.3)[:2]))
    for count in range(1, 9):
        frame = inputs_of(eight[:count], network.config)
        outputs = network(frame)
        order = torch.arange(count).flip(0)
        turned = FrameInputs(
            frame.images[:, order],
            frame.camera_valid,
            frame.ego_to_global,
            calibrate(tuple(eight[i] for i in order), network.config),
        )
        assert torch.isfinite(outputs.segmentation).all()
        torch.testing.assert_close(network(turned).segmentation, outputs.segmentation, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("name", ["lite", "paper-nuscenes"])
@torch.no_grad()
def test_the_network_looks_where_the_calibration_says(name):
    network = network_and_config(name)
    frame = inputs_of(DEMO_RIG, network.config)
    expected = network(frame).segmentation
    known = network(frame, geometry=network.view_geometry(frame.calibration)).segmentation
    assert torch.equal(known, expected)
    other = replace(frame, calibration=calibrate(moved(DEMO_RIG, 0.5), network.config))
    assert (network(other).segmentation - expected).abs().max() > 0.01


@pytest.mark.parametrize("name", ["lite", "paper-nuscenes"])
def test_padding_and_lost_cameras_do_not_enter_batch_statistics(name):
    frames = [inputs_of(rig, network_and_config(name).config, seed) for seed, rig in enumerate(CARS)]
    frames[0].camera_valid[0, 2] = False
    batch = in_one_batch(frames)
    padded, packed = network_and_config(name).train(), network_and_config(name).train()
    padded.encode_images(batch)
    packed.image_backbone(batch.images[batch.camera_valid].contiguous(memory_format=torch.channels_last))
    for ours, expected in zip(padded.image_backbone.buffers(), packed.image_backbone.buffers(), strict=True):
        torch.testing.assert_close(ours, expected)


def test_codes_of_cameras_are_found_by_name_and_unknown_cameras_are_named():
    config = small_config("paper-nuscenes", bev={"cameras": NUSCENES_CAMERAS})
    turned = DEMO_RIG[3:] + DEMO_RIG[:3]
    assert calibrate(turned, config).camera_code.tolist() == [[3, 4, 5, 0, 1, 2]]
    others = small_config("paper-nuscenes", bev={"cameras": ARGOVERSE2_CAMERAS})
    with pytest.raises(UserError, match=r"each of 7 cameras .*but this car has CAM_FRONT, .*which they do not know"):
        calibrate(DEMO_RIG, others)


@torch.no_grad()
def test_a_network_that_looks_at_further_heights_starts_as_the_one_that_does_not():
    flat = network_and_config("lite", bev={"further_heights": ()})
    raised = network_and_config("lite", bev={"further_heights": (-0.5, 0.5)})
    missing, unexpected = raised.load_state_dict(flat.state_dict(), strict=False)
    assert (missing, unexpected) == (["bev_encoder.heights.weight"], [])
    torch.nn.init.zeros_(raised.bev_encoder.heights.weight)
    frame = inputs_of(DEMO_RIG, flat.config)
    assert torch.equal(raised(frame).segmentation, flat(frame).segmentation)
    torch.nn.init.normal_(raised.bev_encoder.heights.weight)
    assert not torch.equal(raised(frame).segmentation, flat(frame).segmentation)


@torch.no_grad()
def test_each_height_has_weights_of_its_own():
    encoder = network_and_config("lite", bev={"further_heights": (-0.5, 0.5)}).bev_encoder
    config = small_config("lite")
    grid, channels = (config.bev.rows, config.bev.columns), config.bev.backbone.channels
    calibration = calibrate(DEMO_RIG, config)
    size = (config.image.height, config.image.width)
    features = torch.randn(1, len(DEMO_RIG), channels, size[0] // STRIDE, size[1] // STRIDE)
    valid = torch.ones(1, len(DEMO_RIG), dtype=torch.bool)
    found = to_ground(features, valid, encoder.geometry(calibration, size))
    encoder.heights.weight.zero_()
    road = encoder._combined(found)
    for number, height in enumerate((-0.5, 0.5)):
        encoder.heights.weight.zero_()
        encoder.heights.weight[:channels, number * channels : (number + 1) * channels] = torch.eye(channels)
        there = find_on_ground(ground_points(grid, height, config.roi), calibration, features.shape[-2:], STRIDE)
        expected = to_ground(features, valid, there)[0].T.unflatten(1, grid)
        added = (encoder._combined(found) - road)[0]
        torch.testing.assert_close(added[:channels], expected, rtol=1e-4, atol=1e-4)
        assert added[channels:].abs().max() < 1e-5
