"""Chamfer AP of the two halves of the region: cases whose value is counted by hand."""

import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st

from mapfusion.elements import FrameMap, RegionOfInterest
from predmapnet.evaluation.ahead_rear_ap import Half, cut_at_middle, half_matches
from predmapnet.evaluation.frames import EvaluationFrame
from predmapnet.evaluation.precision_recall import accumulate
from predmapnet.scenes import FrameTruth

THRESHOLDS = (0.5, 1.0, 1.5)
ALONG = np.array([[-30.0, 0.0], [30.0, 0.0]])
RING = np.array([[-2.0, 0.0], [2.0, 0.0], [2.0, 6.0], [-2.0, 6.0], [-2.0, 0.0]])


def frame(predicted, truth, kind=1):
    count = len(predicted)
    return EvaluationFrame(
        "scene-0001",
        0,
        FrameMap(
            0,
            np.eye(4),
            RegionOfInterest(),
            np.full(count, kind),
            np.linspace(0.9, 0.8, count),
            np.full(count, -1),
            tuple(predicted),
        ),
        FrameTruth(np.full(len(truth), kind), tuple(truth), np.arange(len(truth))),
    )


def divider_ap(half, predicted, truth):
    result = accumulate([half_matches(frame(predicted, truth), half, THRESHOLDS)], THRESHOLDS)
    return result.kinds[1].average_precision


def test_a_prediction_that_is_right_ahead_only_counts_ahead():
    """The prediction bends away behind the car, to 5 m aside: all of the half ahead, nothing of the rear."""
    bent = np.array([[-30.0, 5.0], [-0.1, 5.0], [0.0, 0.0], [30.0, 0.0]])
    assert divider_ap(Half.AHEAD, [bent], [ALONG]) == pytest.approx(1.0)
    assert divider_ap(Half.REAR, [bent], [ALONG]) == 0.0


def test_the_distance_of_a_half_is_measured_within_the_half():
    """0.7 m aside ahead, none behind: beyond 0.5 m, within 1.0 and 1.5 m, so two thirds; the whole line is 0.35 m."""
    step = np.array([[-30.0, 0.0], [0.0, 0.0], [0.0001, 0.7], [30.0, 0.7]])
    assert divider_ap(Half.AHEAD, [step], [ALONG]) == pytest.approx(2 / 3)
    assert divider_ap(Half.REAR, [step], [ALONG]) == pytest.approx(1.0)


def test_a_false_line_behind_the_car_costs_nothing_ahead():
    wrong = np.array([[-20.0, 10.0], [-5.0, 10.0]])
    assert divider_ap(Half.AHEAD, [wrong, ALONG], [ALONG]) == pytest.approx(1.0)
    assert divider_ap(Half.REAR, [wrong, ALONG], [ALONG]) == pytest.approx(0.5), "the false one has the higher score"


def test_a_line_that_crosses_the_middle_three_times_is_two_pieces_ahead():
    zigzag = np.array([[-5.0, 0.0], [5.0, 0.0], [5.0, 2.0], [-5.0, 2.0], [-5.0, 4.0], [5.0, 4.0]])
    owners, pieces = cut_at_middle(np.array([1]), [zigzag], Half.AHEAD)
    assert owners.tolist() == [0, 0]
    np.testing.assert_allclose(pieces[0], [[0, 0], [5, 0], [5, 2], [0, 2]])
    np.testing.assert_allclose(pieces[1], [[0, 4], [5, 4]])


def test_a_crossing_is_cut_to_the_outline_of_what_is_left():
    _, (piece,) = cut_at_middle(np.array([0]), [RING], Half.REAR)
    assert shapely.Polygon(piece).equals(shapely.box(-2, 0, 0, 6)) and (piece[0] == piece[-1]).all()


def test_what_touches_the_middle_only_is_in_neither_half():
    across = np.array([[0.0, -3.0], [0.0, 3.0]])
    touching = np.array([[5.0, 0.0], [0.0, 1.0], [5.0, 2.0]])
    for half in Half:
        assert cut_at_middle(np.array([1]), [across], half)[1] == []
    assert len(cut_at_middle(np.array([1]), [touching], Half.AHEAD)[1]) == 1
    assert cut_at_middle(np.array([1]), [touching], Half.REAR)[1] == []


coordinates = st.floats(-30, 30).map(lambda value: round(value, 2))


@settings(deadline=None)
@given(st.lists(st.tuples(coordinates, coordinates), min_size=2, max_size=8, unique=True))
def test_the_halves_of_a_line_are_together_as_long_as_the_line(points):
    line = np.array(points)
    length = shapely.length(shapely.LineString(line))
    on_the_border = sum(
        shapely.length(shapely.LineString(line[row : row + 2]))
        for row in range(len(line) - 1)
        if line[row, 0] == line[row + 1, 0] == 0.0
    )
    halves = sum(
        shapely.length(shapely.LineString(piece))
        for half in Half
        for piece in cut_at_middle(np.array([1]), [line], half)[1]
    )
    assert length - on_the_border - 1e-6 <= halves <= length + on_the_border + 1e-6
