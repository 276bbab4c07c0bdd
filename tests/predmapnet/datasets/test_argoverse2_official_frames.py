"""Frames of the published Argoverse 2 benchmarks: sweeps with all images, counted across logs."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from predmapnet.datasets.argoverse2 import Argoverse2Source
from predmapnet.datasets.argoverse2_files import ARGOVERSE2_CAMERAS as CAMERAS
from predmapnet.datasets.argoverse2_files import POSES
from predmapnet.datasets.argoverse2_frames import (
    IMAGE_TOLERANCE,
    strided_over_logs,
    strided_over_time,
    sweeps_with_images,
)
from predmapnet.datasets.splits import split_names
from predmapnet.errors import UserError

times = st.lists(st.integers(0, 10**9), unique=True, max_size=30).map(
    lambda values: np.array(sorted(values), dtype=int)
)


@given(times, st.lists(times, min_size=1, max_size=3))
def test_a_sweep_needs_an_image_of_every_camera_within_25_ms(sweeps, images):
    expected = [
        sweep
        for sweep in sweeps
        if all(any(abs(sweep - time) <= IMAGE_TOLERANCE for time in camera) for camera in images)
    ]
    assert sweeps_with_images(sweeps, images).tolist() == expected


def test_the_new_split_counts_on_from_log_to_log():
    sweeps = {"b": np.arange(6), "a": np.arange(10, 13), "empty": np.arange(0), "c": np.arange(20, 27)}
    frames = strided_over_logs(sweeps, 4)
    # Of the concatenation 0..5, 10..12, 20..26 every fourth: 0, 4, 12 (the ninth), 23.
    assert {log: found.tolist() for log, found in frames.items()} == {"b": [0, 4], "a": [12], "empty": [], "c": [23]}


@given(st.lists(times, max_size=5), st.integers(1, 5))
def test_counting_across_logs_is_a_stride_over_their_concatenation(lists, stride):
    frames = strided_over_logs({str(number): sweeps for number, sweeps in enumerate(lists)}, stride)
    together = [time for sweeps in lists for time in sweeps.tolist()]
    assert [time for found in frames.values() for time in found.tolist()] == together[::stride]


def test_the_old_training_split_counts_over_time_and_interleaves_simultaneous_logs():
    sweeps = {"late": np.array([100, 110, 120]), "first": np.array([0, 10, 20, 30]), "same": np.array([5, 15, 25, 35])}
    frames = strided_over_time(sweeps, 3)
    # By time: 0 5 10 15 20 25 30 35 100 110 120; every third: 0, 15, 30, 110.
    assert {log: found.tolist() for log, found in frames.items()} == {"first": [0, 30], "same": [15], "late": [110]}
    assert list(frames) == ["first", "same", "late"]
    assert strided_over_time({}, 4) == {}


def write_logs(root, logs, sweeps=5):
    """Logs with file names only; nothing of their content matters here."""
    for number, log in enumerate(logs):
        folder = root / log
        for time in (10**12 * (number + 1) + np.arange(sweeps) * 10**8).tolist():
            for name in (f"lidar/{time}.feather", *(f"cameras/{camera}/{time + 10**7}.jpg" for camera in CAMERAS)):
                path = folder / "sensors" / name
                path.parent.mkdir(parents=True, exist_ok=True)
                path.touch()
        (folder / POSES).touch()


@pytest.fixture
def short_split(monkeypatch):
    """The new validation split cut down to its first logs, so that a test can have them all."""
    names = split_names("argoverse2_new_val")[:3]
    lists = {"argoverse2_new_val": names, "argoverse2_new_train": (), "argoverse2_skipped": names[1:2]}
    monkeypatch.setattr("predmapnet.datasets.argoverse2.split_names", lists.__getitem__)
    return names


def test_a_source_gives_the_official_frames_of_the_new_split(tmp_path, short_split):
    write_logs(tmp_path, short_split)
    first, skipped, last = short_split
    gone = next((tmp_path / first / "sensors" / "cameras" / CAMERAS[2]).iterdir())
    gone.rename(gone.with_name("7.jpg"))
    plain = {info.name: info.frames for info in Argoverse2Source(tmp_path, split_scheme="new").scenes("val")}
    assert plain == {first: 2, skipped: 2, last: 2}
    source = Argoverse2Source(tmp_path, split_scheme="new", official_frames=True)
    # Four sweeps of the first log have all images; the skipped one does not count; then the last from its sweep 0.
    assert {info.name: info.frames for info in source.scenes("val")} == {first: 1, last: 2}


def test_official_frames_need_all_logs(tmp_path, short_split):
    write_logs(tmp_path, short_split[:2])
    with pytest.raises(UserError, match=f"lacks 1 of 3 logs, {short_split[2]} for one"):
        Argoverse2Source(tmp_path, split_scheme="new", official_frames=True).scenes("val")


@pytest.mark.parametrize(("split", "said"), [("train", "lacks 699 of 700 logs"), ("val", "no rule for the official")])
def test_official_frames_of_the_old_split(tmp_path, split, said):
    write_logs(tmp_path / split, ["0aaa"])
    with pytest.raises(UserError, match=said):
        Argoverse2Source(tmp_path, official_frames=True).scenes()


def test_frames_are_found_by_both_kinds_of_tokens(tmp_path):
    write_logs(tmp_path, ["0aaa", "0bbb"])
    first, second = 10**12, 2 * 10**12 + 4 * 10**8
    found = Argoverse2Source(tmp_path).scenes_of([f"0aaa_{first}", str(second), str(first + 1), "x"])
    assert found == {f"0aaa_{first}": "0aaa", str(second): "0bbb"}
