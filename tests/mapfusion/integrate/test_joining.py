"""Pieces of one line become one line; what turns back, runs beside or was seen to be bare stays apart."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st

from mapfusion import ElementKind, IntegratorConfig, MapElement, MapIntegrator, RegionOfInterest
from mapfusion.ground import CameraSector, visible_ground
from mapfusion.integrate.joined_map import JoinedMap
from mapfusion.integrate.views import ViewGrid
from mapfusion.line_repair import hairpins
from tests.mapfusion.integrate.test_integrator_properties import frame_map, integrate
from tests.mapfusion.map_quality import dense, faults, nearest
from tests.mapfusion.simulation import ROI, pose, town_drive

CONFIG = IntegratorConfig()
DIVIDER, BOUNDARY = ElementKind.DIVIDER, ElementKind.BOUNDARY


def line(points, kind=DIVIDER, **more) -> MapElement:
    points = np.array(points, dtype=np.float64)
    return replace(MapElement(kind, points, 0.9, 5, 3, 9, (1,), np.full(len(points), 0.1)), **more)


def joined(*elements, looked: int = 0) -> list[MapElement]:
    views = ViewGrid(CONFIG)
    for _ in range(looked):
        views.add(np.eye(4), RegionOfInterest())
    joined_map = JoinedMap()
    for number, element in enumerate(elements):
        joined_map.put(number, [element])
    return list(joined_map.elements(views, CONFIG))


@settings(max_examples=60, deadline=None, derandomize=True)
@given(
    st.lists(st.floats(0.15, 0.85), min_size=1, max_size=3, unique_by=lambda share: round(share * 5)),
    st.floats(-3.0, 3.0),
    st.integers(0, 31),
    st.permutations(range(4)),
    st.floats(-0.02, 0.02),
)
def test_a_line_cut_anywhere_is_whole_again(shares, gap, turned, order, bend):
    x = np.linspace(-50.0, 50.0, 101)
    whole = shapely.LineString(np.stack([x, bend * x**2 / 2], axis=1))
    edges = [0.0, *sorted(shares), 1.0]
    pieces = []
    for number, (a, b) in enumerate(pairwise(edges)):
        start = a * whole.length + (gap / 2 if number else 0.0)
        stop = b * whole.length - (gap / 2 if b < 1.0 else 0.0)
        points = shapely.get_coordinates(shapely.ops.substring(whole, start, stop))
        pieces.append(line(points[::-1] if turned >> number & 1 else points, track_ids=(number,)))
    (found,) = joined(*(pieces[i] for i in order if i < len(pieces)))
    assert found.track_ids == tuple(range(len(pieces)))
    assert found.length == pytest.approx(whole.length, rel=0.02)
    assert len(found.deviation) == len(found.points)
    assert nearest(dense(found.points), [shapely.get_coordinates(whole)]).max() < 0.3
    assert shapely.LineString(found.points).is_simple


def test_evidence_of_the_pieces_is_kept():
    one, two = line([[0, 0], [30, 0]]), line([[40, 0], [31, 0]], confidence=0.5, observations=8, first_seen=1)
    (found,) = joined(one, two)
    assert found.confidence == pytest.approx((30 * 0.9 + 9 * 0.5) / 39)
    assert (found.observations, found.first_seen, found.last_seen) == (8, 1, 9)


@pytest.mark.parametrize(
    "other",
    [
        line([[31, 0], [50, 0]], BOUNDARY),
        line([[30.5, 0.5], [30.5, 20]]),
        line([[30, 1.5], [60, 1.5]]),
        line([[29.5, 0.3], [2, 0.3]]),
        line([[42, 0], [60, 0]]),
    ],
    ids=["another kind", "round a corner", "beside", "parallel", "too far"],
)
def test_what_is_another_line_stays_apart(other):
    assert len(joined(line([[0, 0], [30, 0]]), other)) == 2


def test_a_gap_is_closed_unless_it_was_looked_at():
    one, two = line([[-20, 0], [-3, 0]]), line([[3, 0], [20, 0]])
    assert len(joined(one, two)) == 1
    assert len(joined(one, two, looked=8)) == 2


@pytest.mark.parametrize("seed", [0, 3])
def test_maps_made_on_the_way_change_nothing(seed):
    """What is joined, cut and left out around each change is what one look at the whole map would give."""
    watched, alone = MapIntegrator(), MapIntegrator()
    drive = town_drive(seed)
    for number, frame in enumerate([*drive.frames, *town_drive(seed + 1).frames]):
        log = str(number // len(drive.frames))
        watched.add(frame, log)
        alone.add(frame, log)
        if number % 3 == 0:
            watched.map()
    for one, other in zip(watched.map(), alone.map(), strict=True):
        np.testing.assert_array_equal(one.points, other.points)
        assert (one.kind, one.confidence, one.origins) == (other.kind, other.confidence, other.origins)


def test_a_gap_that_is_looked_at_later_parts_what_was_joined():
    sides = [np.array([[-30.0, 0.0], [-3.0, 0.0]]), np.array([[3.0, 0.0], [30.0, 0.0]])]
    integrator = MapIntegrator()
    for number in range(8):
        for side, x in enumerate((-33.0, 33.0)):
            seen = frame_map([sides[side] - [x, 0.0]], number=number, ego_to_global=pose(x, 0.0, 0.0))
            integrator.add(seen, log=f"side {side}")
    assert len(integrator.map()) == 1
    for number in range(8):
        integrator.add(frame_map(sides, number=number), log="between")
    assert len(integrator.map()) == 2


def test_a_loop_of_two_pieces_is_closed():
    turn = np.linspace(0.0, np.pi, 30)
    side = np.stack([9 * np.cos(turn), 8 * np.sin(turn) + 0.2], axis=1)
    (found,) = joined(line(side, BOUNDARY), line(side * [1, -1], BOUNDARY))
    assert (found.points[0] == found.points[-1]).all()
    assert shapely.Polygon(found.points).is_valid


def test_what_stands_before_a_line_all_the_time_does_not_cut_it():
    van = np.array([[-3.0, 1.5], [2.0, 1.5], [2.0, 2.5], [-3.0, 2.5]])
    hidden = visible_ground(ROI, [CameraSector(np.array([0.0, -1.5]))], [van])
    pieces = [[[-25, 3.0], [-5, 3.0]], [[2.5, 3.0], [25, 3.0]]]
    frames = [frame_map(pieces, [2, 2], number=i) for i in range(20)]
    assert len(integrate(frames)) == 2
    (found,) = integrate([replace(frame, visible=hidden) for frame in frames])
    assert found.length == pytest.approx(50.0, abs=1.0)


@settings(max_examples=30, deadline=None, derandomize=True)
@given(st.floats(4.0, 40.0), st.floats(0.0, 6.3), st.integers(0, 5))
def test_the_legs_of_a_narrow_tip_are_two_lines(opening, heading, seed):
    """The tip of a gore, seen with noise: neither leg is lost, neither is fused with the other."""
    half = np.radians(opening) / 2
    out = np.linspace(20.0, 0.0, 11)
    legs = [np.stack([out * np.cos(a), out * np.sin(a)], axis=1) for a in (half, -half)]
    tip = np.concatenate([legs[0], legs[1][-2::-1]]) - [10.0, 0.0]
    rng = np.random.default_rng(seed)
    integrator = MapIntegrator()
    for number in range(8):
        noisy = tip + rng.normal(0.0, 0.08, 2)
        integrator.add(frame_map([noisy[:: 1 if number % 3 else -1]], number=number))
    found = integrator.map()
    assert faults(found) == []
    assert (nearest(dense(tip), [e.points for e in found]) < 0.5).mean() > 0.95
    turned = pose(0.0, 0.0, heading)[:2, :2]
    assert hairpins(tip @ turned.T) == [10]


def test_a_bend_is_no_hairpin():
    turn = np.linspace(0.0, np.pi, 20)
    assert hairpins(6.0 * np.stack([np.cos(turn), np.sin(turn)], axis=1)) == []
