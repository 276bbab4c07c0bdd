"""Results say what they are of: region, axes, data set and split, or they are refused."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mapfusion.elements import RegionOfInterest
from predmapnet.errors import UserError
from predmapnet.evaluation.recognition import (
    STANDARD,
    WIDE,
    check_region,
    frames_look_like,
    looks_foreign,
    region_of,
    split_of,
    warnings_of,
)
from predmapnet.scenes import SceneInfo

PATH = Path("submission.json")


def elements(roi, count=40, seed=0):
    """Random lines all over a region."""
    random = np.random.default_rng(seed)
    return [(random.random((10, 2)) - 0.5) * roi.size for _ in range(count)]


@settings(max_examples=20, deadline=None)
@given(st.sampled_from([STANDARD, WIDE]), st.integers(0, 1000))
def test_the_region_is_recognised_by_its_elements(roi, seed):
    assert region_of(PATH, [elements(roi, seed=seed)]) == roi


def test_overshoots_do_not_make_another_region():
    lines = elements(STANDARD)
    lines[0] = lines[0] + np.array([6.0, 0.0])
    assert region_of(PATH, [lines]) == STANDARD
    assert region_of(PATH, []) == STANDARD


def test_frames_of_two_regions_are_refused():
    with pytest.raises(UserError, match="mixed"):
        region_of(PATH, [elements(STANDARD, 90), elements(WIDE, 30)])


def test_elements_of_an_unknown_region_are_refused():
    with pytest.raises(UserError, match="cannot be told"):
        region_of(PATH, [elements(RegionOfInterest(200.0, 100.0))])


def test_axes_x_right_and_y_forward_are_refused():
    with pytest.raises(UserError, match=r"\(x, y\) becomes \(y, -x\)"):
        region_of(PATH, [[line[:, ::-1] for line in elements(STANDARD)]])


def test_a_stated_region_that_the_elements_leave_is_refused():
    check_region(PATH, elements(STANDARD), WIDE)
    check_region(PATH, [], STANDARD)
    with pytest.raises(UserError, match="another region"):
        check_region(PATH, elements(WIDE), STANDARD)


def test_names_of_frames_tell_the_data_set():
    sample, sweep = "ca9a282c9e77460f8360f564131a8af5", "315967376859506000"
    assert frames_look_like([sample]) == "nuScenes"
    assert frames_look_like([sweep, f"0526e68e-2ff1-3e53-b0f8-45df02e45a93_{sweep}"]) == "Argoverse 2"
    assert frames_look_like([sample, sweep]) == "a mixture of nuScenes and Argoverse 2"
    assert frames_look_like(["scene-0001/3"]) is None and frames_look_like([]) is None


INFOS = [SceneInfo("a", "train", 40, ""), SceneInfo("b", "val", 40, ""), SceneInfo("c", "val", 40, "")]


def test_the_split_is_that_of_the_scenes():
    assert split_of(INFOS, ["b"]) == ("val", 2)


def test_scenes_of_two_splits_are_refused():
    with pytest.raises(UserError, match=r"1 of train and 1 of val.*--split train or --split val"):
        split_of(INFOS, ["a", "c"])


def test_old_splits_come_with_their_overlap_and_parts_with_their_size():
    (overlap,) = warnings_of("nuscenes", "old", "val", 150, 150)
    assert "80 %" in overlap and "--split-scheme new" in overlap
    assert warnings_of("nuscenes", "new", "val", 150, 150) == []
    assert warnings_of("demo", "old", "test", 10, 10) == []
    assert "2 of the 150 scenes" in warnings_of("argoverse2", "new", "val", 2, 150)[0]
    assert "training split" in warnings_of("nuscenes", "old", "train", 5, 5)[0]


def test_wide_frames_among_narrow_ones_are_refused_whatever_their_share():
    narrow, wide = [elements(STANDARD, 9, seed) for seed in range(10)], [elements(WIDE, 9, seed) for seed in range(10)]
    assert region_of(PATH, wide) == WIDE
    assert region_of(PATH, [*wide, narrow[0]]) == WIDE, "one frame on a narrow road"
    for frames in ([*wide, *narrow], [*wide[:6], *narrow], [*wide, *narrow[:4]]):
        with pytest.raises(UserError, match="--roi"):
            region_of(PATH, frames)


def test_a_frame_of_another_data_set_is_told_from_one_that_is_lacking():
    sample, sweep = "ca9a282c9e77460f8360f564131a8af5", "315967376859506000"
    assert looks_foreign("nuscenes", sweep) and looks_foreign("argoverse2", sample)
    assert not any(looks_foreign(dataset, "scene-0001/3") for dataset in ("nuscenes", "argoverse2", "demo", "log"))
    assert not looks_foreign("nuscenes", sample) and not looks_foreign("argoverse2", sweep)
    assert not looks_foreign("demo", sample) and not looks_foreign("log", f"mine_{sweep}")


def test_a_number_of_many_digits_is_no_time():
    assert frames_look_like(["0" * 32]) == "nuScenes"
