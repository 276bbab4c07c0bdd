"""Ground with slopes: rays, cars, solids, the lidar and depth images must all agree on where it is."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.ndimage import gaussian_filter
from shapely import box

from mapfusion.geometry import inverse_pose
from predmapnet.datasets.nuscenes import NuScenesSource
from predmapnet.demo_world.catalogue import WORLD_VERSION
from predmapnet.demo_world.nuscenes.writer import write_scene
from predmapnet.demo_world.render.lidar import scan
from predmapnet.demo_world.render.mesh import build_mesh
from predmapnet.demo_world.render.relief import meet_along, relief_of
from predmapnet.demo_world.render.renderer import Renderer
from predmapnet.demo_world.render.shadows import shadow_polygons
from predmapnet.demo_world.rig import DEMO_RIG, LIDAR_TO_EGO
from predmapnet.demo_world.street.dressing import dress
from predmapnet.demo_world.street.solid_list import SolidList
from predmapnet.demo_world.terrain import (
    CAMBER,
    CELL,
    CELLS,
    STEEPEST,
    TRACK,
    WHEELBASE,
    Terrain,
    draw_terrain,
    on_terrain,
    put_on_terrain,
)
from predmapnet.demo_world.world import Look, Surface, Trajectory, VectorMap, World

DATA = Path(__file__).parents[2] / "data"
FRONT = DEMO_RIG[0]
PERIOD = CELL * CELLS
MIDDLES = (np.arange(CELLS) + 0.5) * CELL
X, Y = np.meshgrid(MIDDLES, MIDDLES)
PLACE = np.array([PERIOD / 2, PERIOD / 2])
EAST, NORTH = 0.06, -0.025


def plane(east=EAST, north=NORTH):
    """Ground that is a plane through PLACE for 170 m around it; further away it turns back, to repeat itself."""
    away = [axis - PLACE[0] for axis in (X, Y)]
    rise = [np.where(np.abs(a) < PERIOD / 4, a, np.sign(a) * PERIOD / 2 - a) for a in away]
    return Terrain(gaussian_filter(east * rise[0] + north * rise[1], 5.0, mode="wrap").astype(np.float32))


def waves(seed, radius=420.0):
    """Hills and dips of several lengths, the sharpest of about ``radius`` metres."""
    random = np.random.default_rng(seed)
    rough = random.standard_normal((CELLS, CELLS))
    hills = Terrain(gaussian_filter(rough, random.uniform(8.0, 20.0), mode="wrap").astype(np.float32))
    return Terrain(hills.coefficients * np.float32(1 / radius / hills.bend))


def poses_at(places, headings):
    poses = np.tile(np.eye(4), (len(places), 1, 1))
    poses[:, 0, 0] = poses[:, 1, 1] = np.cos(headings)
    poses[:, 1, 0], poses[:, 0, 1] = np.sin(headings), -np.sin(headings)
    poses[:, :2, 3] = places
    return poses


def bare_world(terrain, solids=None, heading=0.0):
    """Asphalt everywhere and a car that stands at PLACE, level even on a slope."""
    road = box(*(PLACE - 150), *(PLACE + 150))
    poses = poses_at(PLACE[None], np.array([heading]))
    poses[:, 2, 3] = terrain.heights(PLACE)
    solids = (solids or SolidList()).solids()
    drive = Trajectory(np.zeros(1, np.int64), poses)
    surfaces = (Surface(road, "asphalt_new"),)
    return World("slope", 3, Look.OVERCAST, VectorMap((road,), (), (), ()), drive, surfaces, solids, terrain=terrain)


def rays_of(renderer, camera):
    """Rays ``(height, width, 3)`` of all pixels, camera depth 1, and their start."""
    view = renderer.view(camera, 0)
    column, row = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    local = np.stack([(column - view.centre_x) / view.focal_x, (row - view.centre_y) / view.focal_y], axis=-1)
    return np.concatenate([local, np.ones((*column.shape, 1))], axis=-1) @ view.rotation.T, view.position


@pytest.fixture(scope="module")
def dressed(street):
    """The dressed street on waves."""
    flat = dress(*street, Look.DAY, 4, "waves")
    return put_on_terrain(flat, waves(4))


def test_a_spline_is_as_smooth_as_it_says_and_has_the_slopes_that_it_says():
    terrain, random = waves(2, 100.0), np.random.default_rng(0)
    points = random.uniform(-900, 900, (4000, 2))
    way = random.standard_normal((4000, 2))
    way /= np.linalg.norm(way, axis=1, keepdims=True)
    before, here, after = (terrain.heights(points + step * way) for step in (-0.5, 0.0, 0.5))
    np.testing.assert_allclose(
        (after - before), (terrain.gradients(points) * way).sum(axis=1), atol=0.5 * terrain.bend * 0.25
    )
    sharpest = np.abs(before - 2 * here + after).max() / 0.25
    assert 0.4 * terrain.bend < sharpest <= terrain.bend * 1.001
    assert terrain.heights(points).max() <= terrain.top
    np.testing.assert_allclose(terrain.heights(points + PERIOD), terrain.heights(points), atol=1e-9)


@pytest.mark.parametrize("camera", DEMO_RIG[:4], ids=lambda camera: camera.name)
def test_depth_on_a_plane_that_rises_by_six_percent_is_that_of_the_closed_form(camera):
    renderer = Renderer(bare_world(plane()), supersampling=1, texel=0.3)
    depth = renderer.render(camera, 0).depth
    rays, start = rays_of(renderer, camera)
    falls = rays @ [EAST, NORTH, -1.0]
    above = start[2] - plane().heights(PLACE) - (start[:2] - PLACE) @ [EAST, NORTH]
    expected = above / np.where(falls > 1e-9, falls, np.nan)
    near = expected * np.linalg.norm(rays[..., :2], axis=-1) < 150.0
    assert near.mean() > 0.3
    np.testing.assert_allclose(depth[near], expected[near], rtol=2e-4)
    assert (depth[falls < 0] * np.linalg.norm(rays[falls < 0][..., :2], axis=-1) > 170.0).all()


@settings(max_examples=30, deadline=None)
@given(
    seed=st.integers(0, 1000),
    radius=st.floats(60.0, 2000.0),
    place=st.tuples(st.floats(0, PERIOD), st.floats(0, PERIOD)),
    eye=st.floats(0.3, 3.0),
)
def test_a_ray_meets_the_ground_where_small_steps_first_find_it(seed, radius, place, eye):
    terrain, random, count = waves(seed, radius), np.random.default_rng(seed), 40
    start = np.array([*place, terrain.heights(np.array(place)) + eye])
    # Most rays aim at places a little above or below the ground: they graze crests on their way.
    azimuth, away = random.uniform(0, 2 * np.pi, count), random.uniform(5, 250, count)
    aims = start[:2] + away[:, None] * np.stack([np.cos(azimuth), np.sin(azimuth)], axis=1)
    dip = (terrain.heights(aims) + random.normal(0, 0.3, count) - start[2]) / away
    rays = np.column_stack([np.cos(azimuth), np.sin(azimuth), dip])
    met = np.full(count, 300.0)
    meet_along(relief_of(terrain, np.zeros((0, 3))), start, rays, met)
    steps = np.arange(0.0, 300.0, 0.05)
    points = start + steps[:, None, None] * rays
    above = points[..., 2] - terrain.heights(points[..., :2])
    for ray in range(count):
        (found,) = np.nonzero(above[:, ray] <= 0)
        expected = steps[found[0]] if len(found) else 300.0
        if abs(met[ray] - expected) > 0.1:
            # A ray that touches a crest may pass it or not.
            earlier = min(met[ray], expected)
            assert np.abs(above[np.abs(steps - earlier) < 0.5, ray]).min() < 1e-4 * max(earlier, 10.0)


def test_a_crest_hides_what_lies_low_behind_it_and_not_what_is_high():
    # The crest is 40 m ahead, 2.5 m above the car and the boxes.
    crest = Terrain((2.5 * np.exp(-0.5 * ((X - PLACE[0] - 40.0) / 14.0) ** 2)).astype(np.float32))
    solids = SolidList()
    low, high = PLACE + np.array([[80.0, 6.0], [80.0, -6.0]])
    solids.stand("box", low, (4.0, 4.0, 1.2), 0.0, (0.9, 0.0, 0.0))
    solids.stand("box", high, (4.0, 4.0, 12.0), 0.0, (0.9, 0.0, 0.0))
    seen = []
    for terrain in (Terrain(np.zeros_like(crest.coefficients)), crest):
        renderer = Renderer(bare_world(terrain, solids), texel=0.3)
        mesh, _, _ = renderer.mesh_at(0)
        ids = renderer.rasterise(mesh, renderer.view(FRONT, 0), 2).ids
        owners = np.where(ids >= 0, mesh.owners[ids], -1)
        depth = renderer.render(FRONT, 0).depth
        seen.append([(owners == row).sum() for row in (0, 1)])
        local = inverse_pose(renderer.world.trajectory.ego_to_global[0] @ FRONT.camera_to_ego) @ [
            *low, terrain.heights(low) + 1.0, 1.0,
        ]  # fmt: skip
        column, row, _ = (FRONT.intrinsics @ local[:3] / local[2]).astype(int)
        if terrain is crest:
            assert 20.0 < depth[row, column] < 42.0, "the near side of the crest is seen where the box would be"
        else:
            assert depth[row, column] == pytest.approx(local[2], abs=2.5)
    assert seen[0][0] > 100 and seen[1][0] == 0
    assert 0.3 * seen[0][1] < seen[1][1] < 0.95 * seen[0][1]


def test_cars_stand_with_their_wheels_on_the_ground():
    terrain, random = waves(5), np.random.default_rng(1)
    headings = random.uniform(-np.pi, np.pi, 200)
    flat = poses_at(random.uniform(0, 1000, (200, 2)), headings)
    placed = on_terrain(Trajectory(np.arange(200), flat), terrain).ego_to_global
    np.testing.assert_array_equal(placed[:, :2, 3], flat[:, :2, 3])
    np.testing.assert_allclose(
        placed[:, :3, :3] @ placed[:, :3, :3].transpose(0, 2, 1), flat[:, :3, :3] * 0 + np.eye(3), atol=1e-12
    )
    np.testing.assert_allclose(np.exp(1j * np.arctan2(placed[:, 1, 0], placed[:, 0, 0])), np.exp(1j * headings))
    for along in (0.0, WHEELBASE):
        for side in (TRACK / 2, -TRACK / 2):
            wheel = placed @ [along, side, 0.0, 1.0]
            np.testing.assert_allclose(wheel[:, 2], terrain.heights(wheel[:, :2]), atol=0.012)
    assert np.abs(placed[:, 2, 0]).max() > 0.03, "some of these cars stand on a grade"


def test_pitch_and_roll_of_a_flat_drive_come_on_top_of_the_grounds():
    flat = poses_at(PLACE[None], np.array([0.4]))
    nod = np.array([[np.cos(0.02), 0, np.sin(0.02)], [0, 1, 0], [-np.sin(0.02), 0, np.cos(0.02)]])
    nodding = flat.copy()
    nodding[:, :3, :3] = flat[:, :3, :3] @ nod
    still, nodded = (
        on_terrain(Trajectory(np.zeros(1), poses), plane()).ego_to_global[0, :3, :3] for poses in (flat, nodding)
    )
    np.testing.assert_allclose(still.T @ nodded, nod, atol=1e-12)


def test_solids_stand_on_the_ground_without_a_gap(dressed):
    solids, terrain = dressed.solids, dressed.terrain
    mesh = build_mesh(solids, np.flatnonzero(solids.always), terrain)
    flat = build_mesh(solids, np.flatnonzero(solids.always))
    used = np.arange(8) < mesh.counts[:, None]
    lift = mesh.corners[..., 2] - flat.corners[..., 2]
    clearance = mesh.corners[..., 2] - terrain.heights(mesh.corners[..., :2])
    vehicle = (solids.texture[mesh.owners] == "vehicle")[:, None] & used
    np.testing.assert_allclose(clearance[vehicle], flat.corners[..., 2][vehicle], atol=0.04)
    bottom = ~vehicle & used & (np.abs(flat.corners[..., 2]) < 1e-6)
    assert bottom.sum() > 500
    assert clearance[bottom].max() < -0.1
    rest = used & ~vehicle & ~bottom
    foot = np.broadcast_to(terrain.heights(solids.centre[mesh.owners, :2])[:, None], rest.shape)
    np.testing.assert_allclose(lift[rest], foot[rest], atol=1e-9)
    np.testing.assert_allclose(mesh.balls[:, 2] - flat.balls[:, 2], terrain.heights(mesh.balls[:, :2]), atol=1e-9)


def test_ground_pixels_of_a_street_on_waves_lie_on_the_ground(dressed):
    renderer = Renderer(dressed, supersampling=1, texel=0.3)
    mesh, _, _ = renderer.mesh_at(5)
    pose = dressed.trajectory.ego_to_global[5]
    count = 0
    for camera in DEMO_RIG:
        depth = renderer.render(camera, 5).depth
        ids = renderer.rasterise(mesh, renderer.view(camera, 5), 1).ids
        row, column = np.nonzero((ids < 0) & (depth < 40.0))
        pixel = np.column_stack([column + 0.5, row + 0.5, np.ones(len(row))])
        local = pixel @ np.linalg.inv(camera.intrinsics).T * depth[row, column][:, None]
        points = np.column_stack([local, np.ones(len(row))]) @ (pose @ camera.camera_to_ego).T
        np.testing.assert_allclose(points[:, 2], dressed.terrain.heights(points[:, :2]), atol=0.02)
        count += len(row)
    assert count > 300_000


def test_flat_worlds_come_out_as_before_there_were_slopes(street):
    """The picture is of the renderer that knew flat ground only; processors of another kind may round otherwise."""
    camera = replace(FRONT, width=160, height=90, intrinsics=np.diag([0.2, 0.2, 1]) @ FRONT.intrinsics)
    drawn = []
    for look in (Look.DAY, Look.WET, Look.NIGHT):
        renderer = Renderer(dress(*street, look, 4, "a"), texel=0.3)
        renderer.light = renderer.light._replace(noise=0.0)
        drawn.append(renderer.render(camera, 5).image)
    before = cv2.cvtColor(cv2.imread(str(DATA / "flat_ground.png")), cv2.COLOR_BGR2RGB)
    differing = np.abs(np.vstack(drawn).astype(int) - before)
    assert differing.max() <= 2 and np.mean(differing > 0) < 1e-3


def test_the_zero_height_field_looks_like_flat_ground(street):
    camera = replace(FRONT, width=400, height=225, intrinsics=np.diag([0.5, 0.5, 1]) @ FRONT.intrinsics)
    for look in (Look.DAY, Look.WET):
        flat = dress(*street, look, 4, "a")
        zero = put_on_terrain(flat, Terrain(np.zeros((CELLS, CELLS), np.float32)))
        first, second = (Renderer(world, texel=0.3).render(camera, 5) for world in (flat, zero))
        assert np.mean(np.abs(first.image.astype(int) - second.image) > 2) < 2e-3
        near = first.depth < 80
        assert np.mean(np.abs(second.depth[near] / first.depth[near] - 1) > 1e-3) < 1e-3


def test_lidar_points_lie_on_the_ground_and_so_do_those_of_a_written_scene(dressed, tmp_path):
    world = bare_world(waves(7, 300.0))
    world = replace(
        world, trajectory=on_terrain(Trajectory(np.zeros(1, np.int64), poses_at(PLACE[None], [0.7])), world.terrain)
    )
    points = scan(Renderer(world, texel=0.3), 0)[:, :3]
    pose = world.trajectory.ego_to_global[0] @ LIDAR_TO_EGO
    there = points @ pose[:3, :3].T + pose[:3, 3]
    error = there[:, 2] - world.terrain.heights(there[:, :2])
    assert len(points) > 10_000 and np.ptp(world.terrain.heights(there[:, :2])) > 1.0
    assert np.abs(error).max() < 0.06 and abs(error.mean()) < 0.002

    drive = Trajectory(dressed.trajectory.timestamps[:2], dressed.trajectory.ego_to_global[:2])
    write_scene(replace(dressed, trajectory=drive), tmp_path / "scene", WORLD_VERSION, rig=DEMO_RIG[:1])
    scene = NuScenesSource(tmp_path / "scene").open("waves")
    for index in range(2):
        # The reader's origin lies at the lidar's x and y.
        pose = scene.frame(index).ego_to_global
        np.testing.assert_allclose(pose[:3, :3], drive.ego_to_global[index, :3, :3], atol=1e-6)
        there = scene.lidar(index) @ pose[:3, :3].T + pose[:3, 3]
        error = there[:, 2] - dressed.terrain.heights(there[:, :2])
        assert np.mean(np.abs(error) < 0.05) > 0.3 and np.percentile(error, 1) > -0.06


def test_drawn_hills_keep_to_the_grades_and_radii_of_streets(street):
    vector_map, trajectory = street
    positions = trajectory.ego_to_global[:, :2, 3]
    steepest = []
    for seed in range(12):
        terrain = draw_terrain(seed, positions, vector_map.road_segments[0])
        x, y = np.meshgrid(np.arange(-120, 60, 3.0), np.arange(-90, 90, 3.0))
        steepest.append(np.linalg.norm(terrain.gradients(np.stack([x, y], axis=-1)), axis=-1).max())
        along = terrain.heights(positions[0] + np.arange(-20.0, 60.0, 10.0)[:, None] * [1.0, 0.0])
        assert np.abs(np.diff(along, 2)).max() / 100 < 1 / 380, "the middle of a street has no camber along it"
        assert 1 / terrain.bend > 120
    assert max(steepest) < STEEPEST[1] + CAMBER[1] + 0.01
    assert min(steepest) > 0.01 and np.ptp(steepest) > 0.01
    # Streets fall to their kerbs on both sides by what is asked, as far as a smooth surface can.
    kerb, middle = np.array([[50.0, -6.0], [50.0, 6.0]]), np.array([[50.0, 0.0]])
    fall = [
        (terrain.heights(middle) - terrain.heights(kerb).mean())[0] / 6.0
        for terrain in (draw_terrain(seed, positions, vector_map.road_segments[0]) for seed in range(12))
    ]
    assert 0.003 < np.median(fall) < CAMBER[1]


def test_the_shadow_of_a_pole_ends_where_the_sunbeam_past_its_top_meets_the_slope():
    solids = SolidList()
    solids.stand("cylinder", PLACE, (0.02, 0.02, 6.0), 0.0, (0.2, 0.2, 0.2))
    sun = np.array([-0.6, 0.5, 0.4])
    sun /= np.linalg.norm(sun)
    ((outline, _),) = shadow_polygons(solids.solids(), np.array([True]), sun.astype(np.float32), plane())
    beam = np.array([6.0]) * 10
    meet_along(relief_of(plane(), np.zeros((0, 3))), np.array([*PLACE, plane().heights(PLACE) + 6.0]), -sun[None], beam)
    end = PLACE - beam[0] * sun[:2]
    assert np.linalg.norm(outline - end, axis=1).min() < 0.05
    assert np.linalg.norm(outline - PLACE, axis=1).max() == pytest.approx(np.linalg.norm(end - PLACE), abs=0.05)
