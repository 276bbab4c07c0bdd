"""Per-frame results survive the way to disk and back; what cannot be read is refused in plain words."""

import json
import pickle

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from mapfusion.elements import FrameMap, RegionOfInterest
from predmapnet.errors import UserError
from predmapnet.frame_files.parquet import StoredFrame, read_frames, stored_scenes, write_frames
from predmapnet.frame_files.submission import read_submission


def frame_map(count, generator, forecasts=True):
    lines = tuple(generator.normal(size=(generator.integers(1, 30), 2)) for _ in range(count))
    return FrameMap(
        timestamp=1_533_151_603_547_590_000,
        ego_to_global=generator.normal(size=(4, 4)),
        roi=RegionOfInterest(100.0, 50.0),
        kinds=generator.integers(0, 3, count),
        scores=generator.random(count),
        track_ids=generator.integers(-1, 2**40, count),
        polylines=lines,
        forecasts=tuple(np.zeros((0, 2)) if row % 2 else line + 1.0 for row, line in enumerate(lines))
        if forecasts
        else None,
        visible=(generator.normal(size=(5, 2)), generator.normal(size=(3, 2))) if forecasts else None,
    )


def stored(maps, scene="s"):
    return [StoredFrame(scene, index, "", found) for index, found in enumerate(maps)]


def test_frames_come_back_bit_by_bit(tmp_path):
    generator = np.random.default_rng(1)
    maps = [frame_map(count, generator, forecasts=count != 3) for count in [5, 0, 3, *[2] * 100]]
    path = tmp_path / "frames.parquet"
    write_frames(path, stored(maps, "scene-0103"), {"version": "0.1.0", "dataset": "demo"})
    back = read_frames(path)
    assert back.provenance == {"version": "0.1.0", "dataset": "demo"}
    assert stored_scenes(path) == ("scene-0103",)
    assert [frame.index for frame in back.frames] == list(range(len(maps)))
    for read, written in zip(back.frames, maps, strict=True):
        got = read.frame_map
        assert (got.timestamp, got.roi) == (written.timestamp, written.roi)
        for name in ("ego_to_global", "kinds", "scores", "track_ids"):
            np.testing.assert_array_equal(getattr(got, name), getattr(written, name))
        for lines, expected in (
            (got.polylines, written.polylines),
            (got.forecasts, written.forecasts),
            (got.visible, written.visible),
        ):
            assert (lines is None) == (expected is None)
            for line, other in zip(lines or (), expected or (), strict=True):
                np.testing.assert_array_equal(line, other)
    assert [entry.name for entry in tmp_path.iterdir()] == ["frames.parquet"]


def test_a_file_that_does_not_say_what_was_visible_is_read(tmp_path):
    path = tmp_path / "frames.parquet"
    write_frames(path, stored([frame_map(2, np.random.default_rng(1))], "scene-0103"), {})
    pq.write_table(pq.read_table(path).drop_columns(["visible"]), path)
    assert read_frames(path).frames[0].frame_map.visible is None


def test_one_scene_of_many_is_read_alone(tmp_path):
    path = tmp_path / "frames.parquet"
    generator = np.random.default_rng(3)
    frames = [StoredFrame(s, i, f"{s}{i}", frame_map(2, generator)) for s in ("b", "a") for i in range(2)]
    write_frames(path, frames, {})
    assert stored_scenes(path) == ("b", "a")
    assert [frame.token for frame in read_frames(path, "a").frames] == ["a0", "a1"]


def test_the_same_frames_give_the_same_bytes(tmp_path):
    for name in ("a", "b"):
        write_frames(tmp_path / name, stored([frame_map(4, np.random.default_rng(0))], "s"), {"b": 1, "a": 2})
    assert (tmp_path / "a").read_bytes() == (tmp_path / "b").read_bytes()


def test_an_interrupted_run_leaves_no_file(tmp_path):
    path = tmp_path / "frames.parquet"

    def interrupted():
        yield from stored([frame_map(2, np.random.default_rng(0))])
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_frames(path, interrupted(), {})
    assert list(tmp_path.iterdir()) == []


def test_what_cannot_be_read_is_refused(tmp_path):
    pickled = tmp_path / "results.parquet"
    pickled.write_bytes(pickle.dumps({"results": {}}))
    other = tmp_path / "other.parquet"
    pq.write_table(pa.table({"a": [1]}), other)
    whole = tmp_path / "whole.parquet"
    write_frames(whole, stored([frame_map(4, np.random.default_rng(0))], "s"), {})
    cut = tmp_path / "cut.parquet"
    cut.write_bytes(whole.read_bytes()[:-200])
    for path, message in [
        (pickled, "pickle"),
        (other, "no version in its metadata"),
        (cut, "cannot be read as Parquet"),
        (tmp_path / "absent.parquet", "no file"),
    ]:
        with pytest.raises(UserError, match=message):
            read_frames(path)


def test_a_submission_is_read_by_token(tmp_path):
    path = tmp_path / "submission.json"
    entry = {"vectors": [[[0, 1], [2, 3]], [[4, 5, 9], [6, 7, 9]]], "scores": [0.5, 0.25], "labels": [1, 2]}
    path.write_text(json.dumps({"meta": {}, "results": {"a": entry, "b": entry | {"global_ids": [7, 9]}}}))
    frames = read_submission(path)
    assert frames["a"].track_ids.tolist() == [-1, -1] and frames["b"].track_ids.tolist() == [7, 9]
    np.testing.assert_array_equal(frames["a"].polylines[1], [[4, 5], [6, 7]])


def submission(tmp_path, content):
    path = tmp_path / "submission.json"
    path.write_text(content if isinstance(content, str) else json.dumps(content))
    return path


def test_what_maptracker_writes_beside_is_ignored_and_flat_vectors_are_points(tmp_path):
    entry = {"vectors": [[0, 1, 2, 3]], "scores": [0.5], "labels": [1.0], "props": [0]}
    entry |= {"track_vectors": [], "track_scores": [], "track_labels": [], "semantic_mask": [[0]]}
    empty = {"vectors": [], "scores": [], "labels": [], "props": []}
    frames = read_submission(submission(tmp_path, {"results": {"a": entry, "b": empty}}))
    np.testing.assert_array_equal(frames["a"].polylines[0], [[0, 1], [2, 3]])
    assert frames["a"].kinds.tolist() == [1] and len(frames["b"].kinds) == 0


def test_tracked_positions_saved_as_json_are_called_by_scene_and_place(tmp_path):
    entry = {"vectors": [[0, 1, 2, 3]], "scores": [0.5], "labels": [1], "global_ids": [4]}
    entries = [entry | {"scene_name": "scene-0003", "local_idx": index, "meta": {}} for index in range(2)]
    frames = read_submission(submission(tmp_path, entries))
    assert list(frames) == ["scene-0003/0", "scene-0003/1"]
    assert frames["scene-0003/1"].track_ids.tolist() == [4]


def test_nan_in_a_submission_is_left_for_the_check_that_names_the_element(tmp_path):
    entry = {"vectors": [[[0, 1], [float("nan"), 3]]], "scores": [0.5], "labels": [1]}
    frames = read_submission(submission(tmp_path, {"results": {"a": entry}}))
    assert np.isnan(frames["a"].polylines[0][1, 0])


NORMALISED = {"vectors": [[[0.1, 0.2], [0.3, 0.4]]] * 10, "scores": [1] * 10, "labels": [1] * 10}


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("{", "not valid JSON"),
        ("[]", "holds no frame"),
        ("3", "no object 'results'"),
        ('{"results": {}}', "holds no frame"),
        ('{"abc": {"vectors": []}}', "no object 'results'"),
        ('{"results": {"t": null}}', "frame t: an object .* is expected, not None"),
        ('{"results": {"t": {"vectors": [], "scores": []}}}', "frame t: labels missing"),
        ('{"results": {"t": {"vectors": [], "scores": [1], "labels": []}}}', "0 vectors, 1 scores"),
        (
            '{"results": {"t": {"vectors": [["x"]], "scores": [1], "labels": [0]}}}',
            "frame t, vector 0 is not a list of",
        ),
        (
            '{"results": {"t": {"vectors": [[1, 2, 3]], "scores": [1], "labels": [0]}}}',
            r"vector 0 has the shape \(3,\)",
        ),
        ('{"results": {"t": {"vectors": [[[1], [2]]], "scores": [1], "labels": [0]}}}', "vector 0 has the shape"),
        ('{"results": {"t": {"vectors": [[1, 2]], "scores": [1], "labels": [{}]}}}', "labels are not numbers"),
        ('{"results": {"t": {"vectors": [[1, 2]], "scores": [1], "labels": [0.5]}}}', "not all whole numbers"),
        ('[{"vectors": [], "scores": [], "labels": []}]', "entry 0: .* scene_name and local_idx"),
        ([{"scene_name": "s", "local_idx": 0, "vectors": [], "scores": [], "labels": []}] * 2, "s/0 twice"),
        ({"results": [{"sample_token": "t", "vectors": []}]}, "result file of MapTR .* Convert it"),
        ({"results": {"t": NORMALISED}}, "normalised; metres are expected"),
    ],
)
def test_a_broken_submission_is_named(tmp_path, content, message):
    with pytest.raises(UserError, match=message):
        read_submission(submission(tmp_path, content))
