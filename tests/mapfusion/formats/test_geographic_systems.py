"""GeoPackages and FlatGeobufs as QGIS wants them: reference systems, types, observed ground, styles."""

from __future__ import annotations

import sqlite3
from xml.etree import ElementTree

import numpy as np
import pyogrio
import pytest
import shapely
from pyogrio import raw
from pyproj import Transformer

from mapfusion import ElementKind, GlobalMap, MapElement
from mapfusion.formats.by_suffix import read_box, read_map, write_map
from mapfusion.formats.local_plane import LocalPlane
from mapfusion.merge.config import MergeConfig
from mapfusion.merge.merge import merge_files

PLANE = LocalPlane(8.4, 49.0, "harbour")
STAMP = 1_700_000_000_123_456_789
UTM = "EPSG:32632"


def element(points, kind=ElementKind.DIVIDER, **more) -> MapElement:
    return MapElement(kind, np.array(points, dtype=np.float64), 0.9, 7, STAMP, STAMP + 5, (3,), **more)


def ring(*corners):
    return PLANE.to_wgs84(np.array([*corners, corners[0]], dtype=np.float64)).tolist()


OBSERVED = [ring((-50, -50), (50, -50), (50, 50), (-50, 50)), ring((10, 10), (20, 10), (20, 20), (10, 20))]
EXAMPLE = GlobalMap(
    (
        element([[0, 0], [4, 0], [4, 10], [0, 10], [0, 0]], ElementKind.PED_CROSSING),
        element([[0, 0], [10, 1], [20, 0]], deviation=np.array([0.1, 0.2, 0.3]), heights=np.array([101.0, 102, 103])),
        element([[0, 5], [20, 5]]),
    ),
    {"observed": OBSERVED},
)


@pytest.mark.parametrize("ending", ["gpkg", "fgb"])
def test_a_map_in_utm_has_its_metres_and_comes_back(tmp_path, ending):
    path = tmp_path / f"map.{ending}"
    write_map(EXAMPLE, path, PLANE, crs=UTM)
    layer = "lines" if ending == "gpkg" else None
    assert pyogrio.read_info(path, layer=layer)["crs"] == UTM
    meta, _, geometry, columns = raw.read(path, layer=layer)
    named = dict(zip(meta["fields"], columns, strict=True))
    row = named["number"].tolist().index(1)
    expected = np.stack(
        Transformer.from_crs(4326, 32632, always_xy=True).transform(*PLANE.to_wgs84(EXAMPLE.elements[1].points).T), 1
    )
    np.testing.assert_allclose(shapely.get_coordinates(shapely.from_wkb(geometry[row])), expected, atol=1e-4)
    found = read_map(path, PLANE)
    assert found.notes == ()
    for before, after in zip(EXAMPLE, found, strict=True):
        np.testing.assert_allclose(after.points, before.points, atol=1e-4)
    np.testing.assert_allclose(found.elements[1].heights, [101, 102, 103])
    np.testing.assert_allclose(
        read_box(path), [*PLANE.to_wgs84(np.zeros((1, 2)))[0], *PLANE.to_wgs84(np.array([[20, 10.0]]))[0]], atol=1e-6
    )


@pytest.mark.parametrize(
    ("name", "crs", "message"),
    [
        ("map.geojson", UTM, "RFC 7946"),
        ("map.osm", UTM, "latitude"),
        ("map.xodr", UTM, "Write .gpkg"),
        ("map.nuscenes.json", UTM, "own frame"),
        ("map.gpkg", "EPSG:999999", "EPSG code"),
        ("map.gpkg", "EPSG:5773", "two axes"),
        ("map.gpkg", "EPSG:32755", "outside the area"),
    ],
)
def test_a_system_that_does_not_fit_is_refused(tmp_path, name, crs, message):
    with pytest.raises(ValueError, match=message):
        write_map(EXAMPLE, tmp_path / name, PLANE, crs=crs)
    assert not list(tmp_path.iterdir())


def test_a_merge_is_written_in_the_system_that_is_asked_for(tmp_path):
    write_map(EXAMPLE, tmp_path / "one.geojson", PLANE)
    merge_files([tmp_path / "one.geojson"], tmp_path / "all.gpkg", MergeConfig(), crs=UTM)
    assert pyogrio.read_info(tmp_path / "all.gpkg", layer="lines")["crs"] == UTM
    with pytest.raises(ValueError, match="RFC 7946"):
        merge_files([tmp_path / "one.geojson"], tmp_path / "all.geojson", MergeConfig(), crs=UTM)


def test_columns_have_types_that_can_be_filtered_and_styled_by(tmp_path):
    write_map(EXAMPLE, tmp_path / "map.gpkg", PLANE)
    info = pyogrio.read_info(tmp_path / "map.gpkg", layer="lines")
    types = dict(zip(info["fields"], info["dtypes"], strict=True))
    assert types["first_seen"].startswith("datetime64")
    assert (types["confidence"], types["mean_deviation_m"], types["observations"]) == ("float64", "float64", "int64")
    meta, _, _, columns = raw.read(tmp_path / "map.gpkg", layer="lines", datetime_as_string=True)
    named = dict(zip(meta["fields"], columns, strict=True))
    assert named["first_seen"][0] == "2023-11-14T22:13:20.123Z"
    assert named["mean_deviation_m"][0] == pytest.approx(0.2)
    assert [e.first_seen for e in read_map(tmp_path / "map.gpkg", PLANE)] == [STAMP] * 3
    meta, _, _, columns = raw.read(tmp_path / "map.gpkg", layer="crossings")
    named = dict(zip(meta["fields"], columns, strict=True))
    assert (named["length_m"][0], named["width_m"][0]) == (pytest.approx(10.0), pytest.approx(4.0))


def test_observed_ground_is_a_layer_and_what_is_drawn_there_counts(tmp_path):
    path = tmp_path / "map.gpkg"
    write_map(EXAMPLE, path, PLANE)
    (area,) = shapely.from_wkb(raw.read(path, layer="observed")[2])
    assert len(area.interiors) == 1
    assert read_map(path).notes == ()
    bigger = shapely.Polygon(ring((-80, -50), (50, -50), (50, 50), (-80, 50)))
    raw.write(
        path,
        shapely.to_wkb([bigger]),
        [np.array([0])],
        ["number"],
        layer="observed",
        driver="GPKG",
        geometry_type="Polygon",
        crs="EPSG:4326",
    )
    found = read_map(path)
    assert any("observed ground" in note for note in found.notes)
    assert len(found.provenance["observed"]) == 1
    np.testing.assert_allclose(
        np.min(found.provenance["observed"][0], axis=0), PLANE.to_wgs84(np.array([[-80.0, -50]]))[0]
    )


def test_a_column_that_a_person_renamed_is_supplied(tmp_path):
    write_map(EXAMPLE, tmp_path / "map.gpkg", PLANE)
    with sqlite3.connect(tmp_path / "map.gpkg") as database:
        database.execute("ALTER TABLE lines RENAME COLUMN first_seen TO seen")
    database.close()
    found = read_map(tmp_path / "map.gpkg")
    assert len(found) == 3
    assert any("without confidence, observations or times" in note for note in found.notes)


def test_styles_are_inside_the_geopackage(tmp_path):
    write_map(EXAMPLE, tmp_path / "map.gpkg", PLANE)
    with sqlite3.connect(tmp_path / "map.gpkg") as database:
        rows = database.execute(
            "SELECT f_table_name, f_geometry_column, styleQML, useAsDefault FROM layer_styles"
        ).fetchall()
    database.close()
    assert [row[0] for row in rows] == ["lines", "crossings", "observed"]
    assert all(column == "geom" and default for _, column, _, default in rows)
    assert all(ElementTree.fromstring(style.split("\n", 1)[1]).tag == "qgis" for _, _, style, _ in rows)
