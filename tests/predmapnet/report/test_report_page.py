"""The page of a folder of maps: nothing from elsewhere, every failure with its reason, doubts where drives disagree."""

from __future__ import annotations

import base64
import json
import re
import zlib
from pathlib import Path

import numpy as np
import pytest
import shapely
from hypothesis import given
from hypothesis import strategies as st

from mapfusion import ElementKind, GlobalMap, MapElement
from mapfusion.formats.by_suffix import write_map
from mapfusion.formats.local_plane import LocalPlane
from predmapnet.errors import UserError
from predmapnet.report.doubts import doubtful_stretches
from predmapnet.report.drawn_map import STEP, TRUTH, UNKNOWN, DrawnElement, packed, varints
from predmapnet.report.page import ROWS_AT_ONCE, Cell, Column, sortable_table
from predmapnet.report.places import lay_out
from predmapnet.runs.batch_records import Outcome, write_done, write_failed
from predmapnet.runs.fleet_report import folder_report, map_report
from predmapnet.runs.output_folder import OutputFolder

PLANE = LocalPlane(8.41, 49.01)


def line(y: float = 0.0, kind: ElementKind = ElementKind.DIVIDER, **facts) -> MapElement:
    x = np.arange(0.0, 101.0, 5.0)
    facts = {"confidence": 0.95, "observations": 20, "deviation": np.full(len(x), 0.2)} | facts
    return MapElement(kind, np.stack([x, np.full(len(x), y)], axis=1), first_seen=10**18, last_seen=10**18, **facts)


def decoded(content: bytes, count: int) -> list[int]:
    numbers, at = [], 0
    for _ in range(count):
        value = shift = 0
        while True:
            byte = content[at]
            at += 1
            value |= (byte & 127) << shift
            shift += 7
            if byte < 128:
                break
        numbers.append(-(value + 1) // 2 if value % 2 else value // 2)
    assert at == len(content)
    return numbers


@given(st.lists(st.integers(-(2**34), 2**34), max_size=40))
def test_varints_give_the_numbers_back(numbers):
    assert decoded(varints(np.array(numbers, dtype=np.int64)).tobytes(), len(numbers)) == numbers


def test_packed_elements_lie_where_they_are_to_half_a_step():
    elements = [line(3.0), line(-7.03, ElementKind.BOUNDARY, deviation=None)]
    drawn = [DrawnElement(element, np.array([1000.0, -500.0]), row, row == 1) for row, element in enumerate(elements)]
    found = packed(drawn)
    content = zlib.decompress(base64.b64decode(str(found["packed"])))
    rows, counts = np.frombuffer(content, "<u4", 4).reshape(2, 2)
    assert rows.tolist() == [0, 1]
    assert counts.sum() == found["points"]
    assert content[20:22] == bytes([1, 2 + TRUTH])  # kinds, after two rows, counts and observations
    assert content[22:26] == bytes([242, 242, 10, UNKNOWN])  # confidences 0.95, deviation 0.2 m and none
    steps = np.array(decoded(content[26:], 2 * int(counts.sum()))).reshape(-1, 2)
    points = np.cumsum(steps, axis=0) * STEP
    for element, part in zip(elements, np.split(points, np.cumsum(counts)[:-1]), strict=True):
        truth = shapely.LineString(element.points + np.array([1000.0, -500.0]))
        assert shapely.hausdorff_distance(truth, shapely.LineString(part)) <= STEP


def test_doubts_are_low_evidence_wide_bands_and_what_another_drive_looked_for_in_vain():
    wide = line(10.0, deviation=np.where(np.arange(21) < 10, 0.2, 0.9))
    first = GlobalMap((line(0.0), wide, line(20.0, confidence=0.55, observations=2), line(30.0)))
    second = GlobalMap((line(0.5), line(10.0), line(20.3)))
    looked = shapely.box(-20.0, -20.0, 60.0, 50.0)
    doubts = doubtful_stretches([first, second], [shapely.box(-20.0, -20.0, 120.0, 50.0), looked])
    by_element = {(doubt.map, doubt.element): doubt for doubt in doubts}
    assert set(by_element) == {(0, 1), (0, 2), (0, 3)}
    assert by_element[0, 1].reasons == ("± 0.90 m",)
    assert by_element[0, 1].line[:, 0].min() == pytest.approx(47.0, abs=3.0)
    assert by_element[0, 2].reasons == ("confidence 0.55, seen in 2 frames",)
    assert by_element[0, 3].reasons == ("1 of 2 drives do not have it",)
    assert by_element[0, 3].line[:, 0].max() < 61.0  # beyond, the other drive did not look
    assert [doubt.score for doubt in doubts] == sorted((doubt.score for doubt in doubts), reverse=True)


def test_maps_of_one_city_share_a_place_and_places_do_not_overlap(tmp_path):
    here, near, far = PLANE, LocalPlane(8.42, 49.01), LocalPlane(11.5, 48.1)
    files = []
    for name, plane, told in (("a", here, {}), ("b", near, {}), ("c", far, {}), ("d", here, {"local_frame": "x"})):
        files.append((name, tmp_path / f"{name}.geojson"))
        write_map(GlobalMap((line(),)), files[-1][1], plane, told)
    (tmp_path / "e.geojson").write_text("{}")
    places, maps, unread = lay_out([*files, ("e", tmp_path / "e.geojson")])
    place = {placed.name: placed.place for placed in maps}
    assert place["a"] == place["b"]
    assert len(set(place.values())) == len(places) == 3
    assert [name for name, _ in unread] == ["e"]
    boxes = [shapely.box(*(p.low + p.shift), *(p.high + p.shift)) for p in places]
    assert all(not a.intersects(b) for i, a in enumerate(boxes) for b in boxes[:i])


@pytest.fixture
def folder(tmp_path) -> OutputFolder:
    found = OutputFolder(str(tmp_path))
    write_map(GlobalMap((line(),)), tmp_path / "scene-1.geojson", PLANE, {"weights_sha256": "ab" * 32, "note": "<b>"})
    report = {"elements": {"divider": 1}, "metres": {"divider": 100.0}, "frames": 40, "seconds": 8.0}
    report |= {"frames_per_second": 5.0, "rejections": {"jump": 2}, "written": ["scene-1.geojson"], "notes": []}
    report["accuracy"] = {"mean_ap": 0.625, "precision": 0.9, "recall": 0.7}
    write_done(found, "scene-1", "x", 9.0, report)
    write_failed(found, Outcome("</script><i>", "failed", 1.0, error="KeyError", reason="'<pose>'"))
    return found


def test_the_page_needs_nothing_from_elsewhere_and_names_every_failure(folder):
    html = folder_report(folder)
    assert not re.search(r"""(src|href)=["'](https?:|//)|@import|url\(""", html)
    assert "&lt;/script&gt;&lt;i&gt;" in html
    assert "KeyError" in html
    assert "&#x27;&lt;pose&gt;&#x27;" in html
    assert "0.625" in html
    assert 'href="scene-1.geojson"' in html
    data = json.loads(re.search(r'id="city-data">(.*?)</script>', html, re.DOTALL)[1])
    assert data["elements"] == 1
    assert data["rows"] == ["scene-1"]
    assert 'href="/' in folder_report(folder, out_beside=False)


def row_of(html: str, scene: str) -> dict[str, str]:
    """Texts of the row of a scene by heading."""
    table = html[html.index("<h2>Scenes") :]
    heads = re.findall(r"<th [^>]*>([^<]*)</th>", table)
    row = next(line for line in table.split("<tr") if f">{scene}</td>" in line)
    cells = [re.sub(r"<[^>]+>", "", cell) for cell in re.findall(r"<td [^>]*>(.*?)</td>", row)]
    return dict(zip(heads, cells, strict=True))


def test_every_figure_of_a_scene_stands_under_its_heading(folder, tmp_path):
    doubtful = line(30.0, confidence=0.5, observations=2)
    ring = np.array([[0, 40], [18, 40], [18, 44], [0, 44], [0, 40]], dtype=np.float64)
    crossing = MapElement(ElementKind.PED_CROSSING, ring, 0.5, 9, 5_000, 6_000, (1,))
    write_map(GlobalMap((line(), doubtful, crossing)), tmp_path / "scene-1.geojson", PLANE)
    write_failed(folder, Outcome("scene-1", "failed", 1.0, error="KeyError", reason="an earlier time"))
    html = folder_report(folder)
    figures = {"frames": "40", "frames/s": "5.0", "elements": "3", "km": "0.22", "doubts": "2", "rejected": "2"}
    figures |= {"mAP": "0.625", "precision": "0.900", "recall": "0.700", "why": "rejected 2 x jump", "status": "done"}
    assert row_of(html, "scene-1").items() >= figures.items()
    failed = row_of(html, "&lt;/script&gt;&lt;i&gt;")
    assert (failed["status"], failed["elements"], failed["frames"]) == ("failed", "–", "–")
    tiles = dict(re.findall(r"<b>([^<]*)</b><span>([^<]*)</span>", html))
    assert tiles["1"] in ("scenes mapped", "scenes failed", "crossings")
    assert tiles["40"] == "frames, 5.0/s per worker"
    assert tiles["0.2 km"] == "dividers"
    assert "Crossing, 44 m of its outline: " in html


def test_names_and_places_of_any_letters_break_neither_links_nor_the_script(tmp_path):
    write_map(GlobalMap((line(),)), tmp_path / "a b#1%.geojson", PLANE, {"location": "</script><b>"})
    html = folder_report(OutputFolder(str(tmp_path)))
    assert 'href="a%20b%231%25.geojson"' in html
    data = json.loads(re.search(r'id="city-data">(.*?)</script>', html, re.DOTALL)[1])
    assert data["places"][0]["name"] == "</script><b>"
    assert "</script><b>" not in html


def test_the_map_is_drawn_before_long_tables_are_laid_out_and_no_row_is_lost(folder):
    for number in range(2 * ROWS_AT_ONCE):
        write_failed(folder, Outcome(f"bad-{number}", "failed", 1.0, error="KeyError", reason="x"))
    html = folder_report(folder)
    assert html.index("DecompressionStream") < html.index("<h2>Failed") < html.index("<h2>Scenes")
    table = html[html.index("<h2>Scenes") :]
    first, rest = table[: table.index("</table>")], table[table.index("<template>") : table.index("</template>")]
    assert first.count("<tr") == 1 + ROWS_AT_ONCE
    names = re.findall(r"<td class=\"text\">([^<]+)</td>", first + rest)
    shown = [name for name in names if name.startswith("bad-")]
    assert sorted(shown) == sorted(f"bad-{number}" for number in range(2 * ROWS_AT_ONCE))
    assert "<template>" not in sortable_table([Column("x")], [[Cell("1", 1.0)]] * ROWS_AT_ONCE)


def test_a_scene_is_drawn_once_whatever_formats_lie_there(folder, tmp_path):
    write_map(GlobalMap((line(),)), tmp_path / "scene-1.gpkg", PLANE)
    write_map(GlobalMap((line(50.0),)), tmp_path / "scene-2.gpkg", PLANE)
    (tmp_path / "other.json").write_text("{}")
    html = folder_report(folder)
    data = json.loads(re.search(r'id="city-data">(.*?)</script>', html, re.DOTALL)[1])
    assert data["rows"] == ["scene-1", "scene-2"]
    assert "cannot be drawn" not in html


def test_one_map_and_a_folder_without_any(folder, tmp_path):
    assert 'id="city-data"' in map_report(tmp_path / "scene-1.geojson")
    (tmp_path / "empty").mkdir()
    with pytest.raises(UserError, match="neither"):
        folder_report(OutputFolder(str(tmp_path / "empty")))
    Path(tmp_path / "broken.geojson").write_text("{")
    with pytest.raises(UserError, match="broken"):
        map_report(tmp_path / "broken.geojson")
