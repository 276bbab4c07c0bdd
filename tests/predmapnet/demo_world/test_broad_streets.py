"""Broad streets: parked rows along both kerbs, never in a lane that is driven, and kerbs that are hard to see."""

from dataclasses import replace

import numpy as np
import pytest
import shapely

from predmapnet.demo_world.catalogue import build_world, town_of
from predmapnet.demo_world.street.dressing import dress
from predmapnet.demo_world.street.manner import Manner
from predmapnet.demo_world.street.traffic import ego_corridor, footprint
from predmapnet.demo_world.town.cross_sections import BROAD, Use, draw_section
from predmapnet.demo_world.town.habits import Habits
from predmapnet.demo_world.town.street_plan import Rank
from predmapnet.demo_world.world import Look, Trajectory, VectorMap


def test_broad_streets_have_parking_along_both_kerbs_and_lanes_between():
    widths = []
    for seed in range(150):
        random = np.random.default_rng(seed)
        habits = replace(Habits.draw(random), broad_share=1.0)
        section = draw_section(random, list(Rank)[seed % 3], habits)
        edges = section.edges(np.zeros(1))[:, 0]
        widths.append(edges[0] - edges[-1])
        for outer in (section.strips[0], section.strips[-1]):
            assert outer.use is Use.PARKING or outer.parked > 1.8
        assert {strip.direction for strip in section.strips if strip.use is Use.LANE} == {1, -1}
        driven = [strip.width - strip.parked for strip in section.strips if strip.use is Use.LANE]
        assert min(driven) > 2.6
    assert BROAD[0] <= min(widths) < 14.0
    assert 21.0 < max(widths) <= BROAD[1]


def test_about_a_quarter_of_the_streets_are_broad_and_some_towns_have_none():
    shares = np.array([Habits.draw(np.random.default_rng(seed)).broad_share for seed in range(300)])
    assert 0.4 < np.mean(shares == 0.0) < 0.6
    assert 0.2 < shares.mean() < 0.35


@pytest.fixture(scope="module")
def broad_street():
    """A straight street 18 m wide with parking strips along both kerbs, in pieces of 24 m, and a drive along it."""
    starts = np.arange(-96.0, 96.0, 24.0)
    bays = [shapely.box(x, low, x + 24.0, low + 2.3) for x in starts for low in (6.7, -9.0)]
    vector_map = VectorMap((shapely.box(-100, -9, 100, 9),), (), (), (), parking=tuple(bays))
    poses = np.tile(np.eye(4), (12, 1, 1))
    poses[:, 0, 3], poses[:, 1, 3] = np.linspace(-40, 40, 12), -2.0
    return vector_map, Trajectory(np.arange(12) * 500_000_000, poses)


def parked_in(world):
    solids = world.solids
    rows = np.flatnonzero((solids.texture == "vehicle") & ~solids.velocity.any(axis=1))
    return [footprint(solids.centre[row], solids.yaw[row], solids.size[row]) for row in rows]


def test_parked_rows_hide_long_stretches_of_both_kerbs_with_gaps(broad_street):
    hidden = {1: [], -1: []}
    for seed in [seed for seed in range(40) if Manner.draw(seed).parked][:8]:
        outlines = parked_in(dress(*broad_street, Look.DAY, seed, "a", cluttered=True))
        for side, shares in hidden.items():
            row = [outline.bounds for outline in outlines if side * outline.centroid.y > 5.0]
            along = shapely.union_all([shapely.box(west, 0, east, 1) for west, _, east, _ in row])
            shares.append(along.intersection(shapely.box(-90, 0, 90, 1)).area / 180.0)
    for shares in hidden.values():
        assert 0.45 < np.mean(shares) < 0.8
        assert max(shares) > 0.6
        assert min(shares) < 0.68


@pytest.mark.parametrize("name", ["scene-0205", "scene-0211", "scene-0218", "scene-0230"])
def test_nobody_parks_in_the_lane_that_is_driven(name):
    world = build_world(name)
    way = ego_corridor(world.trajectory, width=3.0)
    assert not any(outline.intersects(way) for outline in parked_in(world))
    assert town_of(name).vector_map.parking


def test_kerbs_of_some_towns_are_hardly_to_be_seen():
    manners = [Manner.draw(seed) for seed in range(400)]
    assert abs(np.mean([manner.parked is not None for manner in manners]) - 0.5) < 0.08
    assert abs(np.mean([manner.paved_alike for manner in manners]) - 0.25) < 0.07
    for manner in manners:
        assert sum(manner.kerbs) == pytest.approx(1.0)
    light = np.array([manner.kerbs[0] for manner in manners])
    assert abs(np.mean(light < 0.1) - 0.55) < 0.08


def test_sidewalks_are_made_as_the_road_is_where_a_town_paves_alike(broad_street):
    seeds = {alike: next(n for n in range(50) if Manner.draw(n).paved_alike is alike) for alike in (True, False)}
    walkway = shapely.box(-100, 9, 100, 12)
    town_map = replace(broad_street[0], walkways=(walkway,))
    for alike, seed in seeds.items():
        surfaces = dress(town_map, broad_street[1], Look.DAY, seed, "a", cluttered=True).surfaces
        beside = next(surface.material for surface in surfaces if surface.polygon.equals(walkway))
        road = next(surface.material for surface in surfaces if surface.polygon.equals(town_map.road_segments[0]))
        assert (road == beside) is alike
