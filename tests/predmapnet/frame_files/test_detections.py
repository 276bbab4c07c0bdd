"""Results of other people's detectors: one set of checks for all layouts."""

from __future__ import annotations

import json

import numpy as np
import pytest

from mapfusion import RegionOfInterest
from predmapnet.errors import UserError
from predmapnet.frame_files.maptr import read_detections

LINE = [[-10.0, 1.0], [0.0, 1.0], [10.0, 1.0]]
RING = [[2.0, -5.0], [4.0, -5.0], [4.0, 5.0], [2.0, 5.0]]


def maptr(*vectors, token="t0"):
    return {"results": [{"sample_token": token, "vectors": list(vectors)}]}


def vector(points=LINE, name="divider", score=0.9, **more):
    return {"pts": points, "pts_num": len(points), "cls_name": name, "type": 0, "confidence_level": score, **more}


def submission(*vectors, token="t0"):
    numbers = {"ped_crossing": 0, "divider": 1, "boundary": 2}
    return {
        "results": {
            token: {
                "vectors": [v["pts"] for v in vectors],
                "scores": [v["confidence_level"] for v in vectors],
                "labels": [numbers.get(v["cls_name"], 3) for v in vectors],
            }
        }
    }


def hdmapnet(*vectors, token="t0"):
    numbers = {"divider": 0, "ped_crossing": 1, "boundary": 2}
    stripped = [
        {k: x for k, x in v.items() if k != "cls_name"} | {"type": numbers.get(v["cls_name"], 3)} for v in vectors
    ]
    return {"results": {token: stripped}}


LAYOUTS = pytest.mark.parametrize("layout", [maptr, submission, hdmapnet])


@pytest.fixture
def read(tmp_path):
    def reader(content, **options):
        path = tmp_path / "results.json"
        path.write_text(json.dumps(content))
        notes: list[str] = []
        return read_detections(path, notes, **options), notes

    return reader


@LAYOUTS
def test_every_layout_gives_the_same_frame(read, layout):
    frames, notes = read(layout(vector(), vector(RING, "ped_crossing", "0.7"), vector(LINE, "boundary")))
    frame = frames["t0"]
    assert frame.kinds.tolist() == [1, 0, 2]
    np.testing.assert_allclose(frame.scores, [0.9, 0.7, 0.9])
    np.testing.assert_array_equal(frame.polylines[0], LINE)
    np.testing.assert_array_equal(frame.polylines[1], [*RING, RING[0]])
    assert notes == []


@LAYOUTS
def test_classes_that_a_map_does_not_have_are_left_out_and_counted(read, layout):
    frames, notes = read(layout(vector(), vector(name="centerline"), vector(name="centerline")))
    assert frames["t0"].kinds.tolist() == [1]
    assert len(notes) == 1
    assert notes[0].startswith("2 elements of the class")


@LAYOUTS
def test_normalised_points_are_refused_and_read_with_their_region(read, layout):
    shares = [[x / 60 + 0.5, y / 30 + 0.5] for x, y in LINE]
    content = layout(*(vector(shares) for _ in range(12)))
    with pytest.raises(UserError, match="normalised"):
        read(content)
    frames, _ = read(content, normalised=RegionOfInterest(60.0, 30.0))
    np.testing.assert_allclose(frames["t0"].polylines[0], LINE, atol=1e-9)


@LAYOUTS
def test_y_forward_turns_points_in_metres_and_shares(read, layout):
    turned = [[-y, x] for x, y in LINE]
    frames, _ = read(layout(vector(turned)), y_forward=True)
    np.testing.assert_allclose(frames["t0"].polylines[0], LINE, atol=1e-9)
    shares = [[x / 30 + 0.5, y / 60 + 0.5] for x, y in turned]
    frames, _ = read(layout(vector(shares)), normalised=RegionOfInterest(60.0, 30.0), y_forward=True)
    np.testing.assert_allclose(frames["t0"].polylines[0], LINE, atol=1e-9)


@LAYOUTS
def test_a_vector_without_points_is_no_error(read, layout):
    frames, _ = read(layout(vector(), vector([])))
    assert [len(line) for line in frames["t0"].polylines] == [3, 0]


def test_a_repeated_frame_is_dropped_and_one_with_other_content_refused(read):
    content = maptr(vector())
    content["results"] *= 2
    frames, _ = read(content)
    assert len(frames) == 1
    content["results"][1] = {"sample_token": "t0", "vectors": []}
    with pytest.raises(UserError, match="t0 twice"):
        read(content)


def test_a_frame_that_an_object_names_twice_is_refused(tmp_path):
    path = tmp_path / "results.json"
    entry = json.dumps(submission(vector())["results"]["t0"])
    path.write_text(f'{{"results": {{"t0": {entry}, "t0": {entry}}}}}')
    with pytest.raises(UserError, match="t0 twice"):
        read_detections(path, [])


@pytest.mark.parametrize(
    ("broken", "message"),
    [
        ({"results": [{"vectors": []}, {"sample_token": "t", "vectors": []}]}, "entry 0: its sample_token is missing"),
        ({"results": [{"sample_token": "t", "vectors": None}]}, "frame t: a list 'vectors'"),
        ({"results": [{"sample_token": "t", "vectors": [{"pts": LINE}]}]}, "vector 0: confidence_level missing"),
        ({"results": [{"sample_token": "t", "vectors": [vector(score="high")]}]}, "scores are not numbers"),
        ({"results": {"t": [None]}}, "frame t, vector 0"),
        ({"results": {"t": [vector([["a", 1]])]}}, "vector 0 is not a list of points"),
    ],
)
def test_what_cannot_be_read_is_named(read, broken, message):
    with pytest.raises(UserError, match=message):
        read(broken)
