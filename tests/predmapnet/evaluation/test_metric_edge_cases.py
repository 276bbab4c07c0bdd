"""Ties, repeats, absent kinds and odd polylines: worked out by hand, for each metric."""

from dataclasses import replace

import numpy as np
import pytest

from mapfusion.elements import ElementKind, FrameMap, GlobalMap, MapElement, RegionOfInterest
from predmapnet.errors import UserError
from predmapnet.evaluation.chamfer_ap import chamfer_average_precision
from predmapnet.evaluation.consistency_ap import consistency_average_precision, with_formed_tracks
from predmapnet.evaluation.frames import EvaluationFrame
from predmapnet.evaluation.measurement import measure_scene, pool_scenes
from predmapnet.evaluation.raster_ap import raster_average_precision, raster_matches
from predmapnet.scenes import FrameTruth

HERE, THERE = [[-20.0, 3.0], [20.0, 5.0]], [[-20.0, -9.0], [20.0, -8.0]]
RING = [[2.0, -4.0], [6.0, -4.0], [6.0, 4.0], [2.0, 4.0], [2.0, -4.0]]
DIVIDER = int(ElementKind.DIVIDER)
POINT, NO_LENGTH, TWO_POINT_RING = [[3.0, 3.0]], [[3.0, 3.0], [3.0, 3.0]], [[1.0, 1.0], [2.0, 1.0]]


def formed_average_precision(frames):
    return consistency_average_precision(with_formed_tracks(frames))


METRICS = (
    chamfer_average_precision,
    consistency_average_precision,
    formed_average_precision,
    raster_average_precision,
)
each_metric = pytest.mark.parametrize("metric", METRICS)


def frame(predictions, truths, index=0, forecasts=None):
    """A frame of (kind, line, score, track id) beside (kind, line); it stands still."""
    predicted = FrameMap(
        timestamp=index,
        ego_to_global=np.eye(4),
        roi=RegionOfInterest(),
        kinds=np.array([kind for kind, *_ in predictions], dtype=np.int64),
        scores=np.array([score for _, _, score, _ in predictions], dtype=np.float64),
        track_ids=np.array([track for *_, track in predictions], dtype=np.int64),
        polylines=tuple(np.array(line, dtype=np.float64) for _, line, _, _ in predictions),
        forecasts=forecasts,
    )
    lines = tuple(np.array(line, dtype=np.float64) for _, line in truths)
    kinds = np.array([kind for kind, _ in truths], dtype=np.int64)
    return EvaluationFrame("scene-0001", index, predicted, FrameTruth(kinds, lines, np.arange(len(lines))))


def divider_precision(metric, frames):
    return metric(frames).kinds[DIVIDER].average_precision


@each_metric
def test_of_equal_scores_in_a_frame_the_first_row_counts_first(metric):
    truths = [(DIVIDER, HERE)]
    right, wrong = (DIVIDER, HERE, 0.75, 1), (DIVIDER, THERE, 0.75, 2)
    assert divider_precision(metric, [frame([right, wrong], truths)]) == pytest.approx(1.0)
    assert divider_precision(metric, [frame([wrong, right], truths)]) == pytest.approx(0.5)


@each_metric
def test_of_equal_scores_in_two_frames_the_earlier_frame_counts_first(metric):
    good = frame([(DIVIDER, HERE, 0.75, 1)], [(DIVIDER, HERE)])
    bad = frame([(DIVIDER, THERE, 0.75, 2)], [(DIVIDER, HERE)])
    second = replace(good, index=1), replace(bad, index=1)
    assert divider_precision(metric, [good, second[1]]) == pytest.approx(0.5, abs=0.01)
    assert divider_precision(metric, [bad, second[0]]) == pytest.approx(0.25, abs=0.01)


@each_metric
def test_a_repeat_is_a_false_positive(metric):
    truths = [(DIVIDER, HERE), (DIVIDER, THERE)]
    repeated = [(DIVIDER, HERE, 0.9, 1), (DIVIDER, HERE, 0.8, 2), (DIVIDER, THERE, 0.7, 3)]
    # Half of the recall at precision 1, the other half at 2 / 3.
    assert divider_precision(metric, [frame(repeated, truths)]) == pytest.approx(5 / 6, abs=0.005)


@each_metric
def test_of_two_identical_truths_one_stays_unfound(metric):
    predictions = [(DIVIDER, HERE, 0.9, 1), (DIVIDER, HERE, 0.8, 2)]
    found = divider_precision(metric, [frame(predictions, [(DIVIDER, HERE)] * 2)])
    # Chamfer matching looks at the nearest truth only, overlap at all that are free.
    assert found == pytest.approx(1.0 if metric is raster_average_precision else 0.5, abs=0.005)


def test_of_equal_truths_the_last_free_one_is_taken_by_overlap():
    """As COCO does: three predictions of one line take the equal truths from the last to the first."""
    found = raster_matches(frame([(DIVIDER, HERE, score, 1) for score in (0.9, 0.8, 0.7)], [(DIVIDER, HERE)] * 2))
    assert found[DIVIDER].matches.tolist() == [[1, 0, -1]] * 6


@each_metric
def test_a_kind_that_never_occurs(metric):
    crossing = (int(ElementKind.PED_CROSSING), RING, 0.95, 7)
    result = metric([frame([(DIVIDER, HERE, 0.9, 1), crossing], [(DIVIDER, HERE)])])
    absent = result.kinds[ElementKind.PED_CROSSING].average_precision
    if metric is raster_average_precision:
        assert (absent, result.mean) == (None, pytest.approx(1.0))
    else:
        assert (absent, result.mean) == (0.0, pytest.approx(1 / 3))


@each_metric
def test_frames_without_truth_cost_precision_except_where_the_official_code_skips_them(metric):
    empty = frame([(DIVIDER, THERE, 0.95, 2)], [], index=1)
    found = divider_precision(metric, [frame([(DIVIDER, HERE, 0.9, 1)], [(DIVIDER, HERE)]), empty])
    consistent = metric in (consistency_average_precision, formed_average_precision)
    assert found == pytest.approx(1.0 if consistent else 0.5)


@each_metric
@pytest.mark.parametrize("kind", list(ElementKind))
@pytest.mark.parametrize("odd", [POINT, NO_LENGTH, TWO_POINT_RING])
def test_an_odd_polyline_predicted_exactly_is_found(metric, kind, odd):
    frames = [frame([(int(kind), odd, 0.9, 1)], [(int(kind), odd)], index) for index in range(2)]
    # Of a line of one point MapVR draws nothing, so nothing overlaps.
    invisible = metric is raster_average_precision and odd is POINT and not kind.is_ring
    assert metric(frames).kinds[kind].average_precision == pytest.approx(0.0 if invisible else 1.0)


def test_everything_odd_at_once_gives_figures():
    """Tracks, forecasts and the map of the whole drive take what the per-frame metrics take."""
    lines = [POINT, NO_LENGTH, TWO_POINT_RING, HERE, HERE]
    elements = [(int(kind), line) for kind in ElementKind for line in lines]
    predictions = [(kind, line, 0.5, track) for track, (kind, line) in enumerate(elements)]
    forecasts = tuple(np.array(line) for _, line in elements)
    frames = [frame(predictions, elements, index, forecasts) for index in range(4)]
    frames += [frame([], elements, 4), frame(predictions, [], 5, forecasts), frame([], [], 6)]
    drawn = GlobalMap(
        tuple(MapElement(ElementKind(kind), np.array(line), 0.9, 3, 0, 1) for kind, line in elements if len(line) > 1)
    )
    figures = pool_scenes([measure_scene(frames, drawn, drawn)]).figures()
    assert figures["forecast"]["t+1"]["forecast_mean_m"] == pytest.approx(0.0, abs=1e-9)
    assert figures["tracks"]["id_switches"] == 0
    for metric in ("chamfer_ap", "raster_ap", "consistency_ap", "consistency_ap_formed_ids"):
        assert 0.0 < figures[metric]["mAP"] <= 1.0
    assert 0.0 < figures["global_map"]["f1@1.0"] <= 1.0


def test_nan_in_a_forecast_names_frame_and_element():
    forecasts = (np.array(HERE), np.array([[0.0, np.nan], [1.0, 1.0]]))
    predictions = [(DIVIDER, HERE, 0.9, 1), (DIVIDER, THERE, 0.9, 2)]
    with pytest.raises(UserError, match=r"scene-0001, frame 3, forecast 1: .*NaN"):
        frame(predictions, [], 3, forecasts)


def test_a_scene_without_any_prediction_or_truth_has_figures():
    for truths in ([], [(DIVIDER, HERE)]):
        figures = pool_scenes([measure_scene([frame([], truths)], GlobalMap(()), GlobalMap(()))]).figures()
        assert figures["chamfer_ap"]["mAP"] == 0.0
        assert figures["raster_ap"]["mAP"] == (0.0 if truths else None)
        assert figures["global_map"]["f1@1.0"] is None
        assert figures["tracks"]["tracked_share"] == (0.0 if truths else None)
