"""Tracks and consistency-aware AP beside the official figures, and what anchoring means."""

import numpy as np
import pytest

from predmapnet.evaluation.chamfer_distance import chamfer_matrix, resample_all
from predmapnet.evaluation.consistency_ap import consistency_matches, matched_tracks
from predmapnet.evaluation.precision_recall import accumulate
from predmapnet.evaluation.tracks import form_tracks, truth_track_ids

THRESHOLDS = (0.5, 1.0, 1.5)


def by_scene(case, frames):
    names = dict.fromkeys(frame.scene for frame in frames)
    return [[frame for frame in frames if frame.scene == name] for name in names]


@pytest.fixture(scope="module")
def truth_ids(case):
    return [ids for scene in by_scene(case, case.frames) for ids in truth_track_ids(scene)]


@pytest.fixture(scope="module")
def formed(case):
    return [tracks for scene in by_scene(case, case.frames) for tracks in form_tracks(scene)]


def frames_of_kind(case, formed, kind):
    if kind == "own_ids":
        return case.frames
    return [tracks.apply(frame) for tracks, frame in zip(formed, case.frames, strict=True)]


def test_resampled_truth_is_the_official_one(case):
    points = np.split(case.inputs["gt_raw_points"], case.inputs["gt_raw_offsets"][1:-1])
    size = np.array([60.0, 30.0])
    ours = (resample_all(points, 20) + size / 2) / (size + 1e-5)
    np.testing.assert_allclose(ours, case.intermediates["gt_match20_normalised"], atol=1e-9)


def test_truth_tracks_are_the_official_ones(case, truth_ids):
    for ids, rows in zip(truth_ids, case.truth_rows, strict=True):
        np.testing.assert_array_equal(ids, case.intermediates["gt_track_id"][rows])


def test_formed_tracks_are_the_official_ones_in_the_official_order(case, formed):
    given = case.intermediates
    frames = [np.full(len(tracks.rows), index) for index, tracks in enumerate(formed)]
    rows = [case.predicted_rows[index][tracks.rows] for index, tracks in enumerate(formed)]
    np.testing.assert_array_equal(np.concatenate(frames), given["prepared_frame"])
    np.testing.assert_array_equal(np.concatenate(rows), given["prepared_pred_row"])
    np.testing.assert_array_equal(np.concatenate([tracks.kind_ids for tracks in formed]), given["prepared_label_id"])
    if given["prepared_label_id"].max(initial=0) < 100:  # beyond that, official scene ids collide
        ids = np.concatenate([tracks.track_ids for tracks in formed])
        np.testing.assert_array_equal(ids, given["prepared_scene_id"])


@pytest.mark.parametrize("kind", ["prepared_tracks", "own_ids"])
@pytest.mark.parametrize("mode", ["stable", "stable_no_consistency"])
def test_every_subset_has_the_official_average_precision(case, truth_ids, formed, kind, mode):
    frames = frames_of_kind(case, formed, kind)
    matches, start = [], 0
    for scene in by_scene(case, frames):
        matched = matched_tracks(scene, truth_ids[start : start + len(scene)], THRESHOLDS)
        matches += consistency_matches(scene, matched, anchored=mode == "stable")
        start += len(scene)
    for subset, expected in case.expected["cmap"][kind][mode].items():
        rows = case.subset(subset)
        result = accumulate([matches[row] for row in rows], THRESHOLDS)
        assert result.mean == pytest.approx(expected["mAP"], abs=1e-6), subset
        for entry in result.kinds:
            figures = expected[entry.kind.label]
            for curve in entry.curves:
                assert curve.average_precision == pytest.approx(figures[f"AP@{curve.threshold}"], abs=1e-6), subset
            assert entry.average_precision == pytest.approx(figures["AP"], abs=1e-6)
            assert (entry.truths, entry.predictions) == (figures["num_gts"], figures["num_counted_preds"])
    if mode == "stable":
        given = case.intermediates[f"cmap_tp_{kind}_stable"]
        if kind == "own_ids":
            ours = {
                row: flag
                for rows, match in zip(case.predicted_rows, matches, strict=True)
                for row, flag in zip(rows, match.flags, strict=True)
            }
            found = np.array([ours[row] for row in case.intermediates["own_pred_row"]])
        else:
            found = np.concatenate([match.flags for match in matches])
        np.testing.assert_array_equal(found, given)


def test_distances_are_the_official_ones(case):
    given = case.intermediates
    predictions = np.split(case.inputs["pred_points"], case.inputs["pred_offsets"][1:-1])
    truths = np.split(given["gt_eval_points"], given["gt_eval_offsets"][1:-1])
    values = pred_start = gt_start = 0
    for n, m in given["cmap_mat_shape"]:
        pred_rows = given["cmap_mat_pred_rows"][pred_start : pred_start + n]
        gt_rows = given["cmap_mat_gt_rows"][gt_start : gt_start + m]
        expected = given["cmap_mat_values"][values : values + n * m].reshape(n, m)
        values, pred_start, gt_start = values + n * m, pred_start + n, gt_start + m
        predicted = resample_all([predictions[row] for row in pred_rows], 200)
        true = resample_all(list(resample_all([truths[row] for row in gt_rows], 20)), 200)
        kinds = np.zeros(max(n, m), dtype=np.int64)
        np.testing.assert_allclose(chamfer_matrix(predicted, kinds[:n], true, kinds[:m]), expected, atol=1e-6)
