"""Order-aware AP: cases whose value is known by hand, and a plain implementation beside the compiled one."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from predmapnet.evaluation.chamfer_distance import chamfer_matrix, resample_all
from predmapnet.evaluation.frechet_ap import frechet_matrix

FAR = 1e9


def distance(first, second, kind=1, count=100, limit=FAR):
    lines = resample_all([np.array(first, float), np.array(second, float)], count)
    kinds = np.array([kind])
    return frechet_matrix(lines[:1], kinds, lines[1:], kinds, limit)[0, 0]


def plain(first, second):
    """The recursion of Eiter and Mannila as it stands in the paper."""
    apart = np.linalg.norm(first[:, None] - second[None, :], axis=2)
    reach = np.zeros_like(apart)
    for row in range(len(first)):
        for column in range(len(second)):
            before = [
                reach[i, j]
                for i, j in ((row - 1, column), (row, column - 1), (row - 1, column - 1))
                if i >= 0 and j >= 0
            ]
            reach[row, column] = max(min(before, default=0.0), apart[row, column])
    return reach[-1, -1]


def test_parallel_lines_are_as_far_apart_as_they_run():
    assert distance([[0, 0], [20, 0]], [[0, 1.5], [20, 1.5]]) == pytest.approx(1.5)


def test_the_direction_of_a_line_does_not_matter():
    assert distance([[0, 0], [20, 4]], [[20, 4], [0, 0]]) == pytest.approx(0.0)


def test_the_start_of_a_crossing_does_not_matter():
    ring = [[0, 0], [8, 0], [8, 4], [0, 4], [0, 0]]
    turned = [[8, 4], [0, 4], [0, 0], [8, 0], [8, 4]]
    assert distance(ring, turned, kind=0, count=97) == pytest.approx(0.0, abs=1e-9)
    assert distance(ring, turned[::-1], kind=0, count=97) == pytest.approx(0.0, abs=1e-9)


def test_a_line_that_goes_back_on_itself_is_far_by_order_but_near_by_chamfer():
    """There and back and there again over 10 m: the leash must span half of it, the point sets are the same."""
    line, again = [[0, 0], [10, 0]], [[0, 0], [10, 0], [0, 0], [10, 0]]
    assert distance(line, again) == pytest.approx(5.0, abs=0.1)
    sampled = resample_all([np.array(line, float), np.array(again, float)], 100)
    kinds = np.array([1])
    assert chamfer_matrix(sampled[:1], kinds, sampled[1:], kinds)[0, 0] < 0.1


def test_pairs_beyond_the_limit_and_of_other_kinds_are_infinite():
    assert distance([[0, 0], [20, 0]], [[0, 4], [20, 4]], limit=3.0) == np.inf
    lines = np.zeros((1, 100, 2))
    assert frechet_matrix(lines, np.array([1]), lines, np.array([2]), FAR)[0, 0] == np.inf


points = st.lists(st.tuples(st.floats(-30, 30), st.floats(-15, 15)), min_size=2, max_size=6)


@settings(deadline=None, max_examples=30)
@given(points, points)
def test_the_compiled_distance_is_that_of_the_paper(first, second):
    lines = resample_all([np.array(first), np.array(second)], 12)
    kinds = np.array([2])
    found = frechet_matrix(lines[:1], kinds, lines[1:], kinds, FAR)[0, 0]
    assert found == pytest.approx(min(plain(lines[0], lines[1]), plain(lines[0], lines[1][::-1])), abs=1e-9)
