"""Comparison of methods: what differs clearly, what may be chance, and what cannot be compared."""

import json

import numpy as np
import pytest

from predmapnet.errors import UserError
from predmapnet.evaluation.comparison import compare_evaluations
from predmapnet.evaluation.scene_figures import SCENE_FIGURES

EVALUATED = {
    "version": "0.1.0",
    "dataset": "demo",
    "split": "test",
    "split_scheme": "old",
    "official_frames": False,
    "roi_m": [60.0, 30.0],
    "warnings": [],
}


def evaluation(values, **changes):
    """An evaluation whose scenes have these chamfer mAPs, everything else absent."""
    scenes = {
        f"scene-{row:04}": {"frames": 40, **dict.fromkeys(SCENE_FIGURES), "chamfer_mAP": value}
        for row, value in enumerate(values)
    }
    return {"evaluated": {**EVALUATED, **changes}, "chamfer_ap": {"mAP": 0.5}, "per_scene": scenes}


def with_frames(content, count):
    """The evaluation with another number of frames in its last scene."""
    content["per_scene"]["scene-0002"]["frames"] = count
    return content


@pytest.fixture
def write(tmp_path):
    def files(**evaluations):
        for name, content in evaluations.items():
            (tmp_path / f"{name}.json").write_text(json.dumps(content))
        return [tmp_path / f"{name}.json" for name in evaluations]

    return files


def test_a_gain_in_every_scene_is_clear_however_much_scenes_differ(write):
    scenes = np.linspace(0.1, 0.9, 20)
    found = compare_evaluations(write(a=evaluation(scenes), b=evaluation(scenes + 0.01)))
    base, better = found.figures["chamfer_mAP"]
    assert base.difference is None and base.scenes.mean == pytest.approx(0.5)
    assert better.difference.mean == pytest.approx(0.01) and better.difference.low == pytest.approx(0.01)
    assert better.difference.high == pytest.approx(0.01) and better.clear
    assert base.scenes.high - base.scenes.low > 0.1, "the interval of the mean is that of the scenes"


def test_a_gain_that_two_scenes_make_is_not_clear(write):
    gains = np.array([0.3, 0.3] + [-0.02] * 18)
    found = compare_evaluations(write(a=evaluation(np.full(20, 0.5)), b=evaluation(0.5 + gains)))
    entry = found.figures["chamfer_mAP"][1]
    assert entry.difference.mean == pytest.approx(gains.mean()) and not entry.clear
    assert entry.difference.low < 0.0 < entry.difference.high


def test_the_interval_is_that_of_the_mean_of_as_many_scenes(write):
    """For many scenes, the bootstrap interval is the mean plus and minus 1.96 standard errors."""
    values = np.random.default_rng(3).random(200)
    (entry, _) = compare_evaluations(write(a=evaluation(values), b=evaluation(values))).figures["chamfer_mAP"]
    error = 1.96 * values.std() / np.sqrt(len(values))
    assert entry.scenes.low == pytest.approx(values.mean() - error, abs=0.003)
    assert entry.scenes.high == pytest.approx(values.mean() + error, abs=0.003)


def test_equal_methods_have_equal_intervals_and_no_clear_difference(write):
    values = np.random.default_rng(4).random(20)
    one, two = compare_evaluations(write(a=evaluation(values), b=evaluation(values))).figures["chamfer_mAP"]
    assert one.scenes == two.scenes, "the same scenes are drawn for all methods"
    assert two.difference.mean == two.difference.low == two.difference.high == 0.0 and not two.clear


def test_the_seed_decides_the_draws(write):
    paths = write(a=evaluation([0.1, 0.5, 0.9, 0.3]), b=evaluation([0.2, 0.4, 0.9, 0.1]))
    assert compare_evaluations(paths, 5).content() == compare_evaluations(paths, 5).content()
    assert compare_evaluations(paths, 5).content() != compare_evaluations(paths, 6).content()


def test_scenes_without_a_figure_are_left_out_for_all_methods(write):
    found = compare_evaluations(write(a=evaluation([0.4, None, 0.6]), b=evaluation([0.5, 0.0, None])))
    assert found.counted["chamfer_mAP"] == 1
    assert found.figures["chamfer_mAP"][0].scenes.mean == pytest.approx(0.4)
    assert list(found.figures) == ["chamfer_mAP"], "figures that nobody has are absent"


def test_few_scenes_are_named(write):
    assert "3 scenes only" in compare_evaluations(write(a=evaluation([0.1] * 3), b=evaluation([0.2] * 3))).notes[0]


@pytest.mark.parametrize(
    ("second", "message"),
    [
        (evaluation([0.5] * 3, dataset="nuscenes"), "differ in the data set"),
        (evaluation([0.5] * 3, roi_m=[100.0, 50.0]), "differ in the region"),
        (evaluation([0.5] * 3, split_scheme="new"), "differ in the split scheme"),
        (evaluation([0.5] * 3, official_frames=True), "differ in the choice of frames"),
        (evaluation([0.5] * 3, split="val"), "differ in the split"),
        (with_frames(evaluation([0.5] * 3), 39), "different numbers of frames in scene-0002"),
        (evaluation([0.5] * 4), "scene-0003 only in"),
        ({"evaluated": EVALUATED, "chamfer_ap": {"mAP": 0.5}}, r"no figures of single scenes .*0\.1\.0"),
        ({"mAP": 0.5}, "is no evaluation"),
        (evaluation(["high"] * 3), "chamfer_mAP of scene-0000 is no number"),
    ],
)
def test_what_cannot_be_compared_is_refused(write, second, message):
    with pytest.raises(UserError, match=message):
        compare_evaluations(write(a=evaluation([0.5] * 3), b=second))


def test_one_file_broken_files_and_the_same_file_are_refused(write, tmp_path):
    (path,) = write(a=evaluation([0.5]))
    (tmp_path / "broken.json").write_text("{")
    for paths, message in (
        ([path], "at least two"),
        ([path, path], "given twice"),
        ([path, path.parent / ".." / path.parent.name / path.name], "given twice"),
        ([path, tmp_path / "absent.json"], "There is no file"),
        ([path, tmp_path / "broken.json"], "not valid JSON"),
    ):
        with pytest.raises(UserError, match=message):
            compare_evaluations(paths)


def test_stability_of_different_protocols_is_left_out(write):
    first, second = evaluation([0.5] * 12), evaluation([0.5] * 12)
    for content, protocol in ((first, "anchored"), (second, "paired")):
        content["stability"] = {"protocol": protocol, "interval": 2, "mAS": 0.7}
        for figures in content["per_scene"].values():
            figures["mAS"] = 0.7
    found = compare_evaluations(write(a=first, b=second))
    assert "mAS" not in found.figures and "different protocols" in found.notes[0]
