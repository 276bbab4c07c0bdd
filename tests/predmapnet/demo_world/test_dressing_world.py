"""Dressed worlds: deterministic, passable for the ego car, and hard to see by the right amount."""

import os
from pathlib import Path

import numpy as np
import pytest
from shapely import box

from mapfusion.elements import RegionOfInterest
from predmapnet.demo_world.catalogue import build_world
from predmapnet.demo_world.render.lidar import RANGE, scan
from predmapnet.demo_world.render.renderer import Renderer
from predmapnet.demo_world.rig import DEMO_RIG
from predmapnet.demo_world.street.dressing import dress
from predmapnet.demo_world.street.traffic import footprint
from predmapnet.demo_world.world import Look
from predmapnet.scenes import Camera
from tests.predmapnet.demo_world.occlusion import hidden_share
from tests.real_roads.argoverse_logs import read_log

SMALL_RIG = tuple(
    Camera(camera.name, 256, 144, np.diag([0.32, 0.32, 1.0]) @ camera.intrinsics, camera.camera_to_ego)
    for camera in DEMO_RIG
)


def test_the_same_seed_gives_the_same_bytes(street):
    images = [Renderer(dress(*street, Look.DUSK, 4, "a")).render_frame(SMALL_RIG, 5) for _ in range(2)]
    for name, rendered in images[0].items():
        np.testing.assert_array_equal(rendered.image, images[1][name].image)
        np.testing.assert_array_equal(rendered.depth, images[1][name].depth)
    threaded = Renderer(dress(*street, Look.DUSK, 4, "a"), threads=2).render_frame(SMALL_RIG, 5)
    np.testing.assert_array_equal(threaded["CAM_BACK"].image, images[0]["CAM_BACK"].image)
    other = Renderer(dress(*street, Look.DUSK, 5, "a")).render(SMALL_RIG[0], 5)
    assert (other.image != images[0]["CAM_FRONT"].image).mean() > 0.5


def test_looks_differ_in_brightness_as_they_should(street):
    road, whole = {}, {}
    for look in Look:
        rendered = Renderer(dress(*street, look, 4, "a"), supersampling=1).render_frame(SMALL_RIG, 5)
        images = np.stack([image.image for image in rendered.values()]).astype(float)
        near = np.stack([image.depth for image in rendered.values()]) < 15
        road[look], whole[look] = images[near].mean(), images.mean()
    assert whole[Look.NIGHT] < 0.6 * whole[Look.DUSK] < 0.9 * whole[Look.DAY]
    assert road[Look.NIGHT] < road[Look.OVERCAST]
    assert road[Look.WET] < road[Look.OVERCAST]
    assert 60 < whole[Look.DAY] < 190


@pytest.mark.parametrize("seed", range(4))
def test_nothing_stands_or_drives_in_the_way_of_the_ego_car(street, seed):
    vector_map, trajectory = street
    world = dress(vector_map, trajectory, Look.DAY, seed, "a")
    renderer = object.__new__(Renderer)
    renderer.world = world
    for frame in range(12):
        solids, present = renderer.solids_at(frame)
        x, y = trajectory.ego_to_global[frame, :2, 3]
        ego, ahead = box(x - 1.0, y - 1.0, x + 3.8, y + 1.0), box(x - 6.9, y - 1.0, x + 9.7, y + 1.0)
        for row in present[solids.centre[present, 2] - solids.size[present, 2] / 2 < 2.0]:
            outline = footprint(solids.centre[row], solids.yaw[row], solids.size[row])
            assert outline.distance(ego) > 0.5
            if solids.velocity[row].any():
                assert not outline.intersects(ahead)


@pytest.fixture(scope="module")
def demo_renderers():
    return [Renderer(build_world(name)) for name in ("scene-0101", "scene-0206")]


def test_about_a_tenth_of_the_paint_in_view_is_hidden(demo_renderers):
    counts = np.array(
        [
            hidden_share(renderer, DEMO_RIG, frame, RegionOfInterest())
            for renderer in demo_renderers
            for frame in (2, 14, 26, 38)
        ]
    )
    assert counts[:, 1].sum() > 400
    hidden, seen = counts.sum(axis=0)
    assert 0.04 < hidden / seen < 0.22


def test_lidar_sweep_lies_on_ground_and_solids(demo_renderers):
    points = scan(demo_renderers[0], 3)
    assert points.dtype == np.float32 and points.shape[1] == 5 and len(points) > 15_000
    distance = np.linalg.norm(points[:, :3], axis=1)
    assert distance.max() < RANGE + 0.2
    assert set(np.unique(points[:, 4])) <= set(range(32))
    low = points[(points[:, 4] == 2) & (distance < 15)]
    assert np.abs(np.median(low[:, 2]) + 1.84) < 0.1
    # Rays to the front come out along +y, the lidar's forward axis.
    assert (points[:, 1] > 10).any() and (points[:, 1] < -10).any()


@pytest.mark.reference
def test_a_real_argoverse_log_can_be_dressed_and_rendered():
    root = Path(os.environ.get("PREDMAPNET_REFERENCE", Path(__file__).parents[4] / "shared/reference/public"))
    logs = sorted(path.parent for path in (root / "ground_truth/av2/logs").glob("*/calibration"))
    if not logs:
        pytest.skip(f"no Argoverse 2 log with calibration under {root}; set PREDMAPNET_REFERENCE")
    logged = read_log(logs[0])
    vector_map, trajectory, rig = logged.vector_map, logged.trajectory, logged.rig
    assert rig is not None
    assert len(vector_map.dividers) > 0 and len(vector_map.road_segments) > 0 and len(rig) == 7
    renderer = Renderer(dress(vector_map, trajectory, Look.DAY, 3, "log"), supersampling=1)
    front = next(camera for camera in rig if camera.name == "ring_front_center")
    small = Camera(front.name, 310, 410, np.diag([0.2, 0.2, 1]) @ front.intrinsics, front.camera_to_ego)
    rendered = renderer.render(small, len(trajectory.timestamps) // 2)
    bottom = rendered.depth[-1]
    eye = front.camera_to_ego[2, 3] + trajectory.ego_to_global[0, 2, 3]
    assert 1.0 < eye < 2.5 and np.isfinite(bottom).all()
    assert 15 < rendered.image[-100:].mean() < 200
