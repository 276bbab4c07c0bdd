"""GeoJSON by the letter of RFC 7946, without loss, the same bytes every time, whole or not at all."""

from __future__ import annotations

import json
import re
from dataclasses import dataclass, replace

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from mapfusion import ElementKind, GlobalMap, MapElement
from mapfusion.formats.foreign_values import format_timestamp, parse_timestamp
from mapfusion.formats.geojson import read_geojson, write_geojson


@dataclass(frozen=True)
class PlateCarree:
    """Metres to degrees by a constant factor around a point."""

    name: str = "test town"
    longitude: float = -123.4
    latitude: float = -48.9
    metres_per_degree: float = 111_000.0

    def to_wgs84(self, points):
        return points / self.metres_per_degree + [self.longitude, self.latitude]

    def from_wgs84(self, points):
        return (points - [self.longitude, self.latitude]) * self.metres_per_degree


TOWN = PlateCarree()
STAMP = 1_700_000_000_123_456_789


def line(points, kind=ElementKind.DIVIDER, **more) -> MapElement:
    values = {"confidence": 0.9, "observations": 7, "first_seen": STAMP, "last_seen": STAMP + 1, "track_ids": (3, 5)}
    return MapElement(kind, np.array(points, dtype=np.float64), **{**values, **more})


CLOCKWISE = [[0, 0], [0, 10], [4, 10], [4, 0], [0, 0]]
EXAMPLE = GlobalMap(
    (
        line(CLOCKWISE[::-1], ElementKind.PED_CROSSING),
        line([[0, 0], [10, 1], [20, 0]], deviation=np.array([0.1, 0.2, 0.3])),
        line([[0, 5], [20, 5]], ElementKind.BOUNDARY),
    ),
    {"version": "0.1.0", "data_set": "demo", "scene": "scene-0103", "synthetic": True},
)


def strict_rfc7946(document: dict) -> None:
    """Check what RFC 7946 demands of a FeatureCollection of lines and polygons."""
    assert document["type"] == "FeatureCollection"
    assert not {"coordinates", "geometry", "geometries", "properties", "crs"} & set(document)  # 7.1, 4
    boxes = []
    for feature in document["features"]:
        assert feature["type"] == "Feature"
        assert {"geometry", "properties"} <= set(feature)
        assert not {"coordinates", "features", "geometries"} & set(feature)
        assert feature["properties"] is None or isinstance(feature["properties"], dict)
        geometry = feature["geometry"]
        assert geometry["type"] in ("LineString", "Polygon")
        rings = geometry["coordinates"] if geometry["type"] == "Polygon" else [geometry["coordinates"]]
        for ring in rings:
            assert all(len(position) == 2 and all(isinstance(c, float) for c in position) for position in ring)
            points = np.array(ring)
            assert (np.abs(points) <= [180, 90]).all()
            boxes.append(points)
        if geometry["type"] == "LineString":
            assert len(rings[0]) >= 2
        else:
            assert len(rings[0]) >= 4  # 3.1.6
            assert rings[0][0] == rings[0][-1]
            x, y = np.array(rings[0]).T - np.array(rings[0][0])[:, None]
            assert (x[:-1] * y[1:] - x[1:] * y[:-1]).sum() > 0  # exterior rings are counterclockwise
    if "bbox" in document:
        points = np.concatenate(boxes)
        assert document["bbox"] == [*points.min(axis=0), *points.max(axis=0)]  # 5


def test_example_is_valid_and_complete(tmp_path):
    path = tmp_path / "map.geojson"
    write_geojson(EXAMPLE, path, TOWN, {"weights": "sha256:0"})
    document = json.loads(path.read_text())
    strict_rfc7946(document)
    assert [f["geometry"]["type"] for f in document["features"]] == ["Polygon", "LineString", "LineString"]
    assert document["features"][1]["properties"] == {
        "kind": "divider",
        "confidence": 0.9,
        "observations": 7,
        "first_seen": "2023-11-14T22:13:20.123456789Z",
        "last_seen": "2023-11-14T22:13:20.123456790Z",
        "track_ids": [3, 5],
        "length_m": 20.1,
        "deviation_m": [0.1, 0.2, 0.3],
    }
    provenance = document["predmapnet"]
    assert provenance["scene"] == "scene-0103"
    assert provenance["synthetic"] is True
    assert provenance["weights"] == "sha256:0"
    assert provenance["georeference"] == "test town"
    assert re.fullmatch(r"\d{4}-\d\d-\d\dT\d\d:\d\d:\d\dZ", provenance["created"])


def test_clockwise_crossings_are_turned(tmp_path):
    path = tmp_path / "map.geojson"
    write_geojson(GlobalMap((line(CLOCKWISE, ElementKind.PED_CROSSING),)), path, TOWN)
    strict_rfc7946(json.loads(path.read_text()))


def test_round_trip_keeps_everything(tmp_path):
    path = tmp_path / "map.geojson"
    write_geojson(EXAMPLE, path, TOWN)
    back = read_geojson(path, TOWN)
    for before, after in zip(EXAMPLE, back, strict=True):
        np.testing.assert_allclose(after.points, before.points, atol=1e-4)
        nothing = {"points": None, "deviation": None, "name": ""}
        assert replace(after, **nothing) == replace(before, **nothing)
    np.testing.assert_array_equal(back.elements[1].deviation, [0.1, 0.2, 0.3])
    assert back.provenance["scene"] == "scene-0103"


@settings(max_examples=30, deadline=None)
@given(
    st.lists(st.tuples(st.floats(-1e4, 1e4), st.floats(-1e4, 1e4)), min_size=2, max_size=30),
    st.integers(0, 2**62),
    st.floats(0, 1),
)
def test_any_line_comes_back_within_a_millimetre(tmp_path_factory, points, stamp, confidence):
    assume(np.ptp(np.array(points), axis=0).max() > 1e-3)  # lines without length are left out
    path = tmp_path_factory.mktemp("lines") / "map.geojson"
    element = line(points, first_seen=stamp, last_seen=stamp, confidence=confidence)
    write_geojson(GlobalMap((element,)), path, TOWN)
    (back,) = read_geojson(path, TOWN)
    assert np.abs(back.points - element.points).max() < 1e-3
    assert back.first_seen == stamp
    assert back.confidence == pytest.approx(confidence, abs=1e-4)


def test_without_georeference_lengths_are_kept(tmp_path):
    path = tmp_path / "map.geojson"
    pyproj = pytest.importorskip("pyproj")
    utm = pyproj.Transformer.from_crs(32610, 4326, always_xy=True)

    class Utm:
        name = "utm"

        def to_wgs84(self, points):
            return np.stack(utm.transform(points[:, 0] + 500_000, points[:, 1] + 4_000_000), axis=1)

    write_geojson(EXAMPLE, path, Utm())
    for before, after in zip(EXAMPLE, read_geojson(path), strict=True):
        assert after.length == pytest.approx(before.length, rel=5e-4)


def test_same_bytes_but_for_the_time(tmp_path):
    texts = []
    for name in ("a", "b"):
        write_geojson(EXAMPLE, tmp_path / name, TOWN)
        texts.append(re.sub(r'"created":"[^"]*"', "", (tmp_path / name).read_text()))
    assert texts[0] == texts[1]


def test_empty_map_is_a_valid_file(tmp_path):
    path = tmp_path / "map.geojson"
    write_geojson(GlobalMap(()), path, TOWN)
    strict_rfc7946(json.loads(path.read_text()))
    assert len(read_geojson(path, TOWN)) == 0


@pytest.mark.parametrize("offset", [np.nan, np.inf, 1e9])
def test_points_off_the_globe_are_refused_and_the_old_file_stays(tmp_path, offset):
    path = tmp_path / "map.geojson"
    path.write_text("old")
    with pytest.raises(ValueError, match="outside the globe"):
        write_geojson(GlobalMap((line([[0, 0], [offset, 0]]),)), path, TOWN)
    assert path.read_text() == "old"
    assert [p.name for p in tmp_path.iterdir()] == ["map.geojson"]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("{", "not JSON"),
        ("[]", "not a GeoJSON FeatureCollection"),
        ('{"type":"FeatureCollection","features":[{}]}', "no feature is an element"),
    ],
)
def test_other_files_are_refused(tmp_path, text, message):
    path = tmp_path / "map.geojson"
    path.write_text(text)
    with pytest.raises(ValueError, match=message):
        read_geojson(path, TOWN)


@pytest.mark.parametrize("nanoseconds", [0, 1, 999_999_999, STAMP, 2**62])
def test_timestamps_keep_every_nanosecond(nanoseconds):
    assert parse_timestamp(format_timestamp(nanoseconds)) == nanoseconds
