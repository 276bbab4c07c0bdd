"""nuScenes tables in whatever way valid JSON is written, and fields that they lack or hold in another form."""

from __future__ import annotations

import json
import math
import re
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mapfusion import RegionOfInterest
from predmapnet.datasets import large_tables
from predmapnet.datasets.ground_truth.nuscenes import NuScenesGroundTruth
from predmapnet.datasets.large_tables import Mark, select_records
from predmapnet.datasets.nuscenes import NuScenesSource
from predmapnet.errors import UserError

SCENE = "scene-0061"


def edit(root, table, change, **style):
    """Rewrite one table."""
    path = root / "v1.0-mini" / f"{table}.json"
    records = json.loads(path.read_text())
    path.write_text(json.dumps(change(records) or records, **style))


def seen(root):
    """Return what a scene says of its frames: poses, images and calibration."""
    scene = NuScenesSource(root).open(SCENE)
    frames = [scene.frame(index) for index in range(len(scene))]
    return [
        (f.timestamp, f.ego_to_global.tolist(), f.images, [c.camera_to_ego.tolist() for c in f.rig]) for f in frames
    ]


VALUES = st.recursive(
    st.none() | st.booleans() | st.integers(-5, 5) | st.text(max_size=8) | st.sampled_from(["},{", "} , {", '"', "\\"]),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=4), inner, max_size=3),
    max_leaves=8,
)


@settings(max_examples=200, deadline=None)
@given(
    records=st.lists(st.dictionaries(st.text(max_size=4), VALUES, max_size=4), max_size=12),
    indent=st.sampled_from([None, 0, 2]),
    ascii_only=st.booleans(),
    piece=st.integers(1, 40),
    mark=st.booleans(),
)
def test_pieces_give_what_a_json_reader_sees(tmp_path_factory, records, indent, ascii_only, piece, mark):
    path = tmp_path_factory.mktemp("tables") / "table.json"
    text = json.dumps(records, indent=indent, ensure_ascii=ascii_only)
    path.write_text(("\ufeff" if mark else "") + text, encoding="utf-8")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(large_tables, "PIECE", piece)
        assert select_records(path, lambda record: record) == records


MARK = Mark(re.compile(rb'"flag"\s*:\s*(true|false)'), lambda value: value == b"true")
FLAGGED = st.fixed_dictionaries({"flag": st.booleans()}, optional={"a": VALUES, "b": VALUES, "flag ": VALUES})


@settings(max_examples=300, deadline=None)
@given(
    records=st.lists(FLAGGED | st.dictionaries(st.sampled_from(["flag", "{", "},{"]), VALUES, max_size=3), max_size=9),
    indent=st.sampled_from([None, 0, 2]),
    piece=st.integers(1, 60),
)
def test_records_passed_over_by_their_text_are_those_that_a_json_reader_leaves_out(
    tmp_path_factory, records, indent, piece
):
    path = tmp_path_factory.mktemp("tables") / "table.json"
    path.write_text(json.dumps(records, indent=indent))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(large_tables, "PIECE", piece)
        chosen = select_records(path, lambda record: record if record.get("flag") is True else None, MARK)
    assert chosen == [record for record in records if record.get("flag") is True]


@pytest.mark.parametrize("text", ["", "[", '[{"a": 1}', '[{"a": 1}] x', "{}", "[1]", '[{"a": 1}, {"a": }]', "\x00"])
def test_what_is_no_table_is_named(tmp_path, text):
    path = tmp_path / "table.json"
    path.write_text(text)
    with pytest.raises(UserError, match=r"table\.json"):
        select_records(path, lambda record: record)


def blanks(root):
    for table in ("sample_data", "ego_pose", "sample"):
        path = root / "v1.0-mini" / f"{table}.json"
        path.write_text(path.read_text().replace(":", "  :\t").replace(",", " , "))


def nested(root):
    for table in ("sample_data", "ego_pose"):
        edit(root, table, lambda records: [{"about": [{"token": "x"}, {"token": "y"}], **record} for record in records])


def escaped(root):
    for table in ("sample_data", "ego_pose"):
        path = root / "v1.0-mini" / f"{table}.json"
        path.write_text(path.read_text().replace('"token"', '"\\u0074oken"').replace("samples/", "samples\\/"))


def escaped_values(root):
    path = root / "v1.0-mini" / "ego_pose.json"

    def escape(found):
        return found[1] + "".join(f"\\u{ord(letter):04x}" for letter in found[2]) + '"'

    path.write_text(re.sub(r'("token": ")([^"]*)"', escape, path.read_text()))


def numbers_for_flags(root):
    edit(root, "sample_data", lambda records: [r | {"is_key_frame": int(r["is_key_frame"])} for r in records])


def the_word_radar(root):
    edit(root, "sample_data", lambda records: [r | {"description": "RADAR } { was off"} for r in records])


@pytest.mark.parametrize("write", [blanks, nested, escaped, escaped_values, numbers_for_flags, the_word_radar])
def test_tables_are_read_however_they_are_written(nuscenes_root, write):
    expected = seen(nuscenes_root)
    write(nuscenes_root)
    assert seen(nuscenes_root) == expected


FIELDS = [
    ("scene", "nbr_samples"),
    ("scene", "first_sample_token"),
    ("scene", "log_token"),
    ("log", "location"),
    ("sample", "next"),
    ("sample", "timestamp"),
    ("sample_data", "width"),
    ("sample_data", "filename"),
    ("sample_data", "is_key_frame"),
    ("sample_data", "ego_pose_token"),
    ("sample_data", "calibrated_sensor_token"),
    ("calibrated_sensor", "rotation"),
    ("calibrated_sensor", "translation"),
    ("calibrated_sensor", "camera_intrinsic"),
    ("calibrated_sensor", "sensor_token"),
    ("ego_pose", "rotation"),
    ("ego_pose", "token"),
    ("sensor", "channel"),
]


@pytest.mark.parametrize(("table", "field"), FIELDS)
@pytest.mark.parametrize("value", ["missing", None, {"a": 1}, [[]], -7.5])
def test_a_field_that_is_missing_or_something_else_is_named(nuscenes_root, table, field, value):
    def spoil(records):
        for record in records:
            record[field] = value
            if value == "missing":
                del record[field]

    edit(nuscenes_root, table, spoil)
    with pytest.raises(UserError, match=rf"{table}|{field}|key frame|camera"):
        seen(nuscenes_root)


def test_two_scenes_of_one_name_are_both_there(nuscenes_root):
    edit(nuscenes_root, "scene", lambda records: [record | {"name": SCENE} for record in records])
    names = [info.name for info in NuScenesSource(nuscenes_root).scenes()]
    assert names == [SCENE, f"{SCENE} (2)"]


def turn_quaternions(records):
    return [record | {"rotation": record["rotation"][1:] + record["rotation"][:1]} for record in records]


def look_around(records):
    """Turn the cameras, as on a real car; all of them look ahead in the tiny data set."""
    cameras = [record for record in records if record.get("camera_intrinsic")]
    for number, camera in enumerate(cameras):
        half = math.pi * number / len(cameras)
        c, s = math.cos(half) / 2, math.sin(half) / 2
        camera["rotation"] = [c + s, -c - s, c - s, s - c]


def test_sensors_and_poses_in_the_other_order_are_noticed(nuscenes_root):
    edit(nuscenes_root, "ego_pose", turn_quaternions)
    with pytest.raises(UserError, match=r"ego_pose\.json.*x, y, z, w"):
        seen(nuscenes_root)
    edit(nuscenes_root, "ego_pose", lambda records: turn_quaternions(turn_quaternions(turn_quaternions(records))))
    seen(nuscenes_root)
    edit(nuscenes_root, "calibrated_sensor", look_around)
    seen(nuscenes_root)
    edit(nuscenes_root, "calibrated_sensor", turn_quaternions)
    with pytest.raises(UserError, match=r"calibrated_sensor\.json.*x, y, z, w"):
        seen(nuscenes_root)


@pytest.mark.parametrize(("factor", "unit"), [(1e-3, "milliseconds"), (1e3, "nanoseconds"), (1e-6, "seconds")])
def test_another_unit_of_time_is_named(nuscenes_root, factor, unit):
    def scale(records):
        for record in records:
            record["timestamp"] = 1_600_000_000_000_000 + record["timestamp"] % 1_000_000_000
            record["timestamp"] = int(record["timestamp"] * factor)

    edit(nuscenes_root, "sample", scale)
    with pytest.raises(UserError, match=rf"{unit}|not after"):
        seen(nuscenes_root)


def test_intrinsics_of_larger_images_are_refused(nuscenes_root):
    def enlarge(records):
        for record in records:
            if record.get("camera_intrinsic"):
                record["camera_intrinsic"] = (np.array(record["camera_intrinsic"]) * [[5], [5], [1]]).tolist()

    edit(nuscenes_root, "calibrated_sensor", enlarge)
    with pytest.raises(UserError, match="principal point"):
        seen(nuscenes_root)


def expansion(root) -> Path:
    (path,) = (root / "maps" / "expansion").glob("*.json")
    return path


@pytest.mark.parametrize("version", [None, "1.0", "1.2", "old"])
def test_an_old_map_expansion_is_refused_as_truth_but_not_for_mapping(nuscenes_root, version):
    path = expansion(nuscenes_root)
    content = json.loads(path.read_text())
    content.pop("version")
    path.write_text(json.dumps(content if version is None else content | {"version": version}))
    scene = NuScenesSource(nuscenes_root).open(SCENE)
    assert scene.frame(0).images
    with pytest.raises(UserError, match="outdated"):
        scene.truth_map()


def test_a_divider_of_one_node_does_not_refuse_the_map(nuscenes_root):
    path = expansion(nuscenes_root)
    content = json.loads(path.read_text())
    expected = NuScenesGroundTruth(path).elements_within(
        NuScenesGroundTruth(path).region(np.eye(4), RegionOfInterest())
    )
    content["line"].append({"token": "short", "node_tokens": [content["node"][0]["token"]]})
    content["lane_divider"].append({"token": "short", "line_token": "short"})
    path.write_text(json.dumps(content))
    truth = NuScenesGroundTruth(path)
    assert len(truth.elements_within(truth.region(np.eye(4), RegionOfInterest()))) == len(expected)


def test_a_node_that_is_not_finite_is_named(nuscenes_root):
    path = expansion(nuscenes_root)
    content = json.loads(path.read_text())
    content["node"][0]["x"] = math.nan
    path.write_text(json.dumps(content))
    with pytest.raises(UserError, match="not finite"):
        NuScenesGroundTruth(path)
