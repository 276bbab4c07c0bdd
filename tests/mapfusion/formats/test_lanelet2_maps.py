"""Lanelet2 maps are as Autoware wants them, the package opens them, and what JOSM does to them is understood."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from copy import deepcopy

import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st

from mapfusion import ElementKind, GlobalMap, MapElement
from mapfusion.formats.by_suffix import read_map, write_map
from mapfusion.formats.lanelet2 import with_right_side_first
from mapfusion.formats.local_plane import LocalPlane

PLANE = LocalPlane(-71.05, 42.34, "harbour")
RING = [[0, 0], [4, 0], [4, 10], [0, 10], [0, 0]]


def element(points, kind=ElementKind.DIVIDER, **more) -> MapElement:
    return MapElement(kind, np.array(points, dtype=np.float64), 0.9, 7, 5, 6, (3,), **more)


EXAMPLE = GlobalMap(
    (
        element(RING, ElementKind.PED_CROSSING, heights=np.array([50.0, 50, 51, 51, 50])),
        element([[0, -5], [10, -4], [20, -5]], paint="dashed", name="lane line"),
        element([[0, -8], [20, -8]]),
        element([[0, 15], [20, 15]], ElementKind.BOUNDARY),
    ),
    {"scene": "scene-0103"},
)


def tags(thing):
    return {tag.attrib["k"]: tag.attrib["v"] for tag in thing.iter("tag")}


@pytest.fixture
def written(tmp_path):
    write_map(EXAMPLE, tmp_path / "map.osm", PLANE)
    return tmp_path / "map.osm"


def test_nodes_have_degrees_and_heights_and_no_local_metres(written):
    nodes = list(ElementTree.parse(written).getroot().iter("node"))
    assert len(nodes) == 4 + 3 + 2 + 2
    assert all({"lat", "lon"} <= set(node.attrib) and set(tags(node)) == {"ele"} for node in nodes)
    assert sorted(float(tags(node)["ele"]) for node in nodes)[-4:] == [50, 50, 51, 51]
    text = written.with_name("map_projector_info.yaml").read_text()
    assert "projector_type: LocalCartesianUTM" in text
    assert "latitude: 42.34" in text


def test_a_frame_of_unknown_place_has_local_metres_and_no_degrees(tmp_path):
    path = tmp_path / "map.osm"
    write_map(EXAMPLE, path, LocalPlane(0.0, 0.0), {"local_frame": "yard"})
    nodes = list(ElementTree.parse(path).getroot().iter("node"))
    assert all(set(tags(node)) == {"ele", "local_x", "local_y"} and "lat" not in node.attrib for node in nodes)
    assert path.with_name("map_projector_info.yaml").read_text() == "projector_type: Local\n"
    found = read_map(path, LocalPlane(0.0, 0.0))
    np.testing.assert_allclose(found.elements[0].points, EXAMPLE.elements[1].points, atol=1e-3)
    assert found.provenance["local_frame"] == "yard"


def test_lines_and_crossings_are_tagged_as_lanelet2_says(written):
    root = ElementTree.parse(written).getroot()
    ways = [tags(way) for way in root.iter("way")]
    assert [(way["type"], way.get("subtype")) for way in ways] == [
        ("pedestrian_marking", None),
        ("pedestrian_marking", None),
        ("line_thin", "dashed"),
        ("line_thin", "solid"),
        ("road_border", None),
    ]
    assert [way.get("predmapnet:paint") for way in ways[2:4]] == ["dashed", "unknown"]
    (relation,) = root.iter("relation")
    assert tags(relation)["subtype"] == "crosswalk"
    nodes = {node.attrib["id"]: [float(node.attrib[axis]) for axis in ("lon", "lat")] for node in root.iter("node")}
    lines = {way.attrib["id"]: [nodes[nd.attrib["ref"]] for nd in way.iter("nd")] for way in root.iter("way")}
    left, right = (
        next(lines[member.attrib["ref"]] for member in relation.iter("member") if member.attrib["role"] == role)
        for role in ("left", "right")
    )
    assert shapely.LinearRing([*right, *left[::-1]]).is_ccw, "the crossing lies between its sides"


def test_ids_stay_when_another_element_goes(written, tmp_path):
    def ids(path):
        return {
            thing.attrib["id"] for name in ("node", "way") for thing in ElementTree.parse(path).getroot().iter(name)
        }

    (tmp_path / "other").mkdir()
    write_map(GlobalMap(EXAMPLE.elements[1:]), tmp_path / "other" / "map.osm", PLANE)
    assert ids(tmp_path / "other" / "map.osm") < ids(written)


@settings(max_examples=60, deadline=None)
@given(st.integers(3, 9), st.floats(0.2, 1.0), st.floats(0, 6.3), st.integers(0, 20), st.booleans())
def test_sides_of_any_crossing_lie_where_they_should(corners, width, turn, first, clockwise):
    angle = np.roll(np.linspace(0, 2 * np.pi, corners, endpoint=False), first)[:: -1 if clockwise else 1] + turn
    points = np.stack([8 * np.cos(angle), 8 * width * np.sin(angle)], axis=1)
    ring = element(np.vstack([points, points[:1]]), ElementKind.PED_CROSSING)
    turned, corner = with_right_side_first(ring)
    assert 1 <= corner <= corners - 1
    assert shapely.Polygon(turned.points).equals(shapely.Polygon(ring.points))
    assert shapely.LinearRing(turned.points).is_ccw


def edit(path, change):
    tree = ElementTree.parse(path)
    change(tree.getroot())
    tree.write(path)
    return read_map(path, PLANE)


def test_a_crossing_deleted_in_josm_is_gone_and_so_are_its_sides(written):
    found = edit(written, lambda root: root.find("relation").set("action", "delete"))
    assert [e.kind for e in found] == [ElementKind.DIVIDER, ElementKind.DIVIDER, ElementKind.BOUNDARY]
    assert any("deleted" in note for note in found.notes)


def test_sides_whose_lanelet_was_removed_are_told(written):
    found = edit(written, lambda root: root.remove(root.find("relation")))
    assert all(e.kind is not ElementKind.PED_CROSSING for e in found)
    assert any("without its lanelet" in note for note in found.notes)


def test_a_crossing_drawn_by_hand_with_sides_against_each_other_is_a_ring(tmp_path):
    corners = PLANE.to_wgs84(np.array([[0.0, 0], [10, 0], [0, 4], [10, 4]])).tolist()
    nodes = "".join(f'<node id="{n}" lon="{p[0]}" lat="{p[1]}"/>' for n, p in enumerate(corners, start=1))
    (tmp_path / "map.osm").write_text(
        f'<osm>{nodes}<way id="5"><nd ref="1"/><nd ref="2"/></way><way id="6"><nd ref="4"/><nd ref="3"/></way>'
        '<relation id="7"><member type="way" ref="5" role="right"/><member type="way" ref="6" role="left"/>'
        '<tag k="type" v="lanelet"/><tag k="subtype" v="crosswalk"/></relation></osm>'
    )
    (found,) = read_map(tmp_path / "map.osm", PLANE)
    assert shapely.Polygon(found.points).area == pytest.approx(40.0, rel=1e-3)


def test_a_corner_of_a_crossing_that_is_nowhere_is_named(written):
    def lose(root):
        node = root.find("relation/member").attrib["ref"]
        way = next(way for way in root.iter("way") if way.attrib["id"] == node)
        corner = way.find("nd").attrib["ref"]
        next(node for node in root.iter("node") if node.attrib["id"] == corner).set("lat", "nan")

    with pytest.raises(ValueError, match=r"map\.osm: feature 3"):
        edit(written, lose)


@pytest.mark.parametrize("name", ["node", "way", "relation"])
def test_two_things_of_one_id_are_refused(written, name):
    with pytest.raises(ValueError, match=rf"map\.osm: .*the {name} -?\d+ is there twice"):
        edit(written, lambda root: root.append(deepcopy(root.find(name))))


def test_paint_set_in_josm_is_taken(written):
    def repaint(root):
        way = list(root.iter("way"))[3]
        next(tag for tag in way.iter("tag") if tag.attrib["k"] == "subtype").set("v", "dashed")

    assert [e.paint for e in edit(written, repaint)][:2] == ["dashed", "dashed"]


@pytest.mark.lanelet2
def test_the_lanelet2_package_opens_the_map_and_lets_pedestrians_cross(written):
    lanelet2 = pytest.importorskip("lanelet2", reason="the package is there for Linux only")
    projector = lanelet2.projection.UtmProjector(lanelet2.io.Origin(PLANE.latitude, PLANE.longitude))
    lanelet_map, errors = lanelet2.io.loadRobust(str(written), projector)
    assert not list(errors)
    types = sorted(line.attributes["type"] for line in lanelet_map.lineStringLayer)
    assert types == ["line_thin", "line_thin", "pedestrian_marking", "pedestrian_marking", "road_border"]
    lines = [line for line in lanelet_map.lineStringLayer if line.attributes["type"] == "line_thin"]
    dashed = next(line for line in lines if line.attributes["predmapnet:id"] == "lane line")
    assert dashed.attributes["subtype"] == "dashed"
    assert dashed.attributes["predmapnet:confidence"] == "0.9"
    steps = np.linalg.norm(np.diff([[point.x, point.y] for point in dashed], axis=0), axis=1)
    np.testing.assert_allclose(steps, np.hypot([10, 10], [1, 1]), rtol=2e-3)
    (crosswalk,) = lanelet_map.laneletLayer
    assert sorted(point.z for point in crosswalk.leftBound) == [50, 51]
    left, right = ([(point.x, point.y) for point in side] for side in (crosswalk.leftBound, crosswalk.rightBound))
    assert shapely.LinearRing([*right, *left[::-1]]).is_ccw
    for participant, passes in (("Pedestrian", True), ("Vehicle", False)):
        rules = lanelet2.traffic_rules.create(
            lanelet2.traffic_rules.Locations.Germany, getattr(lanelet2.traffic_rules.Participants, participant)
        )
        assert rules.canPass(crosswalk) is passes
    graph = lanelet2.routing.RoutingGraph(lanelet_map, rules)
    assert not list(graph.checkValidity())
