"""Global-map quality on maps whose figures can be worked out by hand."""

import math

import numpy as np
import pytest

from mapfusion.elements import ElementKind, GlobalMap, MapElement, RegionOfInterest
from predmapnet.errors import UserError
from predmapnet.evaluation.global_map import global_map_quality, pool, seen_area

LINE = np.array([[0.0, 0.0], [100.0, 0.0]])
RING = np.array([[10.0, 0.0], [14.0, 0.0], [14.0, 8.0], [10.0, 8.0], [10.0, 0.0]])


def element(points, kind=ElementKind.DIVIDER, confidence=0.9):
    return MapElement(kind, np.asarray(points, dtype=float), confidence, 5, 0, 1)


def shifted(x, y):
    return LINE + np.array([x, y])


def make(*elements):
    return GlobalMap(tuple(elements))


def test_the_true_map_is_perfect():
    truth = make(element(LINE), element(RING, ElementKind.PED_CROSSING), element(shifted(0, 9), ElementKind.BOUNDARY))
    quality = global_map_quality(truth, truth)
    assert quality.elements.mean == pytest.approx(1.0)
    for part in (*quality.kinds, quality.overall):
        assert part.f1 == pytest.approx([1.0, 1.0, 1.0])
        assert part.duplicates == 0 and part.fragments == part.followed
        assert part.lateral_errors.max() == pytest.approx(0.0, abs=1e-9)


def test_half_the_line_shifted_sideways_is_half_found_at_the_right_thresholds():
    predicted = make(element([[0.0, 0.7], [50.0, 0.7]]))
    figures = global_map_quality(predicted, make(element(LINE))).figures()
    assert (figures["precision@0.5"], figures["precision@1.0"]) == (0.0, 1.0)
    # The end of the prediction also finds what lies ahead of it within sqrt(1 - 0.7^2) m.
    assert figures["recall@1.0"] == pytest.approx((50 + math.sqrt(1 - 0.49)) / 100, abs=0.0026)
    assert figures["lateral_median_m"] == pytest.approx(0.7)
    assert figures["lateral_p95_m"] == pytest.approx(0.7)


def test_fragments_and_duplicates_are_told_apart():
    pieces = [element([[x, 0.1], [x + 25.0, 0.1]], confidence=0.8) for x in (0.0, 25.0, 50.0, 75.0)]
    repeat = element([[30.0, -0.2], [60.0, -0.2]], confidence=0.3)
    quality = global_map_quality(make(*pieces, repeat), make(element(LINE))).kinds[ElementKind.DIVIDER]
    assert (quality.fragments, quality.followed, quality.duplicates) == (5, 1, 1)


def test_two_true_lines_side_by_side_are_no_duplicates():
    double = make(element(LINE), element(shifted(0.0, 0.4)))
    assert global_map_quality(double, double).overall.duplicates == 0


def test_another_kind_at_the_same_place_is_wrong():
    quality = global_map_quality(make(element(LINE, ElementKind.BOUNDARY)), make(element(LINE)))
    assert quality.overall.f1 == pytest.approx([0, 0, 0])
    assert quality.elements.mean == 0.0


def test_truth_that_was_never_in_view_is_not_asked_for():
    pose = np.eye(4)
    seen = seen_area([pose], RegionOfInterest(60.0, 30.0))
    assert seen.area == pytest.approx(1800.0)
    predicted = make(element([[0.0, 0.0], [30.0, 0.0]]))
    quality = global_map_quality(predicted, make(element(LINE), element(shifted(0.0, 40.0))), seen)
    assert quality.overall.recall == pytest.approx([1, 1, 1])
    assert quality.overall.true == pytest.approx(30.0)
    assert quality.elements.kinds[ElementKind.DIVIDER].average_precision == pytest.approx(1.0)


def test_empty_maps_have_figures_where_they_exist():
    empty = GlobalMap(())
    figures = global_map_quality(empty, make(element(LINE))).figures()
    assert (figures["precision@1.0"], figures["recall@1.0"], figures["f1@1.0"]) == (None, 0.0, 0.0)
    assert global_map_quality(empty, empty).figures()["f1@1.0"] is None
    assert global_map_quality(make(element(LINE)), empty).figures()["precision@1.0"] == 0.0


def test_degenerate_elements_cost_nothing_but_count_as_elements():
    odd = make(element([[0.0, 0.0]]), element([[5.0, 0.0], [5.0, 0.0]]), element(LINE))
    quality = global_map_quality(odd, make(element(LINE)))
    assert quality.overall.f1 == pytest.approx([1, 1, 1])
    assert quality.overall.predicted_elements == 3


def test_pooling_adds_metres():
    right = global_map_quality(make(element(LINE)), make(element(LINE)))
    wrong = global_map_quality(make(element(shifted(0, 50))), make(element(LINE)))
    both = pool([right, wrong])
    assert both.overall.precision == pytest.approx([0.5, 0.5, 0.5])
    assert both.elements.kinds[ElementKind.DIVIDER].truths == 2


def test_nan_names_the_element():
    with pytest.raises(UserError, match=r"predicted map's element 1 \(boundary\)"):
        global_map_quality(make(element(LINE), element(LINE * np.nan, ElementKind.BOUNDARY)), make())
