"""Clutter: it is seen, it is no truth, and towns have it as often as is said."""

from dataclasses import replace

import numpy as np
import pytest
import shapely

from predmapnet.demo_world.catalogue import build_world, vector_map
from predmapnet.demo_world.render.ground_texture import paint_ground, road_of
from predmapnet.demo_world.street.clutter import BARE_SHARE, SYMBOLS, Rates
from predmapnet.demo_world.street.dressing import dress
from predmapnet.demo_world.street.ground_clutter import GROUND_KINDS
from predmapnet.demo_world.street.looks import light_of
from predmapnet.demo_world.world import Clutter, Look

SCENES = ["scene-0205", "scene-0211", "scene-0215"]


@pytest.fixture(scope="module")
def worlds():
    return [build_world(name) for name in SCENES]


def test_clutter_keeps_off_crossings_and_on_the_road(worlds):
    painted = 0
    for world in worlds:
        painted += len(world.clutter.paint)
        hulls = shapely.convex_hull(shapely.multipoints(world.clutter.paint))
        crossings = shapely.union_all([crossing.polygon for crossing in world.map.crossings])
        assert not shapely.intersects(hulls, crossings).any()
        assert shapely.within(hulls, road_of(world).buffer(0.3)).mean() > 0.99
        assert len(world.clutter.coats) == len(world.clutter.paint)
    assert painted > 50


def test_clutter_adds_nothing_to_the_map(worlds):
    for name, world in zip(SCENES, worlds, strict=True):
        plain = vector_map(name)
        assert world.map == plain
        assert sum(len(quads) for _, quads in world.clutter.patches) > 20


def test_towns_have_each_kind_as_often_as_said():
    drawn = [set(Rates.draw(np.random.default_rng(seed)).by_kind) for seed in range(600)]
    bare = np.mean([not kinds for kinds in drawn])
    assert BARE_SHARE - 0.05 < bare < BARE_SHARE + 0.06
    for name, share in [(name, entry[1]) for name, entry in (SYMBOLS | GROUND_KINDS).items()]:
        assert abs(np.mean([name in kinds for kinds in drawn]) - (1 - BARE_SHARE) * share) < 0.06, name


def test_first_towns_and_real_maps_have_none(street):
    for world in (build_world("scene-0101", 1), dress(*street, Look.DAY, 4, "a")):
        assert (world.clutter.patches, world.clutter.stains, world.clutter.shadows) == ((), (), ())
        assert len(world.clutter.paint) == 0
        assert world.clutter.kerbs == Clutter().kerbs


def test_clutter_is_seen_where_it_lies_and_shadows_only_in_the_sun(street):
    square = np.array([[-20.0, -2.5], [-18.0, -2.5], [-18.0, -0.5], [-20.0, -0.5]])
    moved = [square + np.array([12.0 * number, 0.0]) for number in range(4)]
    clutter = Clutter(
        patches=(("tar", moved[0][None]),), paint=moved[1][None], coats=np.array([[0.0, 0.8, 0.0]]),
        stains=((moved[2], 60),), shadows=((moved[3], 0),),
    )  # fmt: skip
    seen = {}
    for look in (Look.DAY, Look.OVERCAST):
        plain = dress(*street, look, 4, "a")
        for world in (plain, replace(plain, clutter=clutter)):
            fine = paint_ground(world, light_of(look, 4), 0.2)[0]
            seen[look, world is plain] = [_texel(fine, corners.mean(axis=0)) for corners in moved]
    for look in (Look.DAY, Look.OVERCAST):
        before, after = np.array(seen[look, True], dtype=float), np.array(seen[look, False], dtype=float)
        assert after[0, 0] < 0.85 * before[0, 0]
        assert after[1, 0] > 1.5 * before[1, 0]
        assert after[2, 0] < 0.7 * before[2, 0]
        assert (after[3, 3] < before[3, 3]) == (look is Look.DAY)


def _texel(pyramid, place):
    x0, y0, cosine, sine, per_metre = pyramid.placement
    dx, dy = place[0] - x0, place[1] - y0
    column, row = int((cosine * dx + sine * dy) * per_metre), int((cosine * dy - sine * dx) * per_metre)
    return pyramid.texels[row * pyramid.levels[2, 0] + column]
