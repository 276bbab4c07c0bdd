"""Global mAP after GlobalMapNet: cases whose value is counted by hand."""

import numpy as np
import pytest
import shapely

from mapfusion.elements import ElementKind, GlobalMap, MapElement
from predmapnet.evaluation.global_map_ap import global_map_matches
from predmapnet.evaluation.precision_recall import accumulate

THRESHOLDS = (0.5, 1.0, 1.5)
ORIGIN = np.array([1_000.0, 2_000.0])
SEEN = shapely.box(1_000.0, 2_000.0, 1_100.0, 2_030.0)


def element(points, confidence=0.9, kind=ElementKind.DIVIDER):
    return MapElement(kind, np.array(points, float) + ORIGIN, confidence, 3, 0, 1)


def measured(*maps):
    return accumulate(
        [global_map_matches(GlobalMap(tuple(found)), GlobalMap(tuple(true)), SEEN, THRESHOLDS) for found, true in maps],
        THRESHOLDS,
    )


def test_the_truth_is_cut_by_what_the_car_passed():
    """A true line of 300 m of which 100 m were passed is found by a line of those 100 m."""
    result = measured(([element([[0, 5], [100, 5]])], [element([[-100, 5], [200, 5]])]))
    assert result.kinds[ElementKind.DIVIDER].average_precision == pytest.approx(1.0)
    assert result.mean == pytest.approx(1 / 3), "kinds without truth count as 0, as officially"


def test_a_line_in_two_pieces_is_not_the_line():
    """Two halves of 50 m: the chamfer distance of each to the whole is (0 + 12.5) / 2 metres, beyond 1.5 m."""
    halves = [element([[0, 5], [50, 5]]), element([[50, 5], [100, 5]])]
    result = measured((halves, [element([[0, 5], [100, 5]])]))
    assert result.kinds[ElementKind.DIVIDER].average_precision == 0.0


def test_maps_are_matched_one_by_one_and_ranked_together():
    """Two scenes, one found at 0.9 confidence and one missed by a line at 0.95: precision 1/2 at recall 1/2."""
    right = ([element([[0, 5], [100, 5]], 0.9)], [element([[0, 5], [100, 5]])])
    wrong = ([element([[0, 25], [100, 25]], 0.95)], [element([[0, 15], [100, 15]])])
    result = measured(right, wrong)
    assert result.kinds[ElementKind.DIVIDER].average_precision == pytest.approx(0.25)
    assert result.kinds[ElementKind.DIVIDER].truths == 2


def test_two_thirds_of_the_thresholds_reached_are_two_thirds_of_the_precision():
    result = measured(([element([[0, 5.8], [100, 5.8]])], [element([[0, 5], [100, 5]])]))
    assert result.kinds[ElementKind.DIVIDER].average_precision == pytest.approx(2 / 3)


def test_a_car_that_passed_nothing_leaves_nothing_to_find():
    found = global_map_matches(GlobalMap((element([[0, 0], [5, 0]]),)), GlobalMap(()), shapely.Polygon(), THRESHOLDS)
    assert found.truths.tolist() == [0, 0, 0] and not found.flags.any()
