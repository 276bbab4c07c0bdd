"""Crossings of many kinds, stop lines before them, and junctions that have stop lines and no crossing."""

from dataclasses import replace
from functools import cache

import numpy as np
import shapely

from predmapnet.demo_world.catalogue import vector_map
from predmapnet.demo_world.render.ground_texture import MATERIALS, paint_ground
from predmapnet.demo_world.render.paint import paint_quads
from predmapnet.demo_world.street.dressing import dress
from predmapnet.demo_world.street.looks import light_of
from predmapnet.demo_world.town.habits import SURFACES
from predmapnet.demo_world.world import Look

TOWNS = range(201, 213)


@cache
def town_map_of(number):
    return vector_map(f"scene-{number:04d}")


def test_some_crossings_are_paved_otherwise_and_some_worn():
    crossings = [crossing for number in TOWNS for crossing in town_map_of(number).crossings]
    assert {crossing.surface for crossing in crossings} <= {"", *SURFACES}
    assert set(SURFACES) <= set(MATERIALS)
    assert 0.05 < np.mean([bool(crossing.surface) for crossing in crossings]) < 0.5
    worn = [crossing.wear for crossing in crossings if crossing.wear is not None]
    assert 0.1 < len(worn) / len(crossings) < 0.6
    assert min(worn) > 0.3
    assert max(worn) < 0.8


def test_junctions_without_any_crossing_have_stop_lines():
    gaps = []
    for number in TOWNS:
        crossings = shapely.union_all([crossing.polygon for crossing in town_map_of(number).crossings])
        gaps += [crossings.distance(line) for line in town_map_of(number).stop_lines]
    assert 0.25 < np.mean(np.array(gaps) > 12.0) < 0.75
    near = np.array(gaps)[np.array(gaps) < 6.0]
    assert near.max() - near.min() > 2.0, "stop lines keep different distances from crossings"


def test_surface_and_wear_of_a_crossing_are_seen(street):
    town_map, drive = street
    kinds = [replace(town_map.crossings[0], surface="red_asphalt"), *town_map.crossings[1:]]
    texels = []
    for crossings in (town_map.crossings, tuple(kinds)):
        world = dress(replace(town_map, crossings=crossings), drive, Look.OVERCAST, 4, "a")
        fine = paint_ground(world, light_of(Look.OVERCAST, 4), 0.2)[0]
        x0, y0, cosine, sine, per_metre = fine.placement
        x, y = np.meshgrid(np.linspace(9.3, 12.2, 12), np.linspace(-6, 6, 40))
        column = ((cosine * (x - x0) + sine * (y - y0)) * per_metre).astype(int)
        row = ((cosine * (y - y0) - sine * (x - x0)) * per_metre).astype(int)
        texels.append(fine.base[row, column].astype(float))
    plain, red = texels
    assert np.median(red[..., 0] / red[..., 2]) > 1.4 > np.median(plain[..., 0] / plain[..., 2])

    worn = replace(town_map, crossings=tuple(replace(crossing, wear=0.7) for crossing in town_map.crossings))
    corners, coats = paint_quads(town_map, 4)
    other_corners, other_coats = paint_quads(worn, 4)
    np.testing.assert_array_equal(corners, other_corners)
    assert (other_coats[:, 0] == 0.7).sum() > (coats[:, 0] == 0.7).sum() + 20
