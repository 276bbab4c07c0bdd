"""Formats in metres: places on Earth are exact, and what other programs write is understood."""

from __future__ import annotations

import json

import numpy as np
import pytest
from pyproj import Transformer

from mapfusion import ElementKind, GlobalMap, MapElement
from mapfusion.formats.by_suffix import read_map, write_map
from mapfusion.formats.frame_ties import TiedFrame, ties_of
from mapfusion.formats.local_plane import LocalPlane

PLANE = LocalPlane(8.4, 49.0, "harbour")
ROAD = """<?xml version="1.0"?><OpenDRIVE><header revMajor="1" revMinor="7"><geoReference><![CDATA[
+proj=tmerc +lat_0=49 +lon_0=8.4 +k=1 +x_0=0 +y_0=0 +datum=WGS84 +units=m]]></geoReference></header>
<road id="7" length="20"><planView><geometry s="0" x="5" y="0" hdg="1.5707963267948966" length="20"><line/></geometry>
</planView><elevationProfile><elevation s="0" a="100" b="0.1" c="0" d="0"/></elevationProfile>
<lanes><laneSection s="0"><center><lane id="0">
<roadMark sOffset="0" type="broken"/></lane></center></laneSection></lanes>
<objects><object type="crosswalk" id="1" s="10" t="3" zOffset="2" hdg="0.5"><outlines><outline>
<cornerLocal u="0" v="0" z="99"/><cornerLocal u="4" v="0" z="99"/><cornerLocal u="4" v="2" z="99"/></outline></outlines>
</object></objects></road></OpenDRIVE>"""


class Utm:
    name = "UTM"

    def to_wgs84(self, points):
        transformer = Transformer.from_crs(32632, 4326, always_xy=True)
        return np.stack(transformer.transform(points[:, 0] + 450_000.0, points[:, 1] + 5_430_000.0), axis=1)


def line(points, **more):
    return MapElement(ElementKind.DIVIDER, np.array(points, dtype=np.float64), 0.9, 9, 5, 6, (3,), **more)


def test_ties_of_a_city_lead_back_to_a_millimetre():
    city = GlobalMap((line([[-3000, -2000], [3000, 4000]]),))
    frame = TiedFrame(ties_of(city, Utm()))
    points = np.random.default_rng(0).uniform([-3000, -2000], [3000, 4000], (500, 2))
    off = (frame.to_wgs84(points) - Utm().to_wgs84(points)) * [73_000.0, 111_000.0]
    assert np.abs(off).max() < 1e-3


@pytest.mark.parametrize("ending", ["nuscenes.json", "argoverse2.json"])
def test_metres_moved_in_the_file_are_moved_in_the_map(tmp_path, ending):
    path = tmp_path / f"map.{ending}"
    write_map(GlobalMap((line([[0, 0], [20, 0]], heights=np.array([5.0, 6.0])),)), path, PLANE)
    document = json.loads(path.read_text())
    if ending == "nuscenes.json":
        document["node"][1]["y"] += 2.0
    else:
        next(iter(document["lane_segments"].values()))["left_lane_boundary"][1]["y"] += 2.0
    path.write_text(json.dumps(document))
    (found,) = read_map(path, PLANE)
    np.testing.assert_allclose(found.points, [[0, 0], [20, 2]], atol=1e-3)
    np.testing.assert_allclose(found.heights, [5.0, 6.0])
    del document["predmapnet"]["ties"]
    path.write_text(json.dumps(document))
    with pytest.raises(ValueError, match="ties"):
        read_map(path, PLANE)


def test_a_road_of_another_program_is_read_by_its_mark_and_its_crosswalk(tmp_path):
    (tmp_path / "map.xodr").write_text(ROAD)
    found = read_map(tmp_path / "map.xodr", PLANE)
    divider, crossing = found.elements
    assert (divider.kind, divider.paint) == (ElementKind.DIVIDER, "dashed")
    np.testing.assert_allclose(divider.points, [[5, 0], [5, 20]], atol=0.01)
    np.testing.assert_allclose(divider.heights, [100.0, 102.0], atol=1e-6)
    turn = np.pi / 2 + 0.5
    along, left = np.array([np.cos(turn), np.sin(turn)]), np.array([-np.sin(turn), np.cos(turn)])
    corner = np.array([5.0 - 3.0, 10.0])
    expected = [corner, corner + 4 * along, corner + 4 * along + 2 * left, corner]
    np.testing.assert_allclose(crossing.points, expected, atol=0.01)
    np.testing.assert_allclose(crossing.heights, 101.0)


def test_curves_of_another_program_are_told(tmp_path):
    (tmp_path / "map.xodr").write_text(ROAD.replace("<line/>", '<arc curvature="0.1"/>'))
    assert any("straight" in note for note in read_map(tmp_path / "map.xodr", PLANE).notes)


@pytest.mark.parametrize("content", [b"", b"ARROW1", b"ARROW1\0\0" + bytes(100) + b"ARROW1"])
def test_a_damaged_arrow_file_is_one_message(tmp_path, content):
    (tmp_path / "map.arrow").write_bytes(content)
    with pytest.raises(ValueError, match=r"map\.arrow: no py123d map of ours"):
        read_map(tmp_path / "map.arrow")
