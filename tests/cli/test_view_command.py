"""``predmapnet view`` of what other commands write: per-frame results and differences; and who takes which file."""

import json

import numpy as np
import pytest
from rerun.chunk import RrdReader

from mapfusion import ElementKind, FrameMap, GlobalMap, MapElement, RegionOfInterest
from mapfusion.formats.by_suffix import write_map
from mapfusion.formats.local_plane import LocalPlane
from predmapnet.frame_files.parquet import StoredFrame, write_frames

PLANE = LocalPlane(8.4, 49.0)


def entities(path) -> dict[str, int]:
    rows: dict[str, int] = {}
    for chunk in RrdReader(path).stream():
        rows[chunk.entity_path] = rows.get(chunk.entity_path, 0) + chunk.num_rows
    return rows


def values(path, entity, component) -> list:
    """Values of a component by frame, in the order of time."""
    rows = []
    for chunk in RrdReader(path).stream():
        batch = chunk.to_record_batch()
        if chunk.entity_path == entity and component in batch.schema.names:
            times = batch.column("frame").to_pylist() if "frame" in batch.schema.names else [0] * batch.num_rows
            rows += zip(times, batch.column(component).to_pylist(), strict=True)
    return [value for _, value in sorted(rows, key=lambda row: row[0])]


def street(path, shift=0.0):
    lines = [np.array([[0.0, 0.0], [90.0, 0.0], [90.0, 60.0]]), np.array([[0.0, 4.0 + shift], [80.0, 4.0 + shift]])]
    kinds = [ElementKind.BOUNDARY, ElementKind.DIVIDER]
    elements = (MapElement(kind, line, 0.9, 8, 10**18, 10**18 + 1) for kind, line in zip(kinds, lines, strict=True))
    write_map(GlobalMap(tuple(elements)), path, PLANE)
    return path


def frame(scene, index, x, broken=False):
    pose = np.eye(4)
    pose[0, 3] = np.nan if broken else x
    line = np.array([[-20.0, 2.0], [20.0, 2.0]])
    found = FrameMap(index * 500_000_000, pose, RegionOfInterest(), [1], [0.9], [7], (line,), (line,))
    return StoredFrame(scene, index, f"{scene}-{index}", found)


@pytest.fixture
def frames(tmp_path):
    path = tmp_path / "frames.parquet"
    rows = [frame("one", 1, 4.0), frame("one", 0, 0.0), frame("one", 2, 0.0, broken=True), frame("one", 3, 8.0)]
    write_frames(path, [*rows, *(frame("two", index, 300.0 + index) for index in range(5))], {"synthetic": True})
    return path


def test_per_frame_results_are_seen_frame_by_frame_with_the_map_they_make(predmapnet, frames, tmp_path):
    result = predmapnet("view", frames, "--out", "one.rrd")
    assert result.code == 0, result.err
    assert "holds 2 scenes; one is shown" in result.err
    assert "1 of 4 frames have broken poses" in result.err
    found = entities(tmp_path / "one.rrd")
    assert found["/world/ego_vehicle/tracks/divider"] == found["/world/ego_vehicle"] == 3
    ways = values(tmp_path / "one.rrd", "/world/ego_vehicle", "Transform3D:translation")
    assert [round(way[0][0]) for way in ways] == [0, 4, 8]
    ((label,),) = values(tmp_path / "one.rrd", "/world/whole_map/divider", "LineStrips3D:labels")
    assert label.startswith("divider")
    assert "3 observations" in label
    assert predmapnet("view", frames, "two", "--out", "two.rrd").code == 0
    assert entities(tmp_path / "two.rrd")["/world/ego_vehicle/tracks/divider"] == 5


def test_what_is_no_file_of_results_or_no_scene_in_it_is_told(predmapnet, frames, tmp_path):
    (tmp_path / "other.parquet").write_bytes(b"PAR1")
    for arguments, words in (
        ((frames, "three"), "no scene 'three'; it holds one, two"),
        (("other.parquet",), "other.parquet"),
        (("absent.parquet",), "There is no file"),
    ):
        result = predmapnet("view", *arguments, "--out", "x.rrd")
        assert result.code == 2, arguments
        assert words in result.err
        assert not (tmp_path / "x.rrd").exists()


@pytest.fixture
def changes(predmapnet, tmp_path):
    (tmp_path / "maps").mkdir()
    old, new = street(tmp_path / "maps" / "old.geojson"), street(tmp_path / "maps" / "new.geojson", shift=1.2)
    path = tmp_path / "maps" / "changes.geojson"
    assert predmapnet("diff", old, new, "--no-align", "--out", path).code == 0
    return path


def test_differences_are_seen_as_such(predmapnet, changes, tmp_path):
    result = predmapnet("view", changes, "--out", "changes.rrd")
    assert result.code == 0, result.err
    found = entities(tmp_path / "changes.rrd")
    assert {"/world/moved/divider", "/world/unchanged/boundary"} <= set(found)
    assert not any(name.startswith("/world/map") for name in found)
    document = json.loads(changes.read_text())
    document["features"][0]["properties"]["change"] = "painted"
    (tmp_path / "wrong.geojson").write_text(json.dumps(document))
    wrong = predmapnet("view", "wrong.geojson", "--out", "wrong.rrd")
    assert wrong.code == 2
    assert "'painted'" in wrong.err


def test_differences_are_never_taken_for_a_map(predmapnet, changes, tmp_path):
    maps = changes.parent
    folder = predmapnet("merge", maps, "--out", "city.geojson")
    assert folder.code == 0, folder.err
    assert "changes.geojson holds the differences of two maps, and is no map: left out" in folder.err
    assert "2 maps" in folder.out
    assert "changes.geojson" in predmapnet("view", maps, "--out", "maps.rrd").err
    for command in (
        ("merge", changes, maps / "old.geojson", "--out", "wrong.geojson"),
        ("diff", maps / "old.geojson", changes),
        ("report", changes, "--out", "wrong.html"),
    ):
        result = predmapnet(*command)
        assert result.code == 2, command
        assert "is no map" in result.err
    (maps / "old.geojson").unlink()
    (maps / "new.geojson").unlink()
    assert "only differences" in predmapnet("merge", maps, "--out", "wrong.geojson").err
    assert not (tmp_path / "wrong.geojson").exists()


def test_differences_that_another_program_saved_are_none_of_a_map(predmapnet, changes, tmp_path):
    """GDAL writes the features into a GeoPackage, without the provenance."""
    import pyogrio.raw

    meta, _, geometry, fields = pyogrio.raw.read(changes)
    keep = [name != "id" for name in meta["fields"]]
    pyogrio.raw.write(
        tmp_path / "saved.gpkg",
        geometry,
        [values for values, kept in zip(fields, keep, strict=True) if kept],
        [name for name, kept in zip(meta["fields"], keep, strict=True) if kept],
        geometry_type="LineString",
        crs="EPSG:4326",
        driver="GPKG",
    )
    result = predmapnet("merge", "saved.gpkg", "--out", "wrong.geojson")
    assert result.code == 2
    assert "is no map" in result.err


@pytest.mark.parametrize("name", ["nope.gpkg", "nope.geojson", "nope.osm"])
def test_a_map_that_is_not_there_is_named(predmapnet, tmp_path, name):
    result = predmapnet("view", tmp_path / name, "--out", tmp_path / "x.rrd")
    assert result.code == 2
    assert result.err.strip() == f"Error: no such file or directory ({tmp_path / name})"
