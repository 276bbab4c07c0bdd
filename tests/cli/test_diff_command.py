"""The diff of two files as a user runs it."""

import json

import numpy as np

from mapfusion import ElementKind, GlobalMap, MapElement
from mapfusion.formats.by_suffix import write_map
from mapfusion.formats.local_plane import LocalPlane

PLANE = LocalPlane(8.4, 49.0)


def line(points, kind=ElementKind.DIVIDER):
    return MapElement(kind, np.array(points, dtype=float), 0.9, 8, 10**18, 10**18 + 1)


def write(path, *elements, plane=PLANE):
    write_map(GlobalMap(elements), path, plane)
    return path


def test_the_table_and_the_file_say_what_changed(predmapnet, tmp_path):
    kerb = line([[0, 0], [150, 0], [150, 90]], ElementKind.BOUNDARY)
    paint = line([[0, 3.5], [80, 3.5]])
    old = write(tmp_path / "old.geojson", kerb, paint)
    new = write(tmp_path / "new.geojson", kerb)
    result = predmapnet("diff", old, new, "--out", "diff.geojson")
    assert result.code == 0, result.err
    assert "80 (1)" in result.out
    assert "unobserved" in result.out
    features = json.loads((tmp_path / "diff.geojson").read_text())["features"]
    found = {(f["properties"]["change"], f["properties"]["kind"]): f["properties"] for f in features}
    assert abs(found["removed", "divider"]["length_m"] - 80) < 1
    assert ("unchanged", "boundary") in found


def test_mistakes_are_one_message(predmapnet, tmp_path):
    here = write(tmp_path / "here.geojson", line([[0, 0], [50, 0]]))
    far = write(tmp_path / "far.geojson", line([[0, 0], [50, 0]]), plane=LocalPlane(-71.0, 42.3))
    (tmp_path / "broken.geojson").write_text('{"type": "FeatureCollection", "features": [{"type": "Feature"}]}')
    projected = (tmp_path / "here.geojson").read_text().replace("[8.4", "[508.4")
    (tmp_path / "projected.geojson").write_text(projected)
    for arguments, message in (
        ((here, tmp_path / "projected.geojson"), "not longitude and latitude"),
        ((here, far), "not of one city"),
        ((here, tmp_path / "broken.geojson"), "feature 0"),
        ((here, tmp_path / "none.geojson"), "no such file"),
        ((here, tmp_path / "map.shp"), "no map format"),
    ):
        result = predmapnet("diff", *arguments)
        assert result.code == 2
        assert message in result.err
        assert "Traceback" not in result.err
