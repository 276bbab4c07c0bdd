"""Chamfer AP beside the official figures, and what holds for any input."""

import numpy as np
import pytest

from mapfusion.elements import RegionOfInterest
from predmapnet.evaluation.chamfer_ap import chamfer_average_precision, frame_matches, thresholds_for
from predmapnet.evaluation.chamfer_distance import chamfer_matrix, match_greedily, resample_all
from predmapnet.evaluation.frames import simplify_all
from predmapnet.evaluation.precision_recall import accumulate


def test_simplified_truth_is_the_official_one(case):
    expected = np.split(case.intermediates["gt_eval_points"], case.intermediates["gt_eval_offsets"][1:-1])
    for frame, rows in zip(case.frames, case.truth_rows, strict=True):
        for line, row in zip(simplify_all(frame.truth.polylines), rows, strict=True):
            np.testing.assert_allclose(line, expected[row], atol=1e-9)


def test_every_subset_has_the_official_average_precision(case):
    matches = [frame_matches(frame) for frame in case.frames]
    for subset, expected in case.expected["chamfer_ap"]["stable"].items():
        rows = case.subset(subset)
        result = accumulate([matches[row] for row in rows], (0.5, 1.0, 1.5))
        assert result.mean == pytest.approx(expected["mAP"], abs=1e-6), subset
        for kind in result.kinds:
            figures = expected[kind.kind.label]
            assert kind.average_precision == pytest.approx(figures["AP"], abs=1e-6), (subset, kind.kind)
            for curve in kind.curves:
                assert curve.average_precision == pytest.approx(figures[f"AP@{curve.threshold}"], abs=1e-6)
            assert (kind.truths, kind.predictions) == (figures["num_gts"], figures["num_preds"])


def test_every_true_positive_is_the_official_one(case):
    result = chamfer_average_precision(case.frames)
    for flags, rows in zip(result.flags, case.predicted_rows, strict=True):
        np.testing.assert_array_equal(flags, case.intermediates["chamfer_tp_stable"][rows])


def test_distances_are_the_official_ones(case):
    given = case.intermediates
    predictions = np.split(case.inputs["pred_points"], case.inputs["pred_offsets"][1:-1])
    truths = np.split(given["gt_eval_points"], given["gt_eval_offsets"][1:-1])
    values = pred_start = gt_start = 0
    for n, m in given["chamfer_mat_shape"]:
        pred_rows = given["chamfer_mat_pred_rows"][pred_start : pred_start + n]
        gt_rows = given["chamfer_mat_gt_rows"][gt_start : gt_start + m]
        expected = given["chamfer_mat_values"][values : values + n * m].reshape(n, m)
        values, pred_start, gt_start = values + n * m, pred_start + n, gt_start + m
        predicted = resample_all([predictions[row] for row in pred_rows], 200)
        true = resample_all([truths[row] for row in gt_rows], 200)
        kinds = np.zeros(max(n, m), dtype=np.int64)
        np.testing.assert_allclose(chamfer_matrix(predicted, kinds[:n], true, kinds[:m]), expected, atol=1e-6)
        near = expected <= 1.5
        limited = chamfer_matrix(predicted, kinds[:n], true, kinds[:m], limit=1.5)
        np.testing.assert_allclose(limited[near], expected[near], atol=1e-6)


def test_a_distance_of_exactly_the_threshold_is_a_match():
    distances = np.array([[0.5], [np.nextafter(1.0, 2.0)]])
    assert match_greedily(distances, np.array([0.9, 0.8]), (0.5, 1.0)).tolist() == [[0, 0], [-1, -1]]
    assert match_greedily(distances[1:], np.array([0.8]), (1.0, 1.5)).tolist() == [[-1, 0]]


def test_the_region_decides_the_thresholds():
    assert thresholds_for(RegionOfInterest(60.0, 30.0)) == (0.5, 1.0, 1.5)
    assert thresholds_for(RegionOfInterest(100.0, 50.0)) == (1.0, 1.5, 2.0)
