"""Merging files as a user runs it."""

import json

import numpy as np

from mapfusion import ElementKind, GlobalMap, MapElement
from mapfusion.formats.by_suffix import read_map, write_map
from mapfusion.formats.local_plane import LocalPlane

PLANE = LocalPlane(8.4, 49.0)


def street(offset=(0.0, 0.0), paint=True) -> GlobalMap:
    lines = [
        (ElementKind.BOUNDARY, [[0, 0], [120, 0], [120, -60]]),
        (ElementKind.BOUNDARY, [[0, 8], [128, 8], [128, -60]]),
    ]
    if paint:
        lines.append((ElementKind.DIVIDER, [[0, 4], [100, 4]]))
    return GlobalMap(
        tuple(
            MapElement(kind, np.array(points) + np.array(offset), 0.9, 8, 10**18, 10**18 + 1) for kind, points in lines
        )
    )


def test_a_folder_of_maps_becomes_one(predmapnet, tmp_path):
    for i, offset in enumerate([(0.0, 0.0), (0.8, -0.5), (-0.4, 0.6)]):
        folder = tmp_path / "runs" / f"log-{i}"
        folder.mkdir(parents=True)
        write_map(street(offset, paint=i != 1), folder / "map.geojson", PLANE)
    result = predmapnet("merge", tmp_path / "runs", "--out", "city.geojson")
    assert result.code == 0, result.err
    assert "3 maps" in result.out
    assert "3 aligned" in result.out
    features = json.loads((tmp_path / "city.geojson").read_text())["features"]
    assert len(features) == 3
    sources = {f["properties"]["kind"]: f["properties"]["sources"] for f in features}
    assert sources["divider"] == ["log-0/map", "log-2/map"]
    told = json.loads(predmapnet("merge", tmp_path / "runs", "--out", "city.geojson", "--force", "--json").out)
    shifts = np.array([entry["correction"]["shift"] for entry in told["maps"]])
    np.testing.assert_allclose(shifts[1] - shifts[0], [-0.8, 0.5], atol=0.1)


def test_what_could_not_be_aligned_is_said(predmapnet, tmp_path):
    write_map(street(), tmp_path / "here.geojson", PLANE)
    write_map(street((700.0, 0.0)), tmp_path / "there.geojson", PLANE)
    result = predmapnet("merge", "here.geojson", "there.geojson", "-o", "city.gpkg", "--style")
    assert result.code == 0
    assert len(read_map(tmp_path / "city.gpkg")) == 6
    assert (tmp_path / "city.lines.qml").exists()
    assert "here: merged as it lies: no other map of this place" in result.err


def test_mistakes_are_one_message(predmapnet, tmp_path):
    (tmp_path / "empty").mkdir()
    (tmp_path / "broken.geojson").write_text("{")
    write_map(street(), tmp_path / "here.geojson", PLANE)
    for arguments, message in (
        (("empty", "--out", "a.geojson"), "no map in the folder"),
        (("broken.geojson", "--out", "a.geojson"), "not JSON"),
        (("here.geojson", "here.geojson", "--out", "a.geojson"), "given twice"),
        (("here.geojson", "--out", "a.shp"), "no map format"),
    ):
        result = predmapnet("merge", *arguments)
        assert result.code == 2, arguments
        assert message in result.err
        assert not (tmp_path / "a.geojson").exists()


def test_of_more_maps_than_are_needed_it_takes_those_that_add_most_and_says_which(predmapnet, tmp_path):
    for name, offset in (("here", (0.0, 0.0)), ("again", (0.3, 0.2)), ("there", (700.0, 0.0))):
        write_map(street(offset), tmp_path / f"{name}.geojson", PLANE, {"note": name})
    arguments = ("here.geojson", "again.geojson", "there.geojson", "-o", "city.geojson", "--at-most", 2)
    result = predmapnet("merge", *arguments)
    assert result.code == 0, result.err
    lines = [line.split(":")[0].strip() for line in result.out.splitlines()]
    start = lines.index("2 of 3 maps taken, what adds most first")
    assert sorted(lines[start + 1 : start + 3]) in (["again", "there"], ["here", "there"])
    assert lines[start + 3] == "left out, for they would add less than any of these"
    document = json.loads((tmp_path / "city.geojson").read_text())
    left = lines[start + 4]
    assert document["predmapnet"]["sources"] == sorted({"here", "again", "there"} - {left})
    assert left not in document["predmapnet"]["note"]
    told = json.loads(predmapnet("merge", *arguments, "--json", "--force").out)
    assert [one["name"] for one in told["choice"] if not one["taken"]] == [left]
