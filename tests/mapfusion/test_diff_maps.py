"""Diffs: lines removed, added and moved, whatever the elements that they are cut into."""

from __future__ import annotations

import json
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
import shapely
import shapely.ops
from hypothesis import given, settings
from hypothesis import strategies as st

from mapfusion import ElementKind, GlobalMap, MapElement
from mapfusion.diff import Change, DiffConfig, diff_maps
from mapfusion.diff_files import read_diff, write_diff
from mapfusion.formats.local_plane import LocalPlane
from mapfusion.geometry import resample
from mapfusion.ground import RIM, observed_rings
from mapfusion.stretches import settle
from tests.mapfusion.simulation import town_road

DIVIDER, BOUNDARY, CROSSING = ElementKind.DIVIDER, ElementKind.BOUNDARY, ElementKind.PED_CROSSING


def line(points, kind=DIVIDER) -> MapElement:
    return MapElement(kind, np.array(points, dtype=np.float64), 0.9, 10, 0, 1)


def town(seed: int = 3) -> GlobalMap:
    return town_road(np.random.default_rng(seed))[0]


def total(found, change) -> float:
    return sum(found.metres(change, kind) for kind in ElementKind)


def cut(element: MapElement, shares) -> list[MapElement]:
    """Cut a line at shares of its length, the pieces turned about at will."""
    if element.kind.is_ring:
        return [element]
    whole = shapely.LineString(element.points)
    at = [0.0, *sorted(shares), 1.0]
    pieces = [shapely.ops.substring(whole, a, b, normalized=True) for a, b in pairwise(at)]
    points = [shapely.get_coordinates(piece) for piece in pieces if piece.length > 0.01]
    return [replace(element, points=p[::-1] if i % 2 else p) for i, p in enumerate(points)]


@settings(max_examples=10, deadline=None)
@given(st.lists(st.floats(0.02, 0.98), max_size=4), st.integers(0, 5))
def test_cutting_lines_otherwise_changes_nothing(shares, seed):
    old = town(seed)
    new = GlobalMap(tuple(piece for element in old for piece in cut(element, shares)))
    found = diff_maps(old, new)
    length = sum(element.extent[0] for element in old)
    assert total(found, Change.UNCHANGED) == pytest.approx(length, rel=1e-3)
    assert all(total(found, change) == 0.0 for change in Change if change is not Change.UNCHANGED)


def test_removed_added_moved_and_unobserved_are_told_apart_and_measured():
    x = np.linspace(0.0, 200.0, 41)

    def straight(y, lo=0.0, hi=200.0):
        return [[lo, y], [hi, y]]

    bent = np.stack([x, 3.5 + 1.2 * ((x > 60) & (x < 140))], axis=1)
    old = GlobalMap(
        (
            line(straight(0.0), BOUNDARY),
            line(straight(7.0), BOUNDARY),
            line(straight(3.5)),
            line(straight(-30.0, 0, 50), BOUNDARY),
            line([[20, 0], [24, 0], [24, 7], [20, 7], [20, 0]], CROSSING),
        )
    )
    new = GlobalMap(
        (
            line(straight(0.0, 0.0, 80.0), BOUNDARY),
            line(straight(0.0, 110.0, 200.0), BOUNDARY),
            line(straight(7.0), BOUNDARY),
            line(bent),
            line([[150, 0], [154, 0], [154, 7], [150, 7], [150, 0]], CROSSING),
        )
    )
    found = diff_maps(old, new, config=DiffConfig(align=False))
    assert found.metres(Change.REMOVED, BOUNDARY) == pytest.approx(30.0, abs=1.5)
    assert found.metres(Change.UNOBSERVED, BOUNDARY) == pytest.approx(50.0, abs=0.1)
    assert found.metres(Change.MOVED, DIVIDER) == pytest.approx(80.0, abs=6.0)
    assert found.moved_by(DIVIDER) == pytest.approx(1.2, abs=0.02)
    assert found.count(Change.REMOVED, CROSSING) == found.count(Change.ADDED, CROSSING) == 1
    assert found.metres(Change.ADDED, BOUNDARY) == 0.0


def test_a_crossing_that_moved_says_how_far():
    ring = np.array([[20, 0], [24, 0], [24, 7], [20, 7], [20, 0]], dtype=float)
    old, new = (GlobalMap((line(points, CROSSING),)) for points in (ring, ring + np.array([2.5, 0.0])))
    found = diff_maps(old, new)
    assert found.count(Change.MOVED, CROSSING) == 1
    assert found.moved_by(CROSSING) == pytest.approx(2.5)


def test_what_lies_within_the_uncertainty_of_the_maps_has_not_moved():
    road = [[0, 0], [100, 0]]
    moved = [[0, 0.9], [100, 0.9]]

    def metres(old_deviation, new_deviation, points=moved):
        old, new = (
            GlobalMap((replace(line(p), deviation=None if d is None else np.full(2, d)),))
            for p, d in ((road, old_deviation), (points, new_deviation))
        )
        return diff_maps(old, new, config=DiffConfig(align=False)).metres(Change.MOVED, DIVIDER)

    assert metres(None, None) == pytest.approx(100.0)
    assert metres(0.1, 0.1) == pytest.approx(100.0)
    assert metres(0.4, 0.4) == 0.0
    assert metres(0.6, None) == 0.0
    # one end of the line is known well, the other is not
    sloping = replace(line(road), deviation=np.array([0.05, 1.0]))
    found = diff_maps(GlobalMap((sloping,)), GlobalMap((line(moved),)), config=DiffConfig(align=False))
    assert found.metres(Change.MOVED, DIVIDER) == pytest.approx(43.0, abs=3.0)


def test_a_crossing_that_lies_within_its_uncertainty_has_not_moved():
    ring = np.array([[20, 0], [24, 0], [24, 7], [20, 7], [20, 0]], dtype=float)
    for deviation, moved in ((0.2, 1), (0.8, 0)):
        old, new = (
            GlobalMap((replace(line(points, CROSSING), deviation=np.full(5, deviation)),))
            for points in (ring, ring + np.array([1.6, 0.0]))
        )
        assert diff_maps(old, new, config=DiffConfig(align=False)).count(Change.MOVED, CROSSING) == moved


def test_one_line_does_not_stand_for_two():
    double = GlobalMap((line([[0, 0.15], [100, 0.15]]), line([[0, -0.15], [100, -0.15]])))
    single = GlobalMap((line([[0, 0.1], [100, 0.1]]),))
    found = diff_maps(double, single)
    assert found.metres(Change.UNCHANGED, DIVIDER) == pytest.approx(100.0, abs=1.0)
    assert found.metres(Change.REMOVED, DIVIDER) == pytest.approx(100.0, abs=1.0)


def test_an_offset_between_drives_is_not_a_change():
    old = town()
    shifted = GlobalMap(tuple(replace(e, points=e.points + np.array([1.1, -0.8])) for e in old))
    found = diff_maps(old, shifted)
    assert found.alignment.certain
    assert np.abs(found.alignment.shift - [-1.1, 0.8]).max() < 0.03
    assert total(found, Change.UNCHANGED) == pytest.approx(sum(e.extent[0] for e in old), rel=0.01)
    as_it_lies = diff_maps(old, shifted, config=DiffConfig(align=False))
    assert total(as_it_lies, Change.MOVED) > 0.5 * sum(e.extent[0] for e in old)


@given(st.lists(st.integers(-1, 3), min_size=1, max_size=60), st.integers(1, 8))
def test_settling_leaves_no_short_runs(states, shortest):
    settled = settle(np.array(states), shortest)
    lengths = np.diff(np.flatnonzero(np.append(True, np.append(np.diff(settled) != 0, True))))
    assert (lengths >= shortest).all() or len(lengths) == 1
    assert set(settled.tolist()) <= set(states)


def test_the_file_is_geojson_with_every_stretch(tmp_path):
    old, new = town(1), GlobalMap(town(1).elements[3:])
    found = diff_maps(old, new)
    write_diff(found, tmp_path / "diff.geojson", LocalPlane(8.0, 49.0))
    features = json.loads((tmp_path / "diff.geojson").read_text())["features"]
    assert len(features) == len(found.differences)
    assert {f["properties"]["change"] for f in features} >= {"unchanged", "removed"}
    assert resample(np.array(features[-1]["geometry"]["coordinates"]).reshape(-1, 2), 2).shape == (2, 2)


@settings(max_examples=10, deadline=None)
@given(st.integers(0, 5), st.floats(0.0, 2.0), st.integers(0, 4))
def test_a_file_gives_its_differences_back(tmp_path_factory, seed, shift, lost):
    plane, path = LocalPlane(8.0, 49.0), tmp_path_factory.mktemp("diff") / "diff.geojson"
    later = GlobalMap(tuple(replace(e, points=e.points + shift) for e in town(seed).elements[lost:]))
    found = diff_maps(town(seed), later, plane, DiffConfig(align=False))
    write_diff(found, path, plane, {"old": "a"})
    again, own_plane, told = read_diff(path)
    assert told["old"] == "a"
    for stored, item in zip(again.differences, found.differences, strict=True):
        assert (stored.change, stored.kind) == (item.change, item.kind)
        assert stored.length == pytest.approx(item.length, abs=1e-3)
        assert stored.moved_by == pytest.approx(item.moved_by, abs=1e-3, nan_ok=True)
        assert stored.confidence == pytest.approx(item.confidence, abs=1e-4)
        ways = plane.from_wgs84(own_plane.to_wgs84(stored.points))
        assert shapely.hausdorff_distance(shapely.LineString(ways), shapely.LineString(item.points)) < 1e-3


def test_empty_maps_compare():
    empty = GlobalMap(())
    assert not diff_maps(empty, empty).differences
    found = diff_maps(empty, town())
    assert total(found, Change.ADDED) == pytest.approx(sum(e.extent[0] for e in town()), rel=1e-3)
    assert total(diff_maps(town(), empty), Change.UNOBSERVED) > 0


def test_the_ground_that_a_drive_says_it_saw_decides_between_removed_and_unobserved():
    plane = LocalPlane(8.0, 49.0)
    kerb = line([[0, 0], [200, 0]], BOUNDARY)
    far = line([[0, 25], [200, 25]], BOUNDARY)
    seen = shapely.box(-30.0, -15.0, 120.0, 40.0).difference(shapely.box(20.0, 20.0, 60.0, 30.0))
    rings = observed_rings(seen, plane)
    found = diff_maps(GlobalMap((kerb, far)), GlobalMap((kerb,), {"observed": rings}), plane, DiffConfig(align=False))
    assert found.metres(Change.REMOVED, BOUNDARY) == pytest.approx(80.0 - 3 * RIM, abs=1.0)
    assert found.metres(Change.UNOBSERVED, BOUNDARY) == pytest.approx(120.0 + 3 * RIM, abs=1.0)
    guessed = diff_maps(GlobalMap((kerb, far)), GlobalMap((kerb,)), plane, DiffConfig(align=False))
    assert guessed.metres(Change.REMOVED, BOUNDARY) == 0.0
