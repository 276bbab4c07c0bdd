"""Kerbs with height: images, depth and lidar agree with rays that are followed in small steps."""

from dataclasses import replace

import numpy as np
import pytest
import shapely
from shapely import box

from predmapnet.demo_world.render.kerbs import MARGIN, TEXEL, heights_at, kerbs_of
from predmapnet.demo_world.render.lidar import scan
from predmapnet.demo_world.render.renderer import Renderer
from predmapnet.demo_world.rig import DEMO_RIG, LIDAR_TO_EGO
from predmapnet.demo_world.street.manner import FLUSH_SHARE, KERB_HEIGHTS, Manner
from predmapnet.demo_world.street.solid_list import SolidList
from predmapnet.demo_world.terrain import put_on_terrain
from predmapnet.demo_world.world import Crossing, CrossingStyle, Look, Surface, Trajectory, VectorMap, World
from tests.predmapnet.demo_world.test_slopes import PLACE, plane

HEIGHT = 0.15
HALF = 5.0
"""Metres from the middle of the street to its kerbs."""
MEDIAN = box(8.0, 1.8, 30.0, 2.6)
DRIVEWAY = box(14.0, -HALF - 3.0, 17.0, -HALF + 0.1)
ZEBRA = box(20.0, -HALF, 23.0, HALF)


def street_world(height=HEIGHT, crossings=(), yaw=0.0, y=0.0, terrain=None, solids=None):
    """A straight street along x through PLACE with a median, a driveway and a car that stands in its middle."""
    road = box(-80, -HALF, 80, HALF).difference(MEDIAN).union(DRIVEWAY)
    road = shapely.affinity.translate(road, *PLACE)
    marks = tuple(
        Crossing(shapely.affinity.translate(mark, *PLACE), CrossingStyle.ZEBRA, np.pi / 2) for mark in crossings
    )
    pose = np.eye(4)[None].copy()
    pose[0, 0, 0] = pose[0, 1, 1] = np.cos(yaw)
    pose[0, 1, 0], pose[0, 0, 1] = np.sin(yaw), -np.sin(yaw)
    pose[0, :2, 3] = PLACE + np.array([0.0, y])
    around = shapely.affinity.translate(box(-200, -200, 200, 200), *PLACE)
    surfaces = (Surface(around, "sidewalk"), Surface(road, "asphalt_new"))
    drive = Trajectory(np.zeros(1, np.int64), pose)
    map_ = VectorMap((road,), (), marks, ())
    solids = (solids or SolidList()).solids()
    world = World("kerbs", 3, Look.DAY, map_, drive, surfaces, solids, kerb_height=height)
    return world if terrain is None else put_on_terrain(world, terrain)


def camera(width=320, height=180):
    front = DEMO_RIG[0]
    scale = np.diag([width / front.width, height / front.height, 1.0])
    return replace(front, width=width, height=height, intrinsics=scale @ front.intrinsics)


def rays_of(renderer, eye):
    view = renderer.view(eye, 0)
    column, row = np.meshgrid(np.arange(eye.width) + 0.5, np.arange(eye.height) + 0.5)
    local = np.stack([(column - view.centre_x) / view.focal_x, (row - view.centre_y) / view.focal_y], axis=-1)
    return np.concatenate([local, np.ones((*column.shape, 1))], axis=-1) @ view.rotation.T, view.position


def raised(x, y):
    """Whether ground is no road, relative to PLACE."""
    off = (np.abs(y) > HALF) & ~((x > 14) & (x < 17) & (y > -HALF - 3) & (y < 0))
    return off | ((x > 8) & (x < 30) & (y > 1.8) & (y < 2.6))


def followed(rays, start, height, steps=500):
    """Depth at which rays first lie below the ground, in steps of a five-hundredth of a seventh of the way."""
    flat = np.where(rays[..., 2] < 0, -start[2] / np.minimum(rays[..., 2], -1e-9), np.inf)
    met = flat.copy()
    for share in np.linspace(1.0, 0.86, steps):
        depth = np.where(np.isfinite(flat), flat * share, 0.0)
        place = start + depth[..., None] * rays
        step = raised(place[..., 0] - PLACE[0], place[..., 1] - PLACE[1])
        met = np.where(np.isfinite(flat) & step & (place[..., 2] <= height), depth, met)
    return met


@pytest.mark.parametrize(("yaw", "y"), [(0.0, -1.5), (0.9, -1.5), (-0.7, 0.0), (np.pi / 2, -7.5)])
def test_depth_is_that_of_rays_followed_in_small_steps(yaw, y):
    """Along the street, at both kerbs, across a median and from the sidewalk, of which the edge hides the foot."""
    renderer = Renderer(street_world(yaw=yaw, y=y))
    eye = camera()
    rays, start = rays_of(renderer, eye)
    truth, depth = followed(rays, start, HEIGHT), renderer.render(eye, 0).depth
    near = truth < 25
    truth, depth = np.where(near, truth, 99.0), np.where(near, depth, 99.0)
    # At edges, a pixel may take either side.
    spread = np.stack([np.roll(truth, (i, j), (0, 1)) for i in (-1, 0, 1) for j in (-1, 0, 1)])
    low, high = spread.min(axis=0), spread.max(axis=0)
    driveway = np.abs((start + truth[..., None] * rays)[..., :2] - PLACE - [15.5, -6.5]).max(axis=-1) < 5
    wrong = near & ~driveway & ((depth < low * 0.995 - 0.01) | (depth > high * 1.005 + 0.01))
    assert near.sum() > 5000
    assert wrong.sum() < 2e-4 * near.sum()
    plain = near & (high - low < 0.06 * truth) & ~driveway
    assert np.abs(depth - truth)[plain].max() < 0.06 * 25
    assert np.median(np.abs(depth - truth)[plain] / truth[plain]) < 1e-3


@pytest.mark.parametrize("height", [0.05, 0.2])
def test_a_face_spans_the_rows_that_the_projection_says(height):
    """From its foot, which is the edge of the drivable surface, to its top: to a pixel, on flat ground."""
    eye = camera(1600, 900)
    renderer = Renderer(street_world(height, yaw=np.pi / 2, y=-2.0), supersampling=1)
    view = renderer.view(eye, 0)
    drawn = renderer.render(eye, 0)
    away = HALF + 2.0 - (view.position[1] - PLACE[1] + 2.0)
    column = 100
    depth = drawn.depth[:, column]
    face = np.flatnonzero(np.abs(depth - away) < 6e-3)
    foot = view.centre_y + view.focal_y * view.position[2] / away
    top = view.centre_y + view.focal_y * (view.position[2] - height) / away
    assert abs(face.min() - top) <= 1.0
    assert abs(face.max() + 1 - foot) <= 1.0
    brightness = drawn.image[..., 1].astype(float)
    strip = brightness[face.min() + 2 : face.max() - 1, 60:140].mean()
    above, below = (
        brightness[face.min() - 6 : face.min() - 1, 60:140].mean(),
        brightness[face.max() + 4 :, 60:140].mean(),
    )
    assert abs(strip - above) > 15
    assert abs(strip - below) > 3


def test_on_a_slope_the_step_lies_on_the_slope():
    terrain = plane(0.03, 0.02)
    eye = camera()
    renderer = Renderer(street_world(yaw=np.pi / 2, y=-4.0, terrain=terrain))
    rays, start = rays_of(renderer, eye)
    points = start + renderer.render(eye, 0).depth[..., None].clip(0, 60) * rays
    above = points[..., 2] - terrain.heights(points[..., :2])
    y = points[..., 1] - PLACE[1]
    near = np.abs(points[..., 0] - PLACE[0]) < 6
    far_top, road = near & (y > HALF + 0.1) & (y < HALF + 12), near & (y < HALF - 0.1)
    assert np.abs(above[far_top] - HEIGHT).max() < 0.01
    assert np.abs(above[road]).max() < 0.01
    face = near & (np.abs(y - HALF) < 0.02)
    assert face.sum() > 500
    assert above[face].min() > -0.01
    assert above[face].max() < HEIGHT + 0.01


def test_no_step_at_crossings_and_driveways():
    kerbs = Renderer(street_world(crossings=(ZEBRA,))).kerbs
    points = PLACE + np.array([[21.5, 5.3], [21.5, -5.3], [15.5, -7.0], [13.5, -5.3], [21.5, 2.2]])
    heights = np.empty(len(points))
    heights_at(kerbs, points, heights)
    assert np.allclose(heights, 0.0)
    far = PLACE + np.array([[0.0, 5.3], [40.0, -5.2], [10.0, 2.2], [27.0, 5.3], [10.5, -6.0]])
    heights_at(kerbs, far, heights)
    assert np.allclose(heights, HEIGHT)
    heights_at(kerbs, PLACE + np.array([[0.0, 4.9], [40.0, 0.0], [15.5, -5.2], [5.0, 2.2], [31.0, 2.2]]), heights)
    assert np.allclose(heights, 0.0)


def test_the_edge_lies_where_the_drivable_surface_ends():
    """Also of a street that no row of texels is parallel to, and at its corners."""
    random = np.random.default_rng(5)
    road = shapely.affinity.rotate(box(-30, -4, 30, 4).union(box(-3, -30, 4, 30)), 17, origin=(0, 0))
    world = street_world()
    kerbs = kerbs_of(world, shapely.affinity.translate(road, *PLACE))
    middle = (PLACE - [kerbs.x, kerbs.y]) / TEXEL
    rows, columns = (random.uniform(-25, 25, (2, 4000)) / TEXEL + middle[::-1, None]).astype(int)
    points = np.column_stack([columns + 0.5, rows + 0.5]) * TEXEL + [kerbs.x, kerbs.y] - PLACE
    exact = shapely.distance(shapely.points(points), road.boundary) * np.where(shapely.contains_xy(road, points), 1, -1)
    measured = kerbs.clear[rows, columns] / 1000
    near = np.abs(exact) < 0.4
    assert np.abs(measured - exact)[near].max() < 0.002
    assert (np.abs(measured)[~near] < np.abs(exact)[~near] + 0.02).all()
    assert (np.sign(measured) == np.sign(exact))[np.abs(exact) > 0.02].all()
    assert np.linalg.norm([kerbs.x, kerbs.y] - PLACE + MARGIN) < 2


def test_a_step_of_nothing_looks_like_ground_without_steps():
    """Colours of road and sidewalk are those of worlds without kerbs, except at the edge itself."""
    eye = camera()
    flush, tiny = (Renderer(street_world(height, yaw=0.5)).render(eye, 0) for height in (0.0, 1e-6))
    differs = (np.abs(flush.image.astype(int) - tiny.image) > 1).any(axis=2)
    assert differs.mean() < 0.02
    near = flush.depth < 50
    assert np.allclose(flush.depth[near], tiny.depth[near], rtol=1e-4)
    assert Renderer(street_world(0.0)).kerbs is None


def test_the_lidar_meets_steps_and_things_stand_on_them():
    solids = SolidList()
    solids.stand("cylinder", PLACE + np.array([0.0, 8.0]), (0.3, 0.3, 3.0), 0.0, (0.2, 0.2, 0.2))
    solids.stand("cylinder", PLACE + np.array([-9.0, 3.0]), (0.3, 0.3, 3.0), 0.0, (0.2, 0.2, 0.2))
    world = street_world(solids=solids)
    renderer = Renderer(world)
    assert np.allclose(renderer.world.solids.centre[:, 2] - world.solids.centre[:, 2], [HEIGHT, 0.0])
    points = scan(renderer, 0)[:, :3] @ LIDAR_TO_EGO[:3, :3].T + LIDAR_TO_EGO[:3, 3]
    low = points[(points[:, 2] < 0.5) & (np.abs(points[:, 0]) < 6)]
    beside = np.abs(low[:, 1]) - HALF
    assert np.median(low[beside > 0.1, 2]) == pytest.approx(HEIGHT, abs=0.01)
    assert np.median(low[beside < -0.1, 2]) == pytest.approx(0.0, abs=0.01)


def test_most_towns_have_kerbs():
    heights = np.array([Manner.draw(seed).kerb_height for seed in range(600)])
    assert np.mean(heights == 0) == pytest.approx(FLUSH_SHARE, abs=0.04)
    assert heights[heights > 0].min() >= KERB_HEIGHTS[0]
    assert heights.max() <= KERB_HEIGHTS[1]
    assert Manner().kerb_height == 0
