"""Maps that QGIS, JOSM, GDAL or a person has edited are read as meant, and what was changed is said."""

from __future__ import annotations

import json
import re
import sqlite3
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st

from mapfusion import ElementKind, GlobalMap, MapElement
from mapfusion.formats.by_suffix import read_map, read_maps, write_map
from mapfusion.formats.foreign_values import parse_timestamp
from mapfusion.formats.local_plane import LocalPlane
from mapfusion.merge.config import MergeConfig
from mapfusion.merge.merge import merge_files

PLANE = LocalPlane(8.4, 49.0, "harbour")
STAMP = 1_700_000_000_123_456_789
RING = [[0, 0], [4, 0], [4, 10], [0, 10], [0, 0]]
FORMATS = ("map.geojson", "map.gpkg", "map.fgb", "map.osm")


def element(points, kind=ElementKind.DIVIDER, **more) -> MapElement:
    values = {"confidence": 0.9, "observations": 7, "first_seen": STAMP, "last_seen": STAMP + 1, "track_ids": (3,)}
    return MapElement(kind, np.array(points, dtype=np.float64), **{**values, **more})


EXAMPLE = GlobalMap(
    (
        element([[0, -5], [10, -5], [20, -5]], deviation=np.array([0.1, 0.2, 0.3])),
        element(RING, ElementKind.PED_CROSSING),
    ),
    {"scene": "scene-0103"},
)


@pytest.fixture
def edited(tmp_path):
    """Write the example as GeoJSON, let a function edit the document, and read it."""

    def read(edit):
        path = tmp_path / "map.geojson"
        write_map(EXAMPLE, path, PLANE)
        document = json.loads(path.read_text())
        document = edit(document) or document
        path.write_text(json.dumps(document))
        return read_map(path, PLANE)

    return read


def degrees(points):
    return PLANE.to_wgs84(np.array(points, dtype=np.float64)).tolist()


def crossing(document):
    return document["features"][1]["geometry"]


def test_a_map_that_nobody_edited_has_no_notes(edited):
    assert edited(lambda document: None).notes == ()


@pytest.mark.parametrize(
    ("text", "nanoseconds"),
    [
        ("2023-11-14T22:13:20.123Z", 1_700_000_000_123_000_000),
        ("2023-11-14T22:13:20Z", 1_700_000_000_000_000_000),
        ("2023/11/14 22:13:20.5+00", 1_700_000_000_500_000_000),
        ("2023-11-15T00:13:20+02:00", 1_700_000_000_000_000_000),
        ("2023-11-14 22:13:20", 1_700_000_000_000_000_000),
    ],
)
def test_times_that_gdal_wrote_anew_are_read(text, nanoseconds):
    assert parse_timestamp(text) == nanoseconds


@pytest.mark.parametrize("text", ["yesterday", "2023-13-40T00:00:00Z", "", "1700000000"])
def test_what_is_no_time_is_refused(text):
    with pytest.raises(ValueError, match=r"timestamp|month|day"):
        parse_timestamp(text)


def test_a_vertex_added_by_hand_gets_a_deviation_between_its_neighbours(edited):
    def add_vertex(document):
        line = document["features"][0]["geometry"]["coordinates"]
        line.insert(1, ((np.array(line[0]) + line[1]) / 2).tolist())

    found = edited(add_vertex)
    deviation = found.elements[0].deviation
    assert len(deviation) == len(found.elements[0].points) == 4
    assert deviation[0] == 0.1
    assert deviation[-1] == 0.3
    assert (np.diff(deviation) > 0).all()
    assert any("deviation_m is interpolated" in note for note in found.notes)


def test_rows_drawn_by_hand_are_certain_and_of_the_end_of_the_drive(edited):
    def draw(document):
        geometry = {"type": "LineString", "coordinates": degrees([[0, 5], [20, 5]])}
        properties = {"kind": "divider", "confidence": None, "first_seen": None, "deviation_m": None, "track_ids": None}
        document["features"].append({"type": "Feature", "properties": properties, "geometry": geometry})

    found = edited(draw)
    drawn = found.elements[2]
    assert (drawn.confidence, drawn.observations, drawn.first_seen, drawn.track_ids) == (1.0, 1, STAMP + 1, ())
    assert any("drawn by hand" in note and "feature 2" in note for note in found.notes)


def test_multi_part_geometries_become_their_parts(edited):
    def promote(document):
        line, ring = (feature["geometry"] for feature in document["features"])
        line.update(type="MultiLineString", coordinates=[line["coordinates"], degrees([[50, 0], [60, 0]])])
        ring.update(type="MultiPolygon", coordinates=[ring["coordinates"]])

    found = edited(promote)
    assert [len(element.points) for element in found] == [3, 2, 5]
    assert any("several parts" in note for note in found.notes)


def test_an_unclosed_ring_keeps_all_corners(edited):
    found = edited(lambda document: crossing(document)["coordinates"][0].__delitem__(-1))
    ring = found.elements[1].points
    assert len(ring) == 5
    np.testing.assert_array_equal(ring[0], ring[-1])
    assert any("not closed" in note for note in found.notes)


@pytest.mark.parametrize("kind", ["GeometryCollection", "MultiLineString", "MultiPolygon"])
def test_a_geometry_without_parts_is_told(edited, kind):
    member = "geometries" if kind == "GeometryCollection" else "coordinates"
    found = edited(lambda document: document["features"][0].update(geometry={"type": kind, member: []}))
    assert len(found) == 1
    assert found.notes == ("an empty geometry: left out (1 x: feature 0)",)


def test_holes_are_told(edited):
    hole = degrees([[1, 1], [1, 2], [2, 2], [1, 1]])
    found = edited(lambda document: crossing(document)["coordinates"].append(hole))
    assert any("holes" in note for note in found.notes)


@settings(max_examples=40, deadline=None)
@given(st.permutations(range(5)))
def test_crossings_read_are_valid_whatever_the_order_of_their_corners(tmp_path_factory, order):
    path = tmp_path_factory.mktemp("rings") / "map.geojson"
    corners = np.array([[0, 0], [4, 0], [5, 5], [4, 10], [0, 10]])[list(order)].astype(np.float64)
    write_map(EXAMPLE, path, PLANE)
    document = json.loads(path.read_text())
    crossing(document)["coordinates"] = [degrees([*corners, corners[0]])]
    path.write_text(json.dumps(document))
    rings = [element for element in read_map(path, PLANE) if element.kind is ElementKind.PED_CROSSING]
    assert rings
    assert all(shapely.Polygon(ring.points).is_valid for ring in rings)
    assert all(ring.deviation is None or len(ring.deviation) == len(ring.points) for ring in rings)


def test_heights_a_byte_order_mark_and_six_bounds_are_read(tmp_path):
    path = tmp_path / "map.geojson"
    write_map(EXAMPLE, path, PLANE)
    document = json.loads(path.read_text())
    for position in document["features"][0]["geometry"]["coordinates"]:
        position.append(112.5)
    west, south, east, north = document.pop("bbox")
    document = {"type": "FeatureCollection", "bbox": [west, south, 0, east, north, 1], **document}
    path.write_text("\ufeff" + json.dumps(document, separators=(",", ":")), encoding="utf-8")
    (found,), _ = read_maps([path])
    assert len(found) == 2
    assert found.notes == ()
    np.testing.assert_array_equal(found.elements[0].heights, 112.5)


@pytest.mark.parametrize(
    "member", [{"features": None}, {"predmapnet": {"observed": "yes"}}, {"predmapnet": {"observed": [[[8.4, 49.0]]]}}]
)
def test_members_that_cannot_be_used_are_named(edited, member):
    with pytest.raises(ValueError, match=r"features|observed"):
        edited(lambda document: {**document, **member})


@pytest.mark.parametrize("member", [None, [], "lost"])
def test_lost_provenance_is_told(edited, member):
    assert any(
        "provenance is lost" in note for note in edited(lambda document: {**document, "predmapnet": member}).notes
    )


def test_other_reference_systems_are_transformed_and_unknown_ones_refused(edited):
    from pyproj import Transformer

    utm = Transformer.from_crs(4326, 32632, always_xy=True)

    def project(document):
        for feature in document["features"]:
            lines = [feature["geometry"]["coordinates"]]
            lines = lines[0] if feature["geometry"]["type"] == "Polygon" else lines
            for line in lines:
                line[:] = [list(utm.transform(*position)) for position in line]
        document.pop("bbox")
        document["crs"] = {"type": "name", "properties": {"name": "urn:ogc:def:crs:EPSG::32632"}}

    found = edited(project)
    for before, after in zip(EXAMPLE, found, strict=True):
        np.testing.assert_allclose(after.points, before.points, atol=1e-4)

    def unknown(document):
        document["crs"] = {"type": "name", "properties": {"name": "urn:ogc:def:crs:EPSG::999999"}}

    with pytest.raises(ValueError, match="coordinate reference system"):
        edited(unknown)

    def metres(document):
        project(document)
        del document["crs"]

    with pytest.raises(ValueError, match="not longitude and latitude"):
        edited(metres)


def test_what_josm_deleted_stays_deleted(tmp_path):
    path = tmp_path / "map.osm"
    write_map(EXAMPLE, path, PLANE)
    text = path.read_text()
    first_way = text.index("<way ")
    path.write_text(text[:first_way] + text[first_way:].replace("<way ", '<way action="delete" ', 1))
    found = read_map(path, PLANE)
    assert [element.kind for element in found] == [ElementKind.PED_CROSSING]
    assert any("deleted" in note for note in found.notes)
    path.write_text(text[:first_way] + text[first_way:].replace('visible="true"', 'visible="false"', 1))
    assert [element.kind for element in read_map(path, PLANE)] == [ElementKind.PED_CROSSING]


def test_a_way_drawn_in_josm_is_read_by_its_type(tmp_path):
    path = tmp_path / "map.osm"
    write_map(EXAMPLE, path, PLANE)
    text = path.read_text()
    first, second = re.findall(r'<node id="(\d+)"', text)[:2]
    drawn = f'<way id="-7"><nd ref="{first}"/><nd ref="{second}"/><tag k="type" v="road_border"/></way></osm>'
    path.write_text(text.replace("</osm>", drawn))
    assert [element.kind for element in read_map(path, PLANE)][1] is ElementKind.BOUNDARY


def geopackage(path, *statements):
    """Write the example, and change it as an editor does."""
    write_map(EXAMPLE, path, PLANE)
    with sqlite3.connect(path) as database:
        for table in ("lines", "crossings"):
            for (trigger,) in database.execute(
                "SELECT name FROM sqlite_master WHERE type='trigger' AND tbl_name=?", (table,)
            ).fetchall():
                database.execute(f'DROP TRIGGER "{trigger}"')
        for statement in statements:
            database.execute(statement)
    database.close()


def test_nulls_in_a_geopackage_are_read_and_rows_without_geometry_left_out(tmp_path):
    path = tmp_path / "map.gpkg"
    geopackage(
        path,
        "INSERT INTO lines (geom, kind) SELECT geom, 'boundary' FROM lines",
        "INSERT INTO lines (kind) VALUES ('divider')",
        "UPDATE gpkg_ogr_contents SET feature_count = NULL",
    )
    found = read_map(path, PLANE)
    assert sorted(element.kind for element in found) == [0, 1, 2]
    assert any("without a geometry" in note for note in found.notes)


def test_a_geopackage_that_a_program_has_open_is_not_overwritten(tmp_path):
    path = tmp_path / "map.gpkg"
    write_map(EXAMPLE, path, PLANE)
    editor = sqlite3.connect(path)
    editor.execute("PRAGMA journal_mode=WAL")
    editor.execute("CREATE TABLE edits (id INTEGER)")
    editor.commit()
    before = path.read_bytes()
    with pytest.raises(OSError, match="another program has it open"):
        write_map(GlobalMap(()), path, PLANE)
    assert path.read_bytes() == before
    editor.close()
    write_map(GlobalMap(()), path, PLANE)
    assert len(read_map(path, PLANE)) == 0


@pytest.mark.parametrize(
    "name",
    ["a!b.gpkg", "a;b.gpkg", "a?b.fgb", "ä ö.gpkg", "a!b.osm", "a\nb.gpkg", "a\tb.fgb", "\udcff.gpkg", "\udcff.fgb"],
)
def test_names_with_any_characters_are_written_and_read(tmp_path, name):
    write_map(EXAMPLE, tmp_path / name, PLANE)
    assert len(read_map(tmp_path / name, PLANE)) == 2
    assert [path.name for path in tmp_path.iterdir() if path.suffix != ".yaml"] == [name]


def test_a_name_that_begins_as_one_of_a_driver_is_a_file(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    write_map(EXAMPLE, Path("GPKG:a.gpkg"), PLANE)
    assert len(read_map(Path("GPKG:a.gpkg"), PLANE)) == 2


@pytest.mark.parametrize("name", FORMATS)
def test_links_that_lead_in_a_circle_are_told_and_stay(tmp_path, name):
    (tmp_path / name).symlink_to(tmp_path / f"other-{name}")
    (tmp_path / f"other-{name}").symlink_to(tmp_path / name)
    for use in (lambda path: write_map(EXAMPLE, path, PLANE), read_map):
        with pytest.raises(OSError, match=r"symbolic links|No such file"):
            use(tmp_path / name)
    assert (tmp_path / name).is_symlink()


@pytest.mark.parametrize("name", FORMATS)
def test_a_symbolic_link_stays_one(tmp_path, name):
    (tmp_path / "real").mkdir()
    (tmp_path / name).symlink_to(tmp_path / "real" / name)
    write_map(EXAMPLE, tmp_path / name, PLANE)
    assert (tmp_path / name).is_symlink()
    assert len(read_map(tmp_path / "real" / name, PLANE)) == 2


def test_one_map_in_two_formats_counts_once(tmp_path):
    paths = [tmp_path / "map.geojson", tmp_path / "map.gpkg"]
    for path in paths:
        write_map(EXAMPLE, path, PLANE)
    report = merge_files(paths, tmp_path / "merged.geojson", MergeConfig())
    assert len(report.duplicates) == 1
    assert len(report.maps) == 1


def test_notes_of_the_reader_come_with_the_merge(tmp_path):
    path = tmp_path / "map.geojson"
    write_map(EXAMPLE, path, PLANE)
    document = json.loads(path.read_text())
    crossing(document)["coordinates"][0].pop()
    path.write_text(json.dumps(document))
    report = merge_files([path], tmp_path / "merged.geojson", MergeConfig())
    assert [name for name, note in report.notes if "not closed" in note] == ["map"]


def test_points_far_from_the_origin_of_a_local_frame_are_refused(tmp_path):
    far = GlobalMap(
        (replace(EXAMPLE.elements[0], points=np.array([[500_000.0, 5_400_000.0], [500_010.0, 5_400_000.0]])),)
    )
    with pytest.raises(ValueError, match="km from the origin"):
        write_map(far, tmp_path / "map.geojson", PLANE)


def test_maps_of_two_frames_of_unknown_place_are_not_compared(tmp_path):
    paths = [tmp_path / "a.geojson", tmp_path / "b.geojson"]
    for path, frame in zip(paths, ("my-town", "your-town"), strict=True):
        write_map(EXAMPLE, path, PLANE, {"local_frame": frame})
    with pytest.raises(ValueError, match="do not lie in one frame"):
        read_maps(paths)
    with pytest.raises(ValueError, match="do not lie in one frame"):
        merge_files(paths, tmp_path / "merged.geojson", MergeConfig())


def test_an_edited_copy_of_a_map_is_told_in_a_merge(tmp_path):
    write_map(EXAMPLE, tmp_path / "map.geojson", PLANE)
    document = json.loads((tmp_path / "map.geojson").read_text())
    del document["features"][0]
    (tmp_path / "edited.geojson").write_text(json.dumps(document))
    paths = [tmp_path / "map.geojson", tmp_path / "edited.geojson"]
    report = merge_files(paths, tmp_path / "merged.geojson", MergeConfig())
    assert [name for name, note in report.notes if "copy of" in note] == ["edited"]
