"""The commands on logs and files of other people: mapped where that is right, and told what was wrong."""

from __future__ import annotations

import json

import pytest

from mapfusion.formats.by_suffix import read_map, read_maps


def edit(root, table, change):
    (path,) = root.glob(f"v1.0-*/{table}.json")
    path.write_text(json.dumps(change(json.loads(path.read_text()))))


def set_location(root, name):
    edit(root, "log", lambda records: [record | {"location": name} for record in records])


@pytest.fixture
def infer(predmapnet, random_weights, tiny_root):
    def run(*options):
        return predmapnet(
            "infer", "scene-0001", "--data-root", tiny_root, "--weights", random_weights, "--threads", 1, *options
        )

    return run


def test_a_log_of_an_unknown_place_is_mapped_in_a_local_frame_or_where_the_user_says(infer, tiny_root, tmp_path):
    infer("--out", "known.geojson")
    set_location(tiny_root, "my-town")
    result = infer("--out", "local.geojson")
    assert result.code == 0
    assert "my-town" in result.err
    assert "--origin" in result.err
    local = read_map(tmp_path / "local.geojson")
    assert local.provenance["local_frame"] == "my-town"
    assert "not known" in local.provenance["georeference"]
    assert len(local) == len(read_map(tmp_path / "known.geojson"))
    assert infer("--out", "placed.geojson", "--origin", "49.0,8.4").code == 0
    (placed,), plane = read_maps([tmp_path / "placed.geojson"])
    assert len(placed) == len(local)
    assert abs(plane.latitude - 49.0) < 0.05
    assert abs(plane.longitude - 8.4) < 0.05
    assert infer("--out", "wrong.geojson", "--origin", "8.4").code == 2


def test_ground_truth_never_decides_over_the_map(infer, tiny_root, tmp_path):
    (path,) = (tiny_root / "maps" / "expansion").glob("*.json")
    content = json.loads(path.read_text())
    content["node"][0]["x"] = float("nan")
    path.write_text(json.dumps(content))
    result = infer("--out", "map.geojson", "--recording", "map.rrd")
    assert result.code == 0
    assert "could not be compared with the ground truth" in result.err
    assert len(read_map(tmp_path / "map.geojson"))
    assert (tmp_path / "map.rrd").is_file()


def test_a_missing_image_and_other_cameras_are_named(infer, tiny_root):
    lost = sorted((tiny_root / "samples" / "CAM_FRONT").iterdir())[0]
    lost.unlink()
    result = infer("--out", "map.geojson")
    assert result.code == 2
    assert lost.name in result.err
    edit(
        tiny_root, "sensor", lambda records: [r | {"channel": r["channel"].replace("CAM_", "KAMERA_")} for r in records]
    )
    result = infer("--out", "map.geojson")
    assert result.code == 2
    assert "KAMERA_FRONT" in result.err
    assert "CAM_FRONT" in result.err


def test_times_in_another_unit_are_no_empty_map(infer, tiny_root):
    edit(tiny_root, "sample", lambda records: [r | {"timestamp": r["timestamp"] // 1000} for r in records])
    result = infer("--out", "map.geojson")
    assert result.code == 2
    assert "milliseconds" in result.err


def test_batch_writes_no_file_outside_of_its_folder(predmapnet, random_weights, tiny_root, tmp_path):
    edit(tiny_root, "scene", lambda records: [records[0] | {"name": "../outside"}, records[1] | {"name": "../outside"}])
    before = {path for path in tmp_path.rglob("*") if tmp_path / "maps" not in path.parents}
    result = predmapnet("batch", "--data-root", tiny_root, "--weights", random_weights, "--out", "maps")
    assert result.code == 0, result.err
    after = {path for path in tmp_path.rglob("*") if tmp_path / "maps" not in path.parents}
    assert after - before <= {tmp_path / "maps"}
    assert len(list((tmp_path / "maps").glob("*.geojson"))) == 2


@pytest.mark.parametrize(
    "options",
    [
        ("--out", "m.geojson", "--recording", "x.txt"),
        ("--out", "m.geojson", "--save-frames", "x.csv"),
    ],
)
def test_an_ending_that_stands_for_another_format_is_refused(infer, options):
    result = infer(*options)
    assert result.code == 2
    assert "can be written there" in result.err


def test_diff_writes_geojson_only_and_view_opens_every_format(infer, predmapnet, tmp_path):
    assert infer("--out", "m.gpkg").code == 0
    assert predmapnet("diff", "m.gpkg", "m.gpkg", "--out", "changes.gpkg").code == 2
    assert predmapnet("view", "m.gpkg", "--out", "v.rrd").code == 0
    assert (tmp_path / "v.rrd").stat().st_size > 0


def test_what_the_reader_changed_is_printed(infer, predmapnet, tmp_path):
    assert infer("--out", "m.geojson").code == 0
    document = json.loads((tmp_path / "m.geojson").read_text())
    for feature in document["features"]:
        feature["properties"]["confidence"] = None
    (tmp_path / "edited.geojson").write_text(json.dumps(document))
    assert "drawn by hand" in predmapnet("diff", "m.geojson", "edited.geojson").err
    assert "drawn by hand" in predmapnet("merge", "m.geojson", "edited.geojson", "--out", "o.geojson").err


def test_scenes_tells_logs_without_images_from_towns_that_are_yet_to_be_drawn(predmapnet, tiny_root):
    assert "drawn when used" not in predmapnet("scenes", "--data-root", tiny_root).out
    assert "drawn when used" in predmapnet("scenes", "--dataset", "demo", "--split", "test").out
