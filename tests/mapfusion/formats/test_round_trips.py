"""Out, edited by another program, and back: merge and diff see what was changed, and nothing else."""

from __future__ import annotations

import json
import subprocess
from pathlib import Path

import numpy as np
import pytest

from mapfusion import ElementKind, GlobalMap, MapElement
from mapfusion.diff import Change, DiffConfig, diff_maps
from mapfusion.formats.by_suffix import SUFFIXES, read_maps, write_map
from mapfusion.formats.local_plane import LocalPlane
from mapfusion.merge.config import MergeConfig
from mapfusion.merge.merge import merge_files
from tests.environments import printed_json
from tests.mapfusion.formats.map_editors import ADDED, EDITORS

PLANE = LocalPlane(8.4, 49.0, "harbour")


def element(name, points, kind=ElementKind.DIVIDER) -> MapElement:
    points = np.array(points, dtype=np.float64)
    return MapElement(
        kind, points, 0.97, 9, 5_000, 6_000, (len(name),), np.full(len(points), 0.1), ("drive",), ((len(name),),),
        heights=100.0 + points[:, 0] / 50, name=name,
    )  # fmt: skip


def ring(x, y):
    return PLANE.to_wgs84(np.array([[-x, -y], [x, -y], [x, y], [-x, y], [-x, -y]], dtype=np.float64)).tolist()


EXAMPLE = GlobalMap(
    (
        element("stays", [[0, 0], [30, 0.5], [60, 0]]),
        element("gone", [[0, -4], [60, -4]]),
        element("kerb", [[0, 20], [30, 20], [60, 20]], ElementKind.BOUNDARY),
        element("crossing", [[20, 2], [24, 2], [24, 12], [20, 12], [20, 2]], ElementKind.PED_CROSSING),
    ),
    {"scene": "scene-0103", "observed": [ring(100, 100)]},
)


def test_every_format_has_an_editor():
    assert set(EDITORS) == set(SUFFIXES) - {".json"}


@pytest.mark.parametrize("suffix", EDITORS)
def test_edits_come_back_into_diff_and_merge(tmp_path, suffix):
    before, after = tmp_path / f"before{suffix}", tmp_path / f"after{suffix}"
    for path in (before, after):
        write_map(EXAMPLE, path, PLANE)
    EDITORS[suffix](after, PLANE)
    (old, new), plane = read_maps([before, after])
    assert old.notes == ()
    assert any("drawn by hand" in note for note in new.notes), (
        "what an added element lacks is supplied, and that is said"
    )
    found = diff_maps(old, new, plane, DiffConfig(tolerance=0.5, align=False))
    assert found.metres(Change.REMOVED, ElementKind.DIVIDER) == pytest.approx(60.0, abs=1.0)
    added = 120.0 if suffix == ".argoverse2.json" else 60.0  # a lane has two sides
    assert found.metres(Change.ADDED, ElementKind.DIVIDER) == pytest.approx(added, abs=1.0)
    assert found.metres(Change.REMOVED, ElementKind.BOUNDARY) + found.metres(Change.MOVED, ElementKind.BOUNDARY) > 20.0
    assert found.metres(Change.UNCHANGED, ElementKind.DIVIDER) == pytest.approx(60.0, abs=1.0)
    assert found.metres(Change.UNCHANGED, ElementKind.PED_CROSSING) == pytest.approx(10.0, abs=0.1)
    assert new.provenance.get("scene") == ("scene-0103" if "provenance is lost" not in str(new.notes) else None)

    report = merge_files([after], tmp_path / f"merged{suffix}", MergeConfig())
    (merged,), plane = read_maps([tmp_path / f"merged{suffix}"])
    names = {element.name for element in merged}
    assert {"stays", "kerb", "crossing"} <= names
    assert "gone" not in names
    assert len(merged) == (5 if suffix == ".argoverse2.json" else 4)
    mine = min(
        merged.of_kind(ElementKind.DIVIDER),
        key=lambda e: np.abs(plane.to_wgs84(e.points)[0] - PLANE.to_wgs84(ADDED)[0]).sum(),
    )
    assert mine.length == pytest.approx(60.0, abs=0.5)
    assert any("drawn by hand" in note for _, note in report.notes)
    kept = next(element for element in merged if element.name == "stays")
    np.testing.assert_allclose(
        kept.heights, 100.0 + (plane.to_wgs84(kept.points)[:, 0] - 8.4) * PLANE.scale[0] / 50, atol=0.1
    )


@pytest.mark.devkit
@pytest.mark.parametrize("suffix", [".gpkg", ".geojson"])
def test_qgis_shows_our_styles_and_its_edits_come_back(tmp_path, suffix):
    python = Path("/usr/bin/python3")
    if (
        not python.is_file()
        or subprocess.run([python, "-c", "import qgis.core"], capture_output=True, check=False).returncode
    ):
        pytest.skip("QGIS's library is not installed (Debian: apt-get install python3-qgis)")
    before, after = tmp_path / f"before{suffix}", tmp_path / f"after{suffix}"
    for path in (before, after):
        write_map(EXAMPLE, path, PLANE)
    added = json.dumps(PLANE.to_wgs84(ADDED).tolist())
    seen = printed_json(python, Path(__file__).with_name("open_with_qgis.py"), after, after, added)
    assert (seen["features"], seen["crs"]) == (3, "EPSG:4326")
    assert seen["heights"][0] == pytest.approx(100.0)
    if suffix == ".gpkg":
        assert seen["categories"] == ["divider", "boundary"]
        assert seen["types"]["first_seen"] == "DateTime"
    (old, new), plane = read_maps([before, after])
    assert any("drawn by hand" in note for note in new.notes)
    found = diff_maps(old, new, plane, DiffConfig(tolerance=0.5, align=False))
    assert found.metres(Change.REMOVED, ElementKind.DIVIDER) == pytest.approx(60.0, abs=1.0)
    assert found.metres(Change.ADDED, ElementKind.DIVIDER) == pytest.approx(60.0, abs=1.0)
    assert found.metres(Change.REMOVED, ElementKind.BOUNDARY) + found.metres(Change.MOVED, ElementKind.BOUNDARY) > 20.0
    assert {element.name for element in new} >= {"stays", "kerb", "crossing"}
