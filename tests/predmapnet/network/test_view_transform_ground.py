"""The look-up from image features to the ground, against plain projection."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from predmapnet.demo_world.rig import DEMO_RIG
from predmapnet.network.image_input import crop_image, image_window, mirror_order, mirror_rig
from predmapnet.network.layers import cell_centres
from predmapnet.network.small.backbone import STRIDE
from predmapnet.network.small.ground_lookup import make_rig_lookup, to_ground
from predmapnet.presets import preset

CONFIG = preset("lite")
LOOKUP = make_rig_lookup(DEMO_RIG, CONFIG)
CELLS = (cell_centres(*LOOKUP.grid).double().numpy() - 0.5) * CONFIG.roi.size
EVERYWHERE = torch.ones(1, len(DEMO_RIG), dtype=torch.bool)


def project(ground, camera):
    """Pixels (u, v) of ground points in the stored image, and depth."""
    points = np.column_stack([ground, np.zeros(len(ground)), np.ones(len(ground))])
    in_camera = (points @ np.linalg.inv(camera.camera_to_ego).T)[:, :3]
    pixels = in_camera @ camera.intrinsics.T
    return pixels[:, :2] / pixels[:, 2:], in_camera[:, 2]


def test_features_that_say_where_they_are_arrive_where_projection_puts_them():
    rows, columns = LOOKUP.feature_size
    v, u = torch.meshgrid(torch.arange(rows) + 0.5, torch.arange(columns) + 0.5, indexing="ij")
    features = (torch.stack([u, v]) * STRIDE).expand(1, len(DEMO_RIG), 2, rows, columns)
    alone = LOOKUP.visible.sum(dim=1) == 1
    ground = to_ground(features, EVERYWHERE, LOOKUP)[0].flatten(1).T
    for number, camera in enumerate(DEMO_RIG):
        seen = (alone & (LOOKUP.visible[:, number] == 1)).numpy()
        expected, _ = project(CELLS.reshape(-1, 2)[seen], camera)
        window = image_window(camera, CONFIG.image)
        expected = expected * window.scaled_width / camera.width - [0, window.top]
        inner = ((expected > 2) & (expected < [CONFIG.image.width - 2, CONFIG.image.height - 2])).all(axis=1)
        assert inner.sum() > 500
        np.testing.assert_allclose(ground[seen][inner], expected[inner], atol=2e-3)


@pytest.mark.parametrize(("camera", "point"), [(0, (9.0, 0.7)), (3, (-8.0, -1.5)), (4, (-1.0, 6.0)), (1, (7.0, -6.0))])
def test_a_bright_spot_on_the_ground_lights_the_cell_below_it(camera, point):
    pixels, _ = project(np.array([point]), DEMO_RIG[camera])
    image = np.zeros((450, 800, 3), np.uint8)
    column, row = pixels[0].astype(int)
    image[row - 2 : row + 3, column - 2 : column + 3] = 255
    window = crop_image(image, DEMO_RIG[camera], CONFIG.image)
    features = torch.zeros(1, len(DEMO_RIG), 1, CONFIG.image.height // STRIDE, CONFIG.image.width // STRIDE)
    pooled = torch.nn.functional.avg_pool2d(torch.from_numpy(window[..., 0]).float()[None], STRIDE)
    features[0, camera, 0] = pooled[0]
    ground = to_ground(features, EVERYWHERE, LOOKUP)[0, 0].double().numpy()
    centre = (CELLS * ground[..., None]).sum(axis=(0, 1)) / ground.sum()
    np.testing.assert_allclose(centre, point, atol=0.7)  # half of what one feature pixel covers there


def test_mean_over_valid_cameras_only_and_nothing_where_none_looks():
    features = torch.arange(1.0, len(DEMO_RIG) + 1).reshape(1, -1, 1, 1, 1).expand(1, -1, 1, *LOOKUP.feature_size)
    valid = torch.tensor([[True, True, False, True, False, True]])
    ground = to_ground(features, valid, LOOKUP)[0, 0].flatten()
    looking = LOOKUP.visible * valid
    expected = (looking @ torch.arange(1.0, 7.0)) / looking.sum(dim=1).clamp(min=1)
    assert (looking.sum(dim=1) == 0).any() and (looking.sum(dim=1) == 2).any()
    torch.testing.assert_close(ground, expected)


def test_the_backward_pass_is_the_transpose_of_the_forward_pass():
    generator = torch.Generator().manual_seed(0)
    shape = (2, len(DEMO_RIG), 3, *LOOKUP.feature_size)
    features = torch.randn(shape, generator=generator, requires_grad=True)
    probe = torch.randn(2, 3, *LOOKUP.grid, generator=generator)
    direction = torch.randn(shape, generator=generator)
    (to_ground(features, EVERYWHERE.expand(2, -1), LOOKUP) * probe).sum().backward()
    forward = (to_ground(direction, EVERYWHERE.expand(2, -1), LOOKUP) * probe).double().sum()
    torch.testing.assert_close((features.grad * direction).double().sum(), forward, rtol=1e-4, atol=1e-2)


def test_flipped_images_of_the_symmetric_rig_show_the_mirrored_ground():
    order = mirror_order(DEMO_RIG)
    assert order is not None
    features = torch.rand(1, len(DEMO_RIG), 2, *LOOKUP.feature_size)
    ground = to_ground(features, EVERYWHERE, LOOKUP)
    mirrored = to_ground(features[:, list(order)].flip(-1), EVERYWHERE, LOOKUP)
    torch.testing.assert_close(mirrored, ground.flip(2), atol=1e-4, rtol=0)


def test_a_lopsided_rig_has_a_mirror_rig_but_no_mirror_order():
    pose = DEMO_RIG[1].camera_to_ego.copy()
    pose[:3, 3] += [0.3, 0.1, 0.0]
    rig = (DEMO_RIG[0], replace(DEMO_RIG[1], camera_to_ego=pose), *DEMO_RIG[2:])
    assert mirror_order(rig) is None
    features = torch.rand(1, len(rig), 2, *LOOKUP.feature_size)
    ground = to_ground(features, EVERYWHERE, make_rig_lookup(rig, CONFIG))
    mirrored = to_ground(features.flip(-1), EVERYWHERE, make_rig_lookup(mirror_rig(rig), CONFIG))
    torch.testing.assert_close(mirrored, ground.flip(2), atol=1e-4, rtol=0)


def test_the_window_follows_the_horizon_of_a_pitched_camera_and_stays_in_the_image():
    level = DEMO_RIG[0]
    angle = np.radians(5.0)
    down = np.array([[1, 0, 0], [0, np.cos(angle), np.sin(angle)], [0, -np.sin(angle), np.cos(angle)]])
    pose = level.camera_to_ego.copy()
    pose[:3, :3] = pose[:3, :3] @ down
    pitched = replace(level, camera_to_ego=pose)
    focal = level.intrinsics[1, 1] * CONFIG.image.width / level.width
    shift = image_window(level, CONFIG.image).top - image_window(pitched, CONFIG.image).top
    assert abs(abs(shift) - focal * np.tan(angle)) <= 1.0
    window = image_window(replace(level, height=200), CONFIG.image)
    assert window.top == 0
    assert crop_image(np.full((200, 800, 3), 9, np.uint8), replace(level, height=200), CONFIG.image)[-1].max() == 0
