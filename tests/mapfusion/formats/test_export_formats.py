"""Every format gives back what was written, other programs can open it, and mistakes are named."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree

import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st

from mapfusion import ElementKind, GlobalMap, MapElement
from mapfusion.elements import PAINTS
from mapfusion.formats.by_suffix import SUFFIXES, MapWriter, read_box, read_map, write_map
from mapfusion.formats.identities import all_named
from mapfusion.formats.local_plane import LocalPlane, common_plane
from mapfusion.formats.qgis_style import write_styles

PLANE = LocalPlane(-71.05, 42.34, "harbour")
FORMATS = tuple(f"map{ending}" for ending in SUFFIXES if ending != ".json")
STAMP = 1_700_000_000_123_456_789

numbers = st.floats(-2000.0, 2000.0).map(lambda x: round(x, 3))


@st.composite
def elements(draw) -> MapElement:
    kind = draw(st.sampled_from(ElementKind))
    if kind.is_ring:
        centre, radius = np.array([draw(numbers), draw(numbers)]), draw(st.floats(1.0, 20.0))
        angle = np.linspace(0, 2 * np.pi, draw(st.integers(4, 9)))
        points = centre + radius * np.stack([np.cos(angle), np.sin(angle)], axis=1)
        points[-1] = points[0]
        points = points[:: draw(st.sampled_from([1, -1]))]
    else:
        spots = draw(st.lists(st.tuples(numbers, numbers), min_size=2, max_size=12, unique=True))
        points = np.array(spots)
    deviation = draw(st.none() | st.floats(0.01, 2.0).map(lambda d: np.full(len(points), round(d, 3))))
    if deviation is not None and not kind.is_ring:
        deviation[0] = 0.125
    heights = draw(st.none() | st.floats(1.0, 500.0).map(lambda h: h + np.arange(len(points)) / 8))
    if heights is not None and kind.is_ring:
        heights[-1] = heights[0]
    first = draw(st.integers(0, 2 * 10**18))
    return MapElement(
        kind,
        points,
        round(draw(st.floats(0.0, 1.0)), 4),
        draw(st.integers(0, 10**6)),
        first,
        first + draw(st.integers(0, 10**15)),
        tuple(sorted(draw(st.sets(st.integers(0, 2**60), max_size=4)))),
        deviation,
        tuple(sorted(draw(st.sets(st.text("abc/<&\"'é ", min_size=1, max_size=6), max_size=3)))),
        heights=heights,
        paint=draw(st.sampled_from(["", *PAINTS])) if kind is ElementKind.DIVIDER else "",
    )


def turned_like(ring: MapElement, other: MapElement) -> MapElement:
    """Rings are written counter-clockwise, and may begin at another corner."""
    rows = np.arange(len(ring.points) - 1)
    if not shapely.LinearRing(ring.points).is_ccw:
        rows = rows[::-1]
    distance = np.linalg.norm(ring.points[rows] - other.points[0], axis=1)
    rows = np.roll(rows, -int(np.argmin(distance)))
    return ring.with_vertices(np.append(rows, rows[0]))


def assert_same(one: GlobalMap, two: GlobalMap, tolerance: float = 1e-4) -> None:
    """Maps are the same, whatever the order of their elements."""
    written = {element.name: element for element in all_named(one)}
    assert sorted(written) == sorted(element.name for element in two)
    for b in two:
        a = written[b.name]
        a = turned_like(a, b) if a.kind.is_ring else a
        deviation = a.deviation
        np.testing.assert_allclose(b.points, a.points, atol=tolerance)
        assert (a.heights is None) == (b.heights is None)
        if a.heights is not None:
            np.testing.assert_allclose(b.heights, a.heights, atol=1e-3)
        assert a.paint == b.paint
        assert (b.kind, b.observations, b.first_seen, b.last_seen) == (
            a.kind,
            a.observations,
            a.first_seen,
            a.last_seen,
        )
        assert (b.track_ids, b.sources, b.confidence) == (a.track_ids, a.sources, a.confidence)
        assert (deviation is None) == (b.deviation is None)
        if deviation is not None:
            np.testing.assert_array_equal(b.deviation, deviation)


@pytest.mark.parametrize("name", FORMATS)
@settings(max_examples=15, deadline=None)
@given(found=st.lists(elements(), max_size=5), note=st.text(max_size=20))
def test_what_is_written_is_read_back(tmp_path_factory, name, found, note):
    path = tmp_path_factory.mktemp("formats") / name
    written = GlobalMap(tuple(found), {"note": note, "frames": 3, "synthetic": True})
    write_map(written, path, PLANE, {"scene": "scene-0103"})
    again = read_map(path, PLANE)
    assert_same(written, again)
    assert again.provenance["note"] == note
    assert again.provenance["synthetic"] is True
    assert again.provenance["scene"] == "scene-0103"
    assert again.provenance["georeference"] == "harbour"
    box = read_box(path)
    if not found:
        assert box is None
    else:
        points = PLANE.to_wgs84(np.concatenate([e.points for e in found]))
        np.testing.assert_allclose(box, [*points.min(axis=0), *points.max(axis=0)], atol=1e-8)
    assert sorted(file.name for file in path.parent.iterdir()) == sorted([name, *companions(name)])


def companions(name: str) -> list[str]:
    return ["map_projector_info.yaml"] if name.endswith(".osm") else []


def line(points, kind=ElementKind.DIVIDER, **more) -> MapElement:
    values = {"confidence": 0.9, "observations": 7, "first_seen": STAMP, "last_seen": STAMP + 1, "track_ids": (3,)}
    return MapElement(kind, np.array(points, dtype=np.float64), **{**values, **more})


EXAMPLE = GlobalMap(
    (
        line([[0, 0], [4, 0], [4, 10], [0, 10], [0, 0]], ElementKind.PED_CROSSING),
        line([[0, 0], [10, 1], [20, 0]], deviation=np.array([0.1, 0.2, 0.3])),
        line([[0, 5], [20, 5]], ElementKind.BOUNDARY),
    ),
    {"scene": "scene-0103"},
)


@pytest.mark.parametrize("name", FORMATS)
def test_a_failed_write_leaves_the_old_file(tmp_path, name):
    path = tmp_path / name
    write_map(EXAMPLE, path, PLANE)
    before = path.read_bytes()
    broken = GlobalMap((*EXAMPLE.elements, line([[0.0, 0.0], [np.nan, 1.0]])))
    with pytest.raises(ValueError, match="globe"):
        write_map(broken, path, PLANE)
    assert path.read_bytes() == before
    assert sorted(file.name for file in tmp_path.iterdir()) == sorted([name, *companions(name)])


@pytest.mark.parametrize("name", FORMATS)
def test_without_a_georeference_the_map_is_about_its_middle(tmp_path, name):
    write_map(EXAMPLE, tmp_path / name, PLANE)
    again = read_map(tmp_path / name)
    middle = np.concatenate([e.points for e in again])
    assert np.abs(middle.min(axis=0) + middle.max(axis=0)).max() < 1e-3
    assert sorted(e.length for e in again) == pytest.approx(sorted(e.length for e in EXAMPLE), abs=1e-3)


@pytest.mark.parametrize("name", ("map.gpkg", "map.fgb"))
def test_gdal_sees_layers_in_wgs84(tmp_path, name):
    import pyogrio

    path = tmp_path / name
    write_map(EXAMPLE, path, PLANE)
    layers = pyogrio.list_layers(path).tolist()
    if name == "map.gpkg":
        assert layers == [["lines", "LineString"], ["crossings", "Polygon"], ["layer_styles", None]]
        layers = layers[:2]
    counts = [pyogrio.read_info(path, layer=layer)["features"] for layer, _ in layers]
    assert sum(counts) == 3
    assert all(pyogrio.read_info(path, layer=layer)["crs"] == "EPSG:4326" for layer, _ in layers)


def test_files_that_are_not_maps_are_named(tmp_path):
    for name in FORMATS:
        (tmp_path / name).write_bytes(b"nothing of the kind")
        with pytest.raises(ValueError, match=rf"{name}: (not|cannot|no) "):
            read_map(tmp_path / name)
        with pytest.raises(FileNotFoundError):
            read_map(tmp_path / f"no-{name}")
    with pytest.raises(ValueError, match=r"'.shp' stands for no map format; use one of .geojson"):
        write_map(EXAMPLE, tmp_path / "map.shp", PLANE)
    (tmp_path / "other.osm").write_text('<osm><node id="1" lat="1" lon="1"/><way id="2"><nd ref="1"/></way></osm>')
    with pytest.raises(ValueError, match="feature 0"):
        read_map(tmp_path / "other.osm")


@pytest.mark.parametrize("name", FORMATS)
def test_element_by_element_gives_the_same_map(tmp_path, name):
    with MapWriter(tmp_path / name, PLANE, EXAMPLE.provenance) as writer:
        for element in EXAMPLE:
            writer.write(element)
    assert_same(EXAMPLE, read_map(tmp_path / name, PLANE))


def test_styles_are_valid_and_cover_all_kinds(tmp_path):
    found = [ElementTree.parse(path).getroot() for path in write_styles(tmp_path / "city.gpkg")]
    values = [category.attrib["value"] for root in found for category in root.iter("category")]
    assert sorted(values) == sorted(kind.label for kind in ElementKind)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["city.crossings.qml", "city.lines.qml"]


def test_one_plane_for_several_maps_does_not_depend_on_their_order():
    boxes = np.array([[8.40, 49.0, 8.41, 49.01], [8.43, 49.02, 8.44, 49.03]])
    assert common_plane(boxes) == common_plane(boxes[::-1])
    with pytest.raises(ValueError, match="not of one city"):
        common_plane(np.array([[8.40, 49.0, 8.41, 49.01], [-71.0, 42.0, -70.9, 42.1]]))


@pytest.mark.parametrize("suffix", [".gpkg", ".fgb"])
def test_a_file_that_sends_its_reader_elsewhere_is_no_map(tmp_path, suffix):
    """GDAL would follow a virtual data source to any file, or to the network."""
    secret = tmp_path / "secret.gpkg"
    write_map(EXAMPLE, secret, PLANE)
    source = f"<SrcDataSource>{secret}</SrcDataSource>"
    path = tmp_path / f"map{suffix}"
    path.write_text(f'<OGRVRTDataSource><OGRVRTLayer name="lines">{source}</OGRVRTLayer></OGRVRTDataSource>')
    with pytest.raises(ValueError, match="neither a GeoPackage nor a FlatGeobuf"):
        read_map(path)
