"""What results tell of their origin, and what a person has made by hand: neither is lost on the way."""

import json
import sqlite3
import time

import numpy as np
import pyogrio
import pytest

from mapfusion import ElementKind, GlobalMap, MapElement
from mapfusion.formats.by_suffix import read_map, write_map
from mapfusion.formats.local_plane import LocalPlane
from mapfusion.formats.seal import edited_since_written
from mapfusion.provenance import united_provenance

PLANE = LocalPlane(8.4, 49.0)
FORMATS = ("geojson", "gpkg", "fgb", "osm")


def line(points, kind=ElementKind.DIVIDER):
    return MapElement(kind, np.array(points, dtype=float), 0.9, 8, 10**18, 10**18 + 1)


STREET = GlobalMap(
    (
        line([[0, 0], [150, 0], [150, 90]], ElementKind.BOUNDARY),
        line([[0, 3.5], [80, 3.5]]),
        line([[10, 0], [10, 7], [14, 7], [14, 0], [10, 0]], ElementKind.PED_CROSSING),
    )
)


def write(path, provenance=None, content=STREET):
    write_map(content, path, PLANE, provenance)
    return path


def test_facts_of_several_maps_unite():
    first = {"synthetic": False, "note": "One.", "dataset": "nuscenes", "scene": "a", "version": "1", "observed": []}
    second = {"synthetic": True, "note": "Two.", "dataset": "nuscenes", "scene": "b", "missing_images": {"F": 1}}
    both = {"synthetic": True, "note": "One. Two.", "dataset": "nuscenes", "scene": ["a", "b"]}
    assert united_provenance([first, second]) == both | {"missing_images": {"F": 1}}
    assert united_provenance([united_provenance([first, second]), first]) == both | {"missing_images": {"F": 1}}


@pytest.mark.parametrize("command", ["merge", "diff"])
def test_a_result_says_what_its_maps_are_made_of(predmapnet, tmp_path, command):
    told = {"dataset": "demo", "weights_sha256": "ab", "configuration": {"name": "lite"}}
    write(tmp_path / "a.geojson", told | {"synthetic": True, "note": "No real road.", "scene": "scene-1"})
    write(tmp_path / "b.geojson", told | {"synthetic": False, "scene": "scene-2"})
    assert predmapnet(command, "a.geojson", "b.geojson", "--out", "out.geojson").code == 0
    found = json.loads((tmp_path / "out.geojson").read_text())["predmapnet"]
    assert found["generator"] == f"predmapnet {command}"
    assert found["synthetic"] is True
    assert found["note"] == "No real road."
    assert found["scene"] == ["scene-1", "scene-2"]
    assert {key: found[key] for key in told} == told


@pytest.mark.parametrize("command", ["merge", "diff"])
def test_an_input_is_never_overwritten(predmapnet, tmp_path, command):
    for name in ("a.geojson", "b.geojson"):
        write(tmp_path / name)
    before = (tmp_path / "b.geojson").read_bytes()
    (tmp_path / "link.geojson").symlink_to("b.geojson")
    for out in ("b.geojson", "./b.geojson", "link.geojson"):
        result = predmapnet(command, "a.geojson", "b.geojson", "--out", out, "--force")
        assert result.code == 2
        assert "it is an input" in result.err
    assert (tmp_path / "b.geojson").read_bytes() == before


def move_a_vertex(path):
    if path.suffix in (".geojson", ".osm"):
        text = path.read_text()
        place = text.index("49.000")
        path.write_text(text[: place + 6] + "1" + text[place + 7 :])
        return
    _, table = pyogrio.read_arrow(path, layer=pyogrio.list_layers(path)[0][0])
    if path.suffix == ".gpkg":
        with sqlite3.connect(path) as database:
            for trigger, _ in database.execute("SELECT name, sql FROM sqlite_master WHERE type = 'trigger'").fetchall():
                database.execute(f'DROP TRIGGER "{trigger}"')
            database.execute("UPDATE lines SET confidence = 1.0")
        return
    path.unlink()
    pyogrio.write_arrow(table.slice(0, 2), path, geometry_type="Unknown", crs="EPSG:4326", geometry_name="wkb_geometry")


@pytest.mark.parametrize("ending", FORMATS)
def test_a_map_that_was_edited_since_we_wrote_it_is_not_replaced_without_force(predmapnet, tmp_path, ending):
    source, out = write(tmp_path / "a.geojson"), tmp_path / f"city.{ending}"
    assert predmapnet("merge", source, "--out", out).code == 0
    assert not edited_since_written(out)
    assert predmapnet("merge", source, "--out", out).code == 0, "our own file may be replaced"
    move_a_vertex(out)
    assert edited_since_written(out)
    edited = out.read_bytes()
    refused = predmapnet("merge", source, "--out", out)
    assert refused.code == 2
    assert "would be lost" in refused.err
    assert "--force" in refused.err
    assert out.read_bytes() == edited
    assert predmapnet("merge", source, "--out", out, "--force").code == 0
    assert not edited_since_written(out)


def test_a_geopackage_that_was_only_looked_at_counts_as_untouched(tmp_path):
    path = write(tmp_path / "map.gpkg")
    with sqlite3.connect(path) as database:  # what QGIS does when it opens one
        database.execute("PRAGMA journal_mode = WAL")
        database.execute("SELECT count(*) FROM lines").fetchone()
        database.execute("PRAGMA journal_mode = DELETE")
    assert not edited_since_written(path)
    with sqlite3.connect(path) as database:
        database.execute("UPDATE layer_styles SET styleQML = '<qgis/>'")
    assert edited_since_written(path), "a style is work, too"


def test_a_map_whose_provenance_a_program_has_dropped_counts_as_edited(predmapnet, tmp_path):
    path = write(tmp_path / "map.geojson")
    document = json.loads(path.read_text())
    del document["predmapnet"]
    path.write_text(json.dumps(document))
    assert edited_since_written(path)
    path.write_text('{"type": "FeatureCollection", "features": []}')
    assert not edited_since_written(path), "not ours"


def test_the_seal_does_not_depend_on_the_time(tmp_path):
    seals = []
    for name in ("one.geojson", "two.geojson"):
        seals.append(read_map(write(tmp_path / name)).provenance["content_sha256"])
        time.sleep(1.01)
    assert seals[0] == seals[1] != "0" * 64


def test_diff_tells_scripts_what_it_found(predmapnet, tmp_path):
    old = write(tmp_path / "old.geojson")
    new = write(tmp_path / "new.geojson", content=GlobalMap((STREET.elements[0], STREET.elements[2])))
    assert predmapnet("diff", old, new).code == 0
    found = predmapnet("diff", old, new, "--exit-code", "--json")
    assert found.code == 1
    told = json.loads(found.out)
    assert told["changed"] is True
    assert told["pieces"]["removed"] == {"ped_crossing": 0, "divider": 1, "boundary": 0}
    assert told["metres"]["removed"]["divider"] == pytest.approx(80, abs=1)
    assert told["moved_by_m"]["divider"] is None
    same = predmapnet("diff", old, old, "--exit-code")
    assert same.code == 0
    assert "-0.00" not in same.err


def test_merge_tells_scripts_what_it_did(predmapnet, tmp_path):
    write(tmp_path / "a.geojson")
    told = json.loads(predmapnet("merge", "a.geojson", "--out", "b.gpkg", "--json").out)
    assert told["elements"] == {"ped_crossing": 1, "divider": 1, "boundary": 1}
    assert told["written"] == ["b.gpkg"]
    said = predmapnet("merge", "a.geojson", "--out", "b.gpkg").out
    assert "1 map in 4 tiles" in said or "1 map in 2 tiles" in said or "1 map in 1 tile;" in said
    assert "crossings" in said


def test_an_empty_merge_is_said(predmapnet, tmp_path):
    write(tmp_path / "none.geojson", content=GlobalMap(()))
    result = predmapnet("merge", "none.geojson", "--out", "out.geojson")
    assert result.code == 0
    assert "out.geojson is empty" in result.err
