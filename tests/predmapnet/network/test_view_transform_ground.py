"""The look-up from image features to the ground, against plain projection."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from predmapnet.demo_world.rig import DEMO_RIG
from predmapnet.network.calibration import calibrate, collate_calibrations
from predmapnet.network.image_input import crop_image, image_window
from predmapnet.network.layers import cell_centres
from predmapnet.network.small.backbone import STRIDE
from predmapnet.network.small.ground_lookup import SparseRows, find_on_ground, ground_points, row_starts, to_ground
from predmapnet.presets import preset
from tests.predmapnet.network.mirrored_rig import mirror_rig

CONFIG = preset("lite")
GRID = (100, 200)
SIZE = (CONFIG.image.height // STRIDE, CONFIG.image.width // STRIDE)
CELLS = (cell_centres(*GRID).double().numpy() - 0.5) * CONFIG.roi.size


def look_up(rig, height=0.0, batch=1):
    calibration = collate_calibrations([calibrate(rig, CONFIG)] * batch)
    return find_on_ground(ground_points(GRID, height, CONFIG.roi), calibration, SIZE, STRIDE)


def on_grid(features, valid, lookup):
    """Features ``(B, C, rows, columns)`` on the ground."""
    return to_ground(features, valid, lookup).transpose(1, 2).unflatten(2, GRID)


LOOKUP = look_up(DEMO_RIG)
VISIBLE = LOOKUP.visible[0]
EVERYWHERE = torch.ones(1, len(DEMO_RIG), dtype=torch.bool)


def project(ground, camera, height=0.0):
    """Pixels (u, v) of ground points in the stored image, and depth."""
    points = np.column_stack([ground, np.full(len(ground), height), np.ones(len(ground))])
    in_camera = (points @ np.linalg.inv(camera.camera_to_ego).T)[:, :3]
    pixels = in_camera @ camera.intrinsics.T
    return pixels[:, :2] / pixels[:, 2:], in_camera[:, 2]


@pytest.mark.parametrize("height", [0.0, -0.5, 0.7])
def test_features_that_say_where_they_are_arrive_where_projection_puts_them(height):
    v, u = torch.meshgrid(torch.arange(SIZE[0]) + 0.5, torch.arange(SIZE[1]) + 0.5, indexing="ij")
    features = (torch.stack([u, v]) * STRIDE).expand(1, len(DEMO_RIG), 2, *SIZE)
    lookup = look_up(DEMO_RIG, height)
    alone = lookup.visible[0].sum(dim=1) == 1
    ground = to_ground(features, EVERYWHERE, lookup)[0]
    for number, camera in enumerate(DEMO_RIG):
        seen = (alone & (lookup.visible[0, :, number] == 1)).numpy()
        expected, _ = project(CELLS.reshape(-1, 2)[seen], camera, height)
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
    ground = on_grid(features, EVERYWHERE, LOOKUP)[0, 0].double().numpy()
    centre = (CELLS * ground[..., None]).sum(axis=(0, 1)) / ground.sum()
    np.testing.assert_allclose(centre, point, atol=0.7)  # half of what one feature pixel covers there


def test_mean_over_valid_cameras_only_and_nothing_where_none_looks():
    features = torch.arange(1.0, len(DEMO_RIG) + 1).reshape(1, -1, 1, 1, 1).expand(1, -1, 1, *SIZE)
    valid = torch.tensor([[True, True, False, True, False, True]])
    ground = to_ground(features, valid, LOOKUP)[0, :, 0]
    looking = VISIBLE * valid
    expected = (looking @ torch.arange(1.0, 7.0)) / looking.sum(dim=1).clamp(min=1)
    assert (looking.sum(dim=1) == 0).any() and (looking.sum(dim=1) == 2).any()
    torch.testing.assert_close(ground, expected)


def test_the_backward_pass_is_the_transpose_of_the_forward_pass():
    generator = torch.Generator().manual_seed(0)
    shape, lookup = (2, len(DEMO_RIG), 3, *SIZE), look_up(DEMO_RIG, batch=2)
    features = torch.randn(shape, generator=generator, requires_grad=True)
    probe = torch.randn(2, GRID[0] * GRID[1], 3, generator=generator)
    direction = torch.randn(shape, generator=generator)
    (to_ground(features, EVERYWHERE.expand(2, -1), lookup) * probe).sum().backward()
    forward = (to_ground(direction, EVERYWHERE.expand(2, -1), lookup) * probe).double().sum()
    torch.testing.assert_close((features.grad * direction).double().sum(), forward, rtol=1e-4, atol=1e-2)


def test_flipped_images_of_any_rig_show_the_mirrored_ground():
    pose = DEMO_RIG[1].camera_to_ego.copy()
    pose[:3, 3] += [0.3, 0.1, 0.0]
    rig = (DEMO_RIG[0], replace(DEMO_RIG[1], camera_to_ego=pose), *DEMO_RIG[2:])
    features = torch.rand(1, len(rig), 2, *SIZE)
    ground = on_grid(features, EVERYWHERE, look_up(rig))
    mirrored = on_grid(features.flip(-1), EVERYWHERE, look_up(mirror_rig(rig)))
    torch.testing.assert_close(mirrored, ground.flip(2), atol=1e-4, rtol=0)


def test_rows_that_an_image_does_not_have_show_nothing():
    low = tuple(replace(camera, height=200) for camera in DEMO_RIG)
    rows = 200 * CONFIG.image.width / DEMO_RIG[0].width
    assert calibrate(low, CONFIG).image_size[0, 0].tolist() == [CONFIG.image.width, rows]
    v = (torch.arange(SIZE[0]) + 0.5)[:, None].expand(1, len(low), 1, *SIZE) * STRIDE
    assert to_ground(v, EVERYWHERE, look_up(low)).max() <= rows


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


@given(seed=st.integers(0, 10_000), rows=st.integers(1, 6), columns=st.integers(1, 7), entries=st.integers(0, 12))
@settings(max_examples=40, deadline=None)
def test_a_transposed_matrix_is_the_transpose_on_a_cpu_and_elsewhere(seed, rows, columns, entries):
    """Empty rows and columns included; an entry may come twice, as at the border of an image."""
    generator = torch.Generator().manual_seed(seed)
    row = torch.randint(rows, (entries,), generator=generator).sort().values
    column = torch.randint(columns, (entries,), generator=generator).int()
    weights = torch.rand(entries, generator=generator)
    matrix = SparseRows(column, row_starts(torch.bincount(row, minlength=rows)), weights)
    dense = torch.zeros(rows, columns).index_put((row, column.long()), weights, accumulate=True)
    table = torch.rand(rows, 3, generator=generator)
    for turned in (matrix.transposed(columns), matrix._transposed_by_sorting(columns)):
        torch.testing.assert_close(turned.multiply(table), dense.T @ table)
