"""Cutting at tiles loses nothing, stitching gives it back, and stretches are paired whatever the direction."""

from __future__ import annotations

import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st

from mapfusion.elements import ElementKind
from mapfusion.geometry import arc_length
from mapfusion.merge.tiles import MergedLine, Stitcher, cut_line, tiles_of
from mapfusion.stretches import pair, sample_lines

spots = st.tuples(st.floats(-300, 300), st.floats(-300, 300))
paths = st.lists(spots, min_size=2, max_size=8, unique=True).map(lambda p: np.array(p, dtype=np.float64))


def pieces_of(points, side):
    values = arc_length(points)[:, None]
    tiles = tiles_of(points.min(axis=0), points.max(axis=0), side)
    return {tile: cut_line(points, values, tile.low, tile.high) for tile in tiles}


@settings(deadline=None)
@given(paths)
def test_the_parts_in_all_tiles_are_the_whole(points):
    found = [part for parts in pieces_of(points, 100.0).values() for part in parts]
    assert sum(arc_length(p)[-1] for p, _ in found) == pytest.approx(arc_length(points)[-1], rel=1e-6, abs=1e-6)
    line = shapely.LineString(points)
    for part, values in found:
        assert shapely.distance(shapely.points(part), line).max() < 1e-6
        # the value is the distance along the whole, so its step is the length of the part
        assert np.ptp(values) == pytest.approx(arc_length(part)[-1], rel=1e-6, abs=1e-6)


@settings(max_examples=40, deadline=None)
@given(st.floats(0, 2 * np.pi), st.floats(20.0, 900.0), st.floats(-250, 250), st.floats(-250, 250), st.booleans())
def test_stitching_gives_back_a_smooth_line(heading, length, x, y, turned):
    station = np.arange(0.0, length, 1.0)
    angle = heading + 0.3 * np.sin(station / 60.0)
    points = np.array([x, y]) + np.cumsum(np.stack([np.cos(angle), np.sin(angle)], axis=1), axis=0)
    cut = pieces_of(points, 100.0)
    stitcher = Stitcher(sorted(cut))
    whole = []
    for tile in sorted(cut):
        rows = slice(None, None, -1) if turned else slice(None)
        pieces = [MergedLine(ElementKind.DIVIDER, p[rows], np.c_[v, v][rows], {0: 3}, 1, 2) for p, v in cut[tile]]
        whole.extend(stitcher.add(tile, pieces))
    whole.extend(stitcher.rest())
    long = [piece for piece in whole if arc_length(piece.points)[-1] > 1.0]
    assert len(long) == 1
    assert arc_length(long[0].points)[-1] == pytest.approx(arc_length(points)[-1], abs=2.0)


@settings(max_examples=40, deadline=None)
@given(st.floats(-1.0, 1.0), st.booleans(), st.floats(-np.pi, np.pi))
def test_a_shifted_line_is_paired_along_its_length(offset, turned, heading):
    rotation = np.array([[np.cos(heading), -np.sin(heading)], [np.sin(heading), np.cos(heading)]])
    x = np.linspace(0.0, 80.0, 40)
    base = np.stack([x, 3 * np.sin(x / 20)], axis=1)
    normal = np.stack([-3 / 20 * np.cos(x / 20), np.ones(40)], axis=1)
    normal /= np.linalg.norm(normal, axis=1)[:, None]
    other = (base + offset * normal)[:: -1 if turned else 1] @ rotation.T
    found = pair(sample_lines([base @ rotation.T], 0.5), sample_lines([other], 0.5), 1.5)
    assert found.found.mean() > 0.97
    np.testing.assert_allclose(found.distance[found.found], abs(offset), atol=0.03)


def test_a_crossing_line_is_no_partner():
    first = sample_lines([np.array([[0.0, 0.0], [50.0, 0.0]])], 0.5)
    second = sample_lines([np.array([[25.0, -20.0], [25.0, 20.0]])], 0.5)
    assert not pair(first, second, 2.0).found.any()
