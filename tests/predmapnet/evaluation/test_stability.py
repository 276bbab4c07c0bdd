"""Stability of the online map beside the figures of the public toolbox, and what its values mean."""

import json
from dataclasses import replace
from itertools import groupby

import numpy as np
import pytest

from mapfusion.elements import ElementKind, FrameMap, RegionOfInterest
from predmapnet.evaluation.chamfer_distance import resample_all
from predmapnet.evaluation.frames import EvaluationFrame
from predmapnet.evaluation.stability import scene_instances, stability
from predmapnet.evaluation.stability_matching import MATCHING_POINTS, matching_costs
from predmapnet.evaluation.stability_protocol import Protocol
from predmapnet.evaluation.stability_values import heights, localisation_and_shape, presence, stations_of
from predmapnet.scenes import FrameTruth
from tests.predmapnet.evaluation.metric_fixtures import BUNDLED, REFERENCE, load_metric_case

PUBLISHED = {
    "pkl_all_instances": Protocol.ANCHORED,
    "pkl_as_is": Protocol.PUBLISHED,
    "npz_as_is": Protocol.PAIRED,
}
NAMES = {"presence": "presence", "localization": "localisation", "shape": "shape", "stability": "stability"}
KINDS = {kind.label: kind for kind in ElementKind}


@pytest.fixture(
    scope="module",
    params=[pytest.param(BUNDLED, id="bundled"), pytest.param(REFERENCE, id="reference", marks=pytest.mark.reference)],
)
def read(request):
    """Reader of the files of one folder of fixtures."""

    def content(name):
        path = request.param / name
        if not path.exists():
            pytest.skip(f"there is no {path}: set PREDMAPNET_REFERENCE")
        return json.loads(path.read_text()) if path.suffix == ".json" else dict(np.load(path, allow_pickle=False))

    content.folder = request.param
    return content


@pytest.fixture(scope="module")
def reference(read):
    read("expected_stability.json")
    return load_metric_case(read.folder)


@pytest.fixture(scope="module")
def found(reference):
    """Frames and instances of each scene for a protocol, an interval and a source of ids, made once."""
    made = {}

    def of(protocol, key):
        interval = int(key.split("__")[0].removeprefix("interval_"))
        source = "ids_track" if key.endswith("ids_track") else "ids_world"
        unpublished = Protocol.PAIRED if protocol is Protocol.PAIRED else Protocol.ANCHORED
        if (unpublished, key) not in made:
            given = reference.inputs["gt_world_id"]
            if source == "ids_track":
                given = reference.intermediates["gt_track_id"]
            scenes = []
            for _, group in groupby(range(len(reference.frames)), key=lambda row: reference.frames[row].scene):
                rows = list(group)
                frames = [reference.frames[row] for row in rows]
                ids = [given[reference.truth_rows[row]] for row in rows]
                scenes.append((frames, scene_instances(frames, ids, unpublished, interval)))
            made[unpublished, key] = scenes
        return made[unpublished, key], interval

    return of


def expected_runs():
    for variant in PUBLISHED:
        for key in ("interval_2", "interval_1"):
            for source in ("",) if variant == "npz_as_is" else ("__ids_world", "__ids_track"):
                yield variant, key + source


@pytest.mark.parametrize(("variant", "key"), list(expected_runs()))
def test_every_figure_of_every_subset_is_the_toolbox_one(read, found, variant, key):
    expected, protocol = read("expected_stability.json")[variant][key], PUBLISHED[variant]
    scenes, interval = found(protocol, key)
    for subset, figures in expected.items():
        if "error" in figures:
            continue
        chosen = [scene for scene in scenes if subset in ("all", scene[0][0].scene)]
        result = stability(chosen, protocol, interval)
        for name, value in NAMES.items():
            assert result.mean_of(value) == pytest.approx(figures["mean"][name], abs=1e-6), (subset, name)
            for label, kind in KINDS.items():
                assert result.mean_of(value, kind) == pytest.approx(figures[label][name], abs=1e-6), (subset, label)
        for label, kind in KINDS.items():
            of_kind = result.kinds == kind
            assert (of_kind & result.counted).sum() == figures[label]["num_scored"], subset
            assert (of_kind & ~result.counted).sum() == figures[label]["num_dropped_undetected"], subset
        assert result.frame_pairs == figures["num_frame_pairs"], subset
        assert result.figures()["mAS"] == result.mean


@pytest.mark.parametrize(("variant", "key"), list(expected_runs()))
def test_every_instance_has_the_toolbox_match_and_values(read, reference, found, variant, key):
    given, protocol = read("expected_stability_intermediates.npz"), PUBLISHED[variant]
    scenes, interval = found(protocol, key)
    result = stability(scenes, protocol, interval)
    expected = {name: given[f"{variant}__{key}__{name}"] for name in (*NAMES, "label", "kept")}
    np.testing.assert_array_equal(result.kinds, expected["label"])
    np.testing.assert_array_equal(result.counted, expected["kept"])
    np.testing.assert_array_equal(result.presence, expected["presence"])
    np.testing.assert_allclose(result.localisation, expected["localization"], rtol=0, atol=1e-9)
    np.testing.assert_allclose(result.shape, expected["shape"], rtol=0, atol=1e-7)
    np.testing.assert_allclose(result.stability, expected["stability"], rtol=0, atol=1e-7)
    prefix = f"{variant}__{key}" if protocol is Protocol.PAIRED else f"match__{key}"
    rows = [given[f"{prefix}__{side}_pred_row"] for side in ("cur", "pre")]
    start, matched = 0, []
    for frames, instances in scenes:
        for pair, own in zip(instances.pairs[instances.pair], instances.predictions, strict=True):
            matched.append(
                [
                    reference.predicted_rows[start + frame][row] if row >= 0 else -1
                    for frame, row in zip(pair, own, strict=True)
                ]
            )
        start += len(frames)
    np.testing.assert_array_equal(np.array(matched), np.stack(rows, axis=1))


def test_other_weights_give_the_toolbox_figures(read, found):
    expected = read("expected_stability.json")["extra_overall"]
    for name, figures in expected.items():
        variant, _, rest = name.partition("__")
        key, _, weight = rest.rpartition("__weight_")
        if not key:
            continue  # Guesses about pixels, which we do not make.
        scenes, interval = found(PUBLISHED[variant], key)
        result = stability(scenes, PUBLISHED[variant], interval, float(weight))
        assert result.mean == pytest.approx(figures["mean"]["stability"], abs=1e-6)


def test_lines_are_read_and_sampled_as_in_the_toolbox(read):
    cases = read("stability_cases.json")
    for case in cases["interpolate"]:
        line = np.array(case["poly"], dtype=float)
        np.testing.assert_allclose(heights(line, np.array(case["x"], dtype=float)), case["y"], atol=1e-9)
    for case in cases["samples"]:
        stations = stations_of(np.array(case["poly"], dtype=float))
        assert len(stations) == case["n"]
        np.testing.assert_allclose(stations[[0, 1, -1]], [case["first"], case["second"], case["last"]], atol=1e-12)
    for case in cases["resample_8"]:
        found = resample_all([np.array(case["poly"], dtype=float)], 8)[0]
        np.testing.assert_allclose(found, case["points"], atol=1e-6)


def test_single_values_and_costs_are_those_of_the_toolbox(read):
    cases = read("stability_cases.json")
    for current, previous, value in cases["presence_cur_pre_value"]:
        scores = np.array([[current], [previous]], dtype=np.float32)
        assert presence(scores[0], scores[1])[0] == pytest.approx(value, abs=1e-9)
    for case in cases["localization_shape"]:
        lines = [np.array(case[name], dtype=float).reshape(-1, 2) for name in ("cur", "pre")]
        poses = np.tile(np.eye(4), (2, 1, 1))
        for pose, name in zip(poses, ("cur", "pre"), strict=True):
            pose[:3, :3], pose[:3, 3] = case[f"{name}_rotation"], case[f"{name}_translation"]
        offsets = np.cumsum([0, *map(len, lines)])
        both = np.array([[0, 1]])
        near, alike = localisation_and_shape(np.concatenate(lines), offsets, both, poses, both)
        assert near[0] == pytest.approx(case["localization"], abs=1e-6), case["name"]
        assert alike[0] == pytest.approx(case["shape"], abs=1e-6), case["name"]
    case = cases["matching"]
    pred, gt = (
        resample_all([np.array(line, float) for line in case[name]], MATCHING_POINTS) for name in ("pred", "gt")
    )
    kinds, true_kinds = (np.array([KINDS[name] for name in case[names]]) for names in ("pred_types", "gt_types"))
    costs = matching_costs(pred, kinds, np.array(case["pred_scores"], dtype=np.float32), gt, true_kinds)
    np.testing.assert_allclose(costs, case["cost_pred_by_gt"], atol=1e-4)  # The toolbox's are float32.


LINE = np.array([[0.0, 0.0], [10.0, 0.0], [20.0, 0.0]])


def frame(index, offset=0.0, score=0.9, bend=0.0):
    """One divider and its prediction; the car stands still."""
    line = LINE + np.array([[0, offset], [0, offset + bend], [0, offset]])
    predicted = FrameMap(
        index, np.eye(4), RegionOfInterest(), np.array([1]), np.array([score]), np.array([-1]), (line,)
    )
    return EvaluationFrame("scene-0001", index, predicted, FrameTruth(np.array([1]), (LINE,), np.array([7])))


def measured(frames, protocol=Protocol.ANCHORED):
    ids = [frame.truth.element_ids for frame in frames]
    return stability([(frames, scene_instances(frames, ids, protocol))], protocol)


def test_a_map_that_does_not_move_is_stable():
    for protocol in Protocol:
        result = measured([frame(index) for index in range(4)], protocol)
        assert result.mean_of("stability", ElementKind.DIVIDER) == 1.0, protocol
        assert result.mean == pytest.approx(1 / 3), "a class without instances counts as 0"


def test_three_metres_to_the_side_cost_a_fifth_of_the_localisation():
    result = measured([frame(0), frame(1), frame(2, offset=3.0)])
    assert result.localisation == pytest.approx([0.8])
    assert result.shape == pytest.approx([1.0])
    assert result.stability == pytest.approx([0.9])


def test_a_bend_of_a_right_angle_costs_half_of_the_shape():
    result = measured([frame(0), frame(1), frame(2, bend=10.0)])
    assert result.shape == pytest.approx([0.5])


def test_only_what_appears_is_punished_by_the_presence():
    appears = measured([frame(0, score=0.1), frame(1), frame(2)])
    vanishes = measured([frame(0), frame(1), frame(2, score=0.1)])
    assert appears.presence == pytest.approx([0.2]) and vanishes.presence == pytest.approx([1.0])


def test_what_is_detected_in_neither_frame_does_not_count():
    result = measured([frame(0, score=0.001), frame(1), frame(2, score=0.001)])
    assert len(result.kinds) == 1 and not result.counted.any() and result.mean == 0.0


def test_a_frame_without_predictions_leaves_its_elements_unmatched():
    empty = frame(2)
    empty = replace(empty, predicted=empty.predicted.select(np.zeros(1, dtype=bool)))
    result = measured([frame(0), frame(1), empty, frame(3)])
    assert result.localisation == pytest.approx([0.0, 1.0]) and result.counted.all()
    assert len(measured([frame(0), frame(1), empty, frame(3)], Protocol.PAIRED).kinds) == 1


def test_short_scenes_and_scenes_without_truth_have_no_instances():
    for protocol in Protocol:
        assert measured([frame(0), frame(1)], protocol).mean == 0.0
    nothing = FrameTruth(np.zeros(0, dtype=np.int64), (), np.zeros(0, dtype=np.int64))
    frames = [replace(frame(index), truth=nothing) for index in range(4)]
    assert measured(frames).mean == 0.0 and measured(frames).frame_pairs == 2
