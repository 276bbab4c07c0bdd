"""Ids of features are the same from run to run, different within a file, and kept by merges."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from mapfusion import ElementKind, GlobalMap, MapElement
from mapfusion.formats.by_suffix import read_map, write_map
from mapfusion.formats.identities import all_named
from mapfusion.formats.local_plane import LocalPlane
from mapfusion.merge.config import MergeConfig
from mapfusion.merge.merge import merge_files

PLANE = LocalPlane(8.4, 49.0, "harbour")
RING = [[10, 20], [14, 20], [14, 30], [10, 30], [10, 20]]


def element(points, track, kind=ElementKind.DIVIDER, drive="scene-0103") -> MapElement:
    return MapElement(kind, np.array(points, dtype=np.float64), 0.9, 9, 5, 6, (track,), None, (drive,), ((track,),))


LONG = np.stack([np.linspace(-150, 450, 80), np.sin(np.linspace(-2, 6, 80))], axis=1)
EXAMPLE = GlobalMap(
    (
        element(LONG, 3),
        element(LONG + np.array([0, 8]), 4, ElementKind.BOUNDARY),
        element(RING, 5, ElementKind.PED_CROSSING),
        element([[0, -20], [50, -20]], 6),
    )
)


def ids(path):
    return [feature["id"] for feature in json.loads(path.read_text())["features"]]


def test_ids_do_not_depend_on_small_movements_or_on_other_elements():
    first = [e.name for e in all_named(EXAMPLE)]
    moved = GlobalMap(tuple(replace(e, points=e.points + 0.03) for e in EXAMPLE.elements[::-1]))
    assert [e.name for e in all_named(moved)] == first[::-1]
    assert len(set(first)) == 4
    other = GlobalMap(tuple(element(e.points, e.track_ids[0], e.kind, "scene-0104") for e in EXAMPLE))
    assert not set(first) & {e.name for e in all_named(other)}


def test_parts_and_copies_of_an_element_get_ids_of_their_own(tmp_path):
    copied = GlobalMap((*EXAMPLE.elements, EXAMPLE.elements[0], EXAMPLE.elements[0]))
    write_map(copied, tmp_path / "map.geojson", PLANE)
    found = ids(tmp_path / "map.geojson")
    assert len(set(found)) == 6
    assert found[4:] == [f"{found[0]}-2", f"{found[0]}-3"]


@pytest.mark.parametrize("ending", ["geojson", "gpkg", "osm"])
def test_a_merge_keeps_ids_across_tiles_and_maps(tmp_path, ending):
    write_map(EXAMPLE, tmp_path / f"one.{ending}", PLANE)
    before = {e.name for e in read_map(tmp_path / f"one.{ending}")}
    merge_files([tmp_path / f"one.{ending}"], tmp_path / "same.geojson", MergeConfig())
    assert set(ids(tmp_path / "same.geojson")) == before
    other = (element(e.points + 0.05, e.track_ids[0], e.kind, "scene-0200") for e in EXAMPLE.elements[:3])
    write_map(GlobalMap(tuple(other)), tmp_path / "two.geojson", PLANE)
    merge_files([tmp_path / f"one.{ending}", tmp_path / "two.geojson"], tmp_path / "both.geojson", MergeConfig())
    assert set(ids(tmp_path / "both.geojson")) == before
