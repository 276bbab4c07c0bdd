"""Properties of the geometry for any polyline: resampling, poses, clipping, chamfer distance; and outlines of grids."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from mapfusion import RegionOfInterest
from mapfusion.geometry import arc_length, chamfer_distance, clip_line, inverse_pose, resample, transform_points
from mapfusion.line_repair import repaired_rows
from mapfusion.signed_distance import positive_areas
from tests.mapfusion.simulation import pose

coordinate = st.floats(-100, 100, width=32)
millimetres = st.integers(-100_000, 100_000).map(lambda number: number / 1000.0)
lines = st.lists(st.tuples(coordinate, coordinate), min_size=2, max_size=15).map(
    lambda p: np.array(p, dtype=np.float64)
)
surveyed_lines = st.lists(st.tuples(millimetres, millimetres), min_size=2, max_size=15).map(np.array)
"""Lines whose vertices are at least a millimetre apart, or equal."""
poses = st.builds(pose, st.floats(-1e4, 1e4), st.floats(-1e4, 1e4), st.floats(-np.pi, np.pi))


@given(lines, st.integers(2, 60))
def test_resampled_lines_keep_their_ends_and_never_grow(points, count):
    result = resample(points, count)
    assert result.shape == (count, 2)
    np.testing.assert_allclose(result[[0, -1]], points[[0, -1]], atol=1e-9)
    assert arc_length(result)[-1] <= arc_length(points)[-1] * (1 + 1e-9) + 1e-9


@given(lines, poses)
def test_a_pose_and_its_inverse_cancel(points, a_to_b):
    there = transform_points(a_to_b, points)
    np.testing.assert_allclose(transform_points(inverse_pose(a_to_b), there), points, atol=1e-8)
    np.testing.assert_allclose(arc_length(there), arc_length(points), atol=1e-8)


@given(lines)
def test_clipped_parts_lie_inside_and_are_no_longer_than_the_line(points):
    assume(arc_length(points)[-1] > 1e-3)
    roi = RegionOfInterest()
    parts = clip_line(points, roi)
    assert all((np.abs(part) <= roi.size / 2 + 1e-9).all() for part in parts)
    assert sum(arc_length(part)[-1] for part in parts) <= arc_length(points)[-1] + 1e-6


def test_a_line_that_folds_back_or_crosses_itself_is_cut_at_the_border_only():
    there_and_back = np.array([[0.0, 0.0], [1.0, 16.0], [0.0, 0.0]])
    lengths = [arc_length(part)[-1] for part in clip_line(there_and_back, RegionOfInterest())]
    assert lengths == pytest.approx([np.hypot(15.0, 0.9375)] * 2)
    bow = np.array([[0.0, 0.0], [10.0, 10.0], [0.0, 10.0], [10.0, 0.0], [40.0, 0.0]])
    (part,) = clip_line(bow, RegionOfInterest())
    np.testing.assert_allclose(part, [[0, 0], [10, 10], [0, 10], [10, 0], [30, 0]])


@given(lines, lines)
def test_chamfer_distance_is_symmetric_and_zero_for_the_same_points(first, second):
    assert chamfer_distance(first, second) == pytest.approx(chamfer_distance(second, first))
    assert chamfer_distance(first, first) == 0.0


@settings(max_examples=50)
@given(st.floats(4, 12), st.floats(4, 12), st.floats(0, 3))
def test_the_outline_of_a_disc_is_a_circle(x, y, phase):
    rows, columns = np.meshgrid(np.arange(17.0), np.arange(17.0), indexing="ij")
    outlines = positive_areas(3.0 + phase - np.hypot(rows - x, columns - y))
    assert outlines[0].is_valid
    assert outlines[0].area == pytest.approx(np.pi * (3.0 + phase) ** 2, rel=0.06) or 3.0 + phase > 4.0


@given(surveyed_lines)
def test_tidy_lines_do_not_cross_themselves(points):
    import shapely

    rows = repaired_rows(points)
    assert (np.diff(rows) > 0).all()
    remaining = points[rows]
    assume(len(remaining) > 1 and arc_length(remaining)[-1] > 0)
    assert shapely.is_simple(shapely.LineString(remaining)) or len(remaining) <= 3
