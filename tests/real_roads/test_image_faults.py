"""Image faults do what they say: nothing at severity 0, more at each step, and the same for the same seed."""

import numpy as np
import pytest

from predmapnet.demo_world.rig import DEMO_RIG
from predmapnet.scenes import Camera
from tests.real_roads.image_faults import FARTHEST, IMAGE_FAULTS, Shot, fog, ground_distance

FRONT = DEMO_RIG[0]
SMALL = Camera(FRONT.name, 200, 112, np.diag([0.25, 0.25, 1.0]) @ FRONT.intrinsics, FRONT.camera_to_ego)


def photograph() -> np.ndarray:
    """A picture with structure at several scales and no pixel at either end of the range."""
    random = np.random.default_rng(3)
    rows, columns = np.mgrid[: SMALL.height, : SMALL.width]
    waves = 120 + 50 * np.sin(columns / 9) * np.cos(rows / 7)
    return np.asarray(waves[..., None] + random.uniform(-15, 15, (SMALL.height, SMALL.width, 3))).astype(np.uint8)


def difference(first, second) -> float:
    return float(np.abs(first.astype(float) - second).mean())


@pytest.mark.parametrize("fault", IMAGE_FAULTS.values(), ids=IMAGE_FAULTS)
def test_severity_0_changes_nothing(fault):
    image = photograph()
    before = image.copy()
    np.testing.assert_array_equal(fault(image, Shot("a", 4, SMALL), 0), image)
    fault(image, Shot("a", 4, SMALL), 3)
    np.testing.assert_array_equal(image, before)


@pytest.mark.parametrize("fault", IMAGE_FAULTS.values(), ids=IMAGE_FAULTS)
def test_each_severity_is_worse_than_the_one_before(fault):
    image = photograph()
    distances = [difference(fault(image, Shot("a", 4, SMALL), severity), image) for severity in range(4)]
    assert distances[0] == 0 and (np.diff(distances) > 0.3).all(), distances


@pytest.mark.parametrize("name", IMAGE_FAULTS)
def test_chance_follows_the_seed_the_scene_and_the_camera(name):
    image, fault = photograph(), IMAGE_FAULTS[name]
    one = fault(image, Shot("a", 4, SMALL), 2)
    np.testing.assert_array_equal(fault(image, Shot("a", 4, SMALL), 2), one)
    other_seed, other_frame = (fault(image, shot, 2) for shot in (Shot("a", 4, SMALL, 1), Shot("a", 5, SMALL)))
    by_chance = name in ("low light", "rain", "noise", "colour", "dirt")
    assert (difference(other_seed, one) > 0.3) == by_chance
    # Dirt and white balance stay where they are all along a scene.
    assert (difference(other_frame, one) > 0.3) == (by_chance and name not in ("colour", "dirt"))


def test_brighter_and_darker_scale_and_burn_out():
    image = np.full((4, 6, 3), 100, dtype=np.uint8)
    assert (IMAGE_FAULTS["exposure up"](image, Shot("a", 0, SMALL), 2) == 180).all()
    assert (IMAGE_FAULTS["exposure up"](image * 2, Shot("a", 0, SMALL), 2) == 255).all()
    assert (IMAGE_FAULTS["exposure down"](image, Shot("a", 0, SMALL), 2) == 50).all()


def test_fog_hides_what_is_far_and_leaves_what_is_near():
    distance = ground_distance(SMALL)
    # Straight down the middle column: height over the tangent of the angle below the horizon.
    row = SMALL.height - 1
    focal, centre = SMALL.intrinsics[1, 1], SMALL.intrinsics[1, 2]
    tangent = (row + 0.5 - centre) / focal
    expected = SMALL.camera_to_ego[2, 3] * np.sqrt(1 + tangent**-2)
    assert distance[row, SMALL.width // 2] == pytest.approx(expected, rel=2e-3)
    assert distance[0].min() == FARTHEST
    black = np.zeros((SMALL.height, SMALL.width, 3), dtype=np.uint8)
    veil = fog(black, Shot("a", 0, SMALL), 2)[..., 0].astype(float)
    assert veil[0].min() > 200 and veil[-1].max() < 100
    # Visibility is where 5 % of the contrast is left.
    at_60_metres = np.abs(distance - 60) < 4
    assert at_60_metres.any() and np.abs(veil[at_60_metres] - 0.95 * 205).max() < 5


def test_dirt_covers_the_share_it_says():
    white = np.full((450, 800, 3), 255, dtype=np.uint8)
    for severity, share in ((1, 0.04), (2, 0.10), (3, 0.20)):
        muddy = IMAGE_FAULTS["dirt"](white, Shot("a", 0, FRONT), severity)
        assert (muddy.mean(axis=2) < 160).mean() == pytest.approx(share, abs=0.02)
