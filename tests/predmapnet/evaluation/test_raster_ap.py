"""Rasterisation AP and segmentation IoU beside the official figures."""

from dataclasses import replace

import numpy as np
import pytest

from mapfusion.elements import ElementKind
from predmapnet.evaluation.frames import simplify_all
from predmapnet.evaluation.raster_ap import raster_from_matches, raster_matches
from tests.predmapnet.evaluation.segmentation_iou import segmentation_iou

OFFICIAL_ORDER = {
    "official_line": (ElementKind.DIVIDER, ElementKind.BOUNDARY),
    "official_polygon": (ElementKind.PED_CROSSING,),
}


@pytest.fixture(scope="module", params=["mapvr_frame__gt_raw", "ego_frame__gt_raw", "ego_frame__gt_eval"])
def variant(request, case):
    frames = case.frames
    if request.param.endswith("gt_eval"):
        frames = [
            replace(frame, truth=replace(frame.truth, polylines=simplify_all(frame.truth.polylines)))
            for frame in frames
        ]
    axes = request.param.split("_")[0]
    return request.param, [raster_matches(frame, axes) for frame in frames]


def official_figure(name, result):
    """What MapVR prints under ``name``, from our result."""
    if name.startswith("Frame mIoU"):
        value = result.kinds[ElementKind[name.split(",")[1].upper()]].frame_miou
        return -1.0 if value is None else value
    what, thresholds, kind, limit = name.split(",")
    values = []
    for entry in result.kinds:
        asked = entry.kind.label == kind or (kind == "all" and not entry.kind.is_ring)
        if not asked or entry.average_precisions is None:
            continue
        numbers = entry.average_precisions if what == "AP" else entry.recalls[int(limit)]
        if ":" not in thresholds:
            numbers = numbers[np.isclose(entry.thresholds, float(thresholds))]
        values.append(numbers)
    return np.mean(values) if values else -1.0


def test_every_subset_has_the_official_figures(case, variant):
    name, matches = variant
    for subset, expected in case.expected["raster_ap"][name].items():
        result = raster_from_matches([matches[row] for row in case.subset(subset)])
        if result.mean is not None:
            assert result.mean == pytest.approx(expected["mAP_present_classes"], abs=1e-6), subset
        for entry in result.kinds:
            figures = expected["per_class"][entry.kind.label]
            if entry.average_precision is None:
                assert set(figures.values()) == {-1.0}
                continue
            assert entry.average_precision == pytest.approx(figures["AP"], abs=1e-6)
            for threshold, value in zip(entry.thresholds, entry.average_precisions, strict=True):
                assert value == pytest.approx(figures[f"AP@{threshold:.2f}"], abs=1e-6), (subset, entry.kind)
        for group in OFFICIAL_ORDER:
            for printed, value in expected[group].items():
                assert official_figure(printed, result) == pytest.approx(value, abs=1e-6), (subset, printed)


def test_every_overlap_and_match_is_the_official_one(case, variant):
    name, matches = variant
    prefix = f"raster_{name.split('__')[0]}"
    if name.endswith("gt_eval") or f"{prefix}_frame" not in case.intermediates:
        pytest.skip("no intermediates for this variant")
    given = {
        key: case.intermediates[f"{prefix}_{key}"]
        for key in ("frame", "label", "iou_shape", "iou_values", "pred_rows", "dt_matches")
    }
    values = rows = cells = 0
    for frame, label, (n, m) in zip(given["frame"], given["label"], given["iou_shape"], strict=True):
        ours = matches[frame][label]
        iou = given["iou_values"][values : values + n * m].reshape(n, m)
        expected_rows = given["pred_rows"][rows : rows + n]
        dt_matches = given["dt_matches"][cells : cells + 6 * n].reshape(6, n)
        values, rows, cells = values + n * m, rows + n, cells + 6 * n
        np.testing.assert_array_equal(case.predicted_rows[frame][ours.rows], expected_rows)
        np.testing.assert_allclose(ours.iou, iou, atol=1e-12)
        np.testing.assert_array_equal(ours.matches, dt_matches)


def test_segmentation_iou_is_the_official_one(case):
    path = case.folder / "seg.npz"
    if not path.exists():
        pytest.skip(f"no segmentation masks: {path}")
    given = np.load(path, allow_pickle=False)
    truths = np.unpackbits(given["gt_mask_packed"], axis=-1).astype(bool)[:, :, ::-1]
    predicted = given["pred_class_map"][:, None] == np.arange(1, 4)[:, None, None]
    ours = segmentation_iou(zip(predicted, truths, strict=True))
    assert ours == pytest.approx(case.expected["bev_miou"], abs=1e-6)
