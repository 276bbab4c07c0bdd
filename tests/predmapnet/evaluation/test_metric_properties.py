"""Properties of the metrics for any prediction, and inputs that break careless code."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mapfusion.elements import ElementKind, FrameMap, RegionOfInterest
from predmapnet.errors import UserError
from predmapnet.evaluation.chamfer_ap import chamfer_average_precision, thresholds_for
from predmapnet.evaluation.chamfer_distance import chamfer_matrix, resample_all
from predmapnet.evaluation.consistency_ap import consistency_average_precision, with_formed_tracks
from predmapnet.evaluation.frames import EvaluationFrame, simplify_all
from predmapnet.evaluation.raster_ap import raster_average_precision
from predmapnet.scenes import FrameTruth

METRICS = (chamfer_average_precision, consistency_average_precision, raster_average_precision)


def make_frame(kinds, lines, scores, truth_kinds, truths, index=0, ids=None, scene="scene-0001"):
    predicted = FrameMap(
        index,
        np.eye(4),
        RegionOfInterest(),
        np.array(kinds, dtype=np.int64),
        np.array(scores, dtype=np.float64),
        np.array(range(len(kinds)) if ids is None else ids, dtype=np.int64),
        tuple(np.array(line, dtype=np.float64) for line in lines),
    )
    true_lines = tuple(np.array(line, dtype=np.float64) for line in truths)
    truth = FrameTruth(np.array(truth_kinds, dtype=np.int64), true_lines, np.arange(len(true_lines)))
    return EvaluationFrame(scene, index, predicted, truth)


@st.composite
def polylines(draw):
    kind = draw(st.integers(0, 2))
    seed = draw(st.integers(0, 2**31))
    generator = np.random.default_rng(seed)
    start = generator.uniform([-25, -12], [25, 12])
    if kind == 0:
        size = generator.uniform(1, 5, 2)
        return kind, start + size * np.array([[0, 0], [1, 0], [1, 1], [0, 1], [0, 0]])
    return kind, start + np.cumsum(generator.normal(1.0, 1.0, (draw(st.integers(1, 8)), 2)), axis=0)


@st.composite
def drives(draw):
    """A few frames in which predictions are noisy truths, strangers and repeats, scores all different."""
    count = draw(st.integers(1, 4))
    scores = iter(np.random.default_rng(draw(st.integers(0, 1000))).permutation(200) / 200.0)
    frames = []
    for index in range(count):
        truths = draw(st.lists(polylines(), max_size=4))
        strangers = draw(st.lists(polylines(), max_size=3))
        noise = draw(st.floats(0.0, 1.0))
        predicted = [(kind, line + noise) for kind, line in truths] + strangers
        frames.append(
            make_frame(
                [kind for kind, _ in predicted],
                [line for _, line in predicted],
                [next(scores) for _ in predicted],
                [kind for kind, _ in truths],
                [line for _, line in truths],
                index,
            )
        )
    return frames


@settings(max_examples=60, deadline=None)
@given(drives(), st.integers(0, 100))
def test_chamfer_ap_is_a_share_whatever_the_order_of_frames_and_the_scale_of_scores(frames, seed):
    result = chamfer_average_precision(frames)
    values = [curve.average_precision for kind in result.kinds for curve in kind.curves]
    assert all(0.0 <= value <= 1.0 + 1e-12 for value in values)
    order = np.random.default_rng(seed).permutation(len(frames))
    assert chamfer_average_precision([frames[row] for row in order]).mean == pytest.approx(result.mean)
    halved = [replace(frame, predicted=replace(frame.predicted, scores=frame.predicted.scores / 2)) for frame in frames]
    assert chamfer_average_precision(halved).mean == pytest.approx(result.mean)
    for kind in result.kinds:
        curve = [entry.average_precision for entry in kind.curves]
        assert kind.truths == 0 or all(np.isfinite(curve))


@settings(max_examples=30, deadline=None)
@given(drives())
def test_every_metric_stays_within_bounds_and_consistency_never_helps(frames):
    raster = raster_average_precision(frames).mean
    assert raster is None or 0.0 <= raster <= 1.0 + 1e-12
    formed = with_formed_tracks(frames)
    consistent = consistency_average_precision(formed)
    free = consistency_average_precision(formed, anchored=False)
    for ours, other in zip(consistent.flags, free.flags, strict=True):
        assert (ours <= other).all()
    assert 0.0 <= consistent.mean <= free.mean + 1e-12


@settings(max_examples=30, deadline=None)
@given(st.lists(polylines(), min_size=1, max_size=6))
def test_distances_are_those_of_the_plain_formula(lines):
    points = resample_all([line for _, line in lines], 50)
    kinds = np.zeros(len(lines), dtype=np.int64)
    plain = np.linalg.norm(points[:, None, :, None] - points[None, :, None], axis=-1)
    expected = (plain.min(axis=3).mean(axis=2) + plain.min(axis=2).mean(axis=2)) / 2
    np.testing.assert_allclose(chamfer_matrix(points, kinds, points, kinds), expected, atol=1e-9)
    limited = chamfer_matrix(points, kinds, points, kinds, limit=2.0)
    np.testing.assert_allclose(limited[expected <= 2.0], expected[expected <= 2.0], atol=1e-9)
    assert (limited[expected > 2.1] > 2.0).all()


@pytest.mark.parametrize("metric", METRICS)
def test_perfect_predictions_give_one(metric):
    lines = [[[0, 0], [4, 0], [4, 6], [0, 6], [0, 0]], [[-20, 3], [20, 5]], [[-20, -8], [20, -9]]]
    frames = [make_frame([0, 1, 2], lines, [0.9, 0.8, 0.7], [0, 1, 2], lines, index) for index in range(3)]
    assert metric(frames).mean == pytest.approx(1.0)


@pytest.mark.parametrize("metric", METRICS)
def test_nothing_predicted_and_nothing_true(metric):
    line = [[-20.0, 3.0], [20.0, 5.0]]
    nothing = make_frame([], [], [], [], [])
    missed = make_frame([], [], [], [1], [line])
    invented = make_frame([1], [line], [0.9], [], [])
    assert metric([nothing]).mean in (0.0, None)
    assert metric([missed]).mean == 0.0
    assert metric([invented]).mean in (0.0, None)
    assert metric([missed, invented, nothing]).mean == 0.0


@pytest.mark.parametrize("metric", METRICS)
@pytest.mark.parametrize("odd", [[[3.0, 3.0]], [[3.0, 3.0], [3.0, 3.0]], [[500.0, 500.0], [501.0, 500.0]]])
@pytest.mark.parametrize("kind", list(ElementKind))
def test_points_lines_without_length_and_far_away_are_measured(metric, odd, kind):
    line = [[-20.0, 3.0], [20.0, 5.0]]
    frame = make_frame([kind, 1], [odd, line], [0.9, 0.8], [1], [line])
    perfect = make_frame([kind], [odd], [0.9], [kind], [odd], index=1)
    value = metric([frame, perfect]).mean
    assert 0.0 <= value <= 1.0


def test_a_duplicate_is_a_false_positive_behind_the_better_one():
    line = [[-20.0, 3.0], [20.0, 5.0]]
    result = chamfer_average_precision([make_frame([1, 1], [line, line], [0.5, 0.9], [1], [line])])
    np.testing.assert_array_equal(result.flags[0], [[0, 0, 0], [1, 1, 1]])
    assert result.kinds[ElementKind.DIVIDER].average_precision == pytest.approx(1.0)


def test_of_equal_scores_the_first_row_wins():
    line, near = [[-20.0, 3.0], [20.0, 5.0]], [[-20.0, 3.2], [20.0, 5.2]]
    flags = chamfer_average_precision([make_frame([1, 1], [near, line], [0.5, 0.5], [1], [line])]).flags[0]
    np.testing.assert_array_equal(flags, [[1, 1, 1], [0, 0, 0]])


def test_broken_input_names_frame_and_element():
    line = [[-20.0, 3.0], [20.0, 5.0]]
    broken = [[0.0, np.nan], [1.0, 1.0]]
    with pytest.raises(UserError, match=r"scene-0001, frame 7, prediction 1: .*NaN"):
        make_frame([1, 2], [line, broken], [0.5, 0.5], [], [], index=7)
    with pytest.raises(UserError, match=r"frame 7, ground truth 0: .*NaN"):
        make_frame([], [], [], [2], [broken], index=7)
    with pytest.raises(UserError, match=r"prediction 0: the score is nan"):
        make_frame([1], [line], [np.nan], [], [])
    with pytest.raises(UserError, match=r"prediction 0: there is no element kind 3"):
        make_frame([3], [line], [0.5], [], [])
    with pytest.raises(UserError, match=r"prediction 0: a polyline must be"):
        make_frame([1], [np.zeros((0, 2))], [0.5], [], [])


def test_the_wide_region_has_the_wide_thresholds():
    assert thresholds_for(RegionOfInterest(60.0, 30.0)) == (0.5, 1.0, 1.5)
    assert thresholds_for(RegionOfInterest(100.0, 50.0)) == (1.0, 1.5, 2.0)


def test_simplification_keeps_lines_of_one_point_and_drops_small_bends():
    bent = np.array([[0.0, 0.0], [5.0, 0.1], [10.0, 0.0]])
    point = np.array([[1.0, 2.0]])
    first, second = simplify_all([point, bent])
    np.testing.assert_array_equal(first, point)
    np.testing.assert_array_equal(second, bent[[0, 2]])
