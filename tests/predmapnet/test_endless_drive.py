"""The memory of a drive does not grow with its length."""

from itertools import pairwise

import pytest

from mapfusion.integrate.integrator import MapIntegrator
from predmapnet.demo_world.source import DemoSource
from predmapnet.mapper import Mapper
from tests.benchmarks.endless_drive import SCENE, drive, endless_frames

pytestmark = pytest.mark.slow  # The scene is rendered first.

LAP = 40


def test_laps_follow_one_another_like_frames():
    scene = DemoSource().open(SCENE)
    frames = [frame for frame, _ in zip(endless_frames(scene), range(2 * LAP + 1), strict=False)]
    integrator = MapIntegrator()
    for before, after in pairwise(frames):
        moved = after.ego_to_global[:2, 3] - before.ego_to_global[:2, 3]
        assert after.timestamp > before.timestamp
        assert (moved**2).sum() ** 0.5 < integrator.config.max_speed * 1e-9 * (after.timestamp - before.timestamp)


def test_the_state_of_a_long_drive_stays_as_large_as_it_was():
    laps = list(drive(Mapper.from_checkpoint(), DemoSource().open(SCENE), 10 * LAP, LAP))
    early, late = [lap.state_bytes for lap in laps[1:4]], [lap.state_bytes for lap in laps[-3:]]
    assert max(late) <= 1.1 * max(early)
    assert laps[-1].megabytes <= laps[1].megabytes + 50
    assert laps[-1].elements > laps[0].elements
