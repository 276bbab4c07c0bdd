"""Images must agree with the geometry: paint where the calibration puts it, depth as the scene is built."""

import numpy as np
import pytest
from shapely import box

from predmapnet.demo_world.render.renderer import Renderer
from predmapnet.demo_world.rig import DEMO_RIG
from predmapnet.demo_world.street.solid_list import SolidList
from predmapnet.demo_world.world import Divider, LineStyle, Look, Surface, Trajectory, VectorMap, World
from predmapnet.scenes import Camera

FRONT = DEMO_RIG[0]
LINES = {
    "ahead": np.array([[0.0, 1.0], [90.0, 1.0]]),
    "oblique": np.array([[2.0, -6.0], [60.0, 20.0]]),
    "across": np.array([[14.0, -30.0], [15.0, 30.0]]),
}


def level_pose(x=0.0, pitch=0.0, origin=(0.0, 0.0)):
    pose = np.eye(4)
    pose[:3, :3] = [[np.cos(pitch), 0, np.sin(pitch)], [0, 1, 0], [-np.sin(pitch), 0, np.cos(pitch)]]
    pose[:2, 3] = origin
    pose[0, 3] += x
    return pose


def plain_world(lines=(), solids=None, poses=None, origin=(0.0, 0.0), seed=3):
    """A wide asphalt plane with solid white lines, under an even sky."""
    poses = [level_pose(origin=origin)] if poses is None else poses
    road = box(origin[0] - 150, origin[1] - 150, origin[0] + 150, origin[1] + 150)
    dividers = tuple(Divider(line + np.array(origin), LineStyle.SOLID) for line in lines)
    vector_map = VectorMap((road,), (), (), dividers)
    trajectory = Trajectory(np.arange(len(poses)) * 500_000_000, np.array(poses))
    solids = (solids or SolidList()).solids()
    return World("plane", seed, Look.OVERCAST, vector_map, trajectory, (Surface(road, "asphalt_new"),), solids)


def quiet(renderer):
    renderer.light = renderer.light._replace(noise=0.0, haze=0.0)
    return renderer


def projected(camera, pose, points):
    points = np.column_stack([points, np.zeros(len(points)), np.ones(len(points))])
    local = points @ np.linalg.inv(pose @ camera.camera_to_ego).T
    pixel = local[:, :3] @ camera.intrinsics.T
    return pixel[:, :2] / pixel[:, 2:], local[:, 2]


@pytest.mark.parametrize("name", list(LINES))
def test_paint_lies_within_half_a_pixel_of_its_projection(name):
    origin = (5236.97, -2364.34)  # as far from zero as cities of Argoverse 2 are
    pose = level_pose(pitch=0.012, origin=origin)
    renderer = quiet(Renderer(plain_world([LINES[name]], poses=[pose], origin=origin, seed=12)))
    image = renderer.render(FRONT, 0).image.astype(float).mean(axis=2)
    start, stop = LINES[name] + np.array(origin)
    dense = start + np.linspace(0, 1, 4000)[:, None] * (stop - start)
    pixels, depth = projected(FRONT, pose, dense)
    upright = np.ptp(pixels[(depth > 3) & (depth < 40), 0]) < 3 * np.ptp(pixels[(depth > 3) & (depth < 40), 1])
    errors = []
    for pixel, far in zip(pixels[::20], depth[::20], strict=True):
        reach = int(max(4, 0.3 * FRONT.intrinsics[0, 0] / far))
        column, row = np.floor(pixel).astype(int)
        if not (4 < far < 40 and reach < column < 800 - reach and reach < row < 450 - reach):
            continue
        if upright:
            # Centroid along the row, against where the projected line crosses the centre of that row.
            strip, cells = image[row, column - reach : column + reach + 1], column - reach + 0.5
            near = np.argsort(np.abs(pixels[:, 1] - (row + 0.5)))[:2]
            expected = pixels[near, 0].mean()
        else:
            strip, cells = image[row - reach : row + reach + 1, column], row - reach + 0.5
            near = np.argsort(np.abs(pixels[:, 0] - (column + 0.5)))[:2]
            expected = pixels[near, 1].mean()
        weight = np.maximum(strip - np.median(strip) - 8, 0)
        if weight.max() > 25:
            errors.append((weight * (cells + np.arange(len(strip)))).sum() / weight.sum() - expected)
    assert len(errors) > 30
    assert np.abs(np.median(errors)) < 0.15
    assert np.percentile(np.abs(errors), 90) < 0.5


def test_depth_of_ground_walls_and_balls_is_exact():
    solids = SolidList()
    solids.stand("box", np.array([22.0, 4.0]), (4.0, 6.0, 3.0), 0.0, (0.5, 0.5, 0.5))
    solids.add("ellipsoid", (12.0, -3.0, 1.6), (2.0, 2.0, 2.0), 0.3, (0.5, 0.5, 0.5))
    renderer = Renderer(plain_world(solids=solids))
    depth = renderer.render(FRONT, 0).depth
    eye = FRONT.camera_to_ego[:3, 3]
    (foot,), _ = projected(FRONT, np.eye(4), np.array([[20.0, 4.0]]))
    assert depth[int(foot[1]) - 30, int(foot[0])] == pytest.approx(20.0 - eye[0], rel=1e-3)
    local = np.linalg.inv(FRONT.camera_to_ego) @ [12.0, -3.0, 1.6, 1.0]
    pixel = FRONT.intrinsics @ local[:3] / local[2]
    ray = np.linalg.inv(FRONT.intrinsics) @ [int(pixel[0]) + 0.5, int(pixel[1]) + 0.5, 1.0]
    square, half = ray @ ray, ray @ local[:3]
    expected = (half - np.sqrt(half**2 - square * (local[:3] @ local[:3] - 1.0))) / square
    assert depth[int(pixel[1]), int(pixel[0])] == pytest.approx(expected, rel=1e-3)
    rows = np.arange(300, 450)
    down = (rows + 0.5 - FRONT.intrinsics[1, 2]) / FRONT.intrinsics[1, 1]
    np.testing.assert_allclose(depth[rows, 100], eye[2] / down, rtol=1e-3)
    assert np.isinf(depth[:150, 400]).all()


def test_the_same_scene_at_another_resolution_has_the_same_depth():
    solids = SolidList()
    solids.stand("box", np.array([15.0, 0.0]), (2.0, 30.0, 3.0), 0.2, (0.5, 0.5, 0.5))
    renderer = Renderer(plain_world(solids=solids))
    half = Camera(FRONT.name, 400, 225, np.diag([0.5, 0.5, 1]) @ FRONT.intrinsics, FRONT.camera_to_ego)
    full, small = renderer.render(FRONT, 0).depth, renderer.render(half, 0).depth
    # The centre of a small pixel is the corner of four large ones.
    corner = (full[130:149:2, 300:500:2] + full[131:150:2, 301:501:2]) / 2
    np.testing.assert_allclose(small[65:75, 150:250], corner, rtol=2e-3)


def test_far_paint_does_not_flicker_when_the_camera_moves_by_a_centimetre():
    lines = [np.array([[0.0, y], [120.0, y + 0.3]]) for y in (-5.4, -1.9, 1.8, 5.3)]
    lines += [np.array([[x, -8.0], [x + 0.2, 8.0]]) for x in range(35, 60, 2)]
    poses = [level_pose(x) for x in (0.0, 0.01)]
    renderer = quiet(Renderer(plain_world(lines, poses=poses)))
    first, second = (renderer.render(FRONT, index).image.astype(float) for index in (0, 1))
    depth = renderer.render(FRONT, 0).depth
    far = (depth > 30) & (depth < 60)
    change = np.abs(first - second).mean(axis=2)[far]
    contrast = first.mean(axis=2)[far].std()
    assert contrast > 4
    assert change.mean() < 0.1 * contrast
    assert change.max() < 2.5 * contrast
