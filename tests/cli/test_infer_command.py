"""``predmapnet infer`` as a user meets it: the map, its files, and every mistake with one message."""

import json
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import pyarrow.parquet as pq
import pytest
import torch
from rerun.chunk import RrdReader

from mapfusion.formats.by_suffix import read_map
from predmapnet.datasets.nuscenes_tables import NUSCENES_CAMERAS
from predmapnet.network.predmapnet import PredMapNet
from predmapnet.presets import preset
from predmapnet.weights.checkpoint import save_checkpoint
from predmapnet.weights.files import weights_hash
from tests.cli.tiny_nuscenes import edit_table, image_path, write_tiny_nuscenes
from tests.interrupts import heed_interrupts
from tests.predmapnet.small_networks import small_config


@pytest.fixture
def infer(predmapnet, random_weights, tiny_root):
    def run(*arguments):
        settings = ("--data-root", tiny_root, "--weights", random_weights, "--threads", 1)
        return predmapnet("infer", *arguments, *settings)

    return run


def leftovers(folder: Path) -> list[str]:
    return [path.name for path in folder.rglob("*") if ".part" in path.name]


def mapping_began(folder: Path) -> bool:
    return any(path.stat().st_size > 100_000 for path in folder.glob(".*.part.rrd"))


def without_time(path: Path) -> str:
    return re.sub(r'"created":"[^"]*"', "", path.read_text())


def test_a_scene_becomes_a_map_a_recording_and_a_table_of_frames(infer, tmp_path):
    result = infer("scene-0001", "--out", "map.geojson", "--recording", "r.rrd", "--save-frames", "f.parquet")
    assert result.code == 0, result.err
    assert "Using nuscenes" in result.err
    assert "3 frames in" in result.out
    assert "against the ground truth: mAP" in result.out
    document = json.loads((tmp_path / "map.geojson").read_text())
    assert document["features"], "the random network should find something"
    provenance = document["predmapnet"]
    assert provenance["scene"] == "scene-0001"
    assert provenance["dataset"] == "nuscenes"
    assert provenance["synthetic"] is False
    assert len(provenance["weights_sha256"]) == 64
    assert provenance["precision"] == "float32"
    assert provenance["compiled"] is False
    assert provenance["engine"] == "torch"
    assert str(tmp_path) not in json.dumps(provenance)
    assert pq.read_table(tmp_path / "f.parquet").num_rows == 3
    entities = {chunk.entity_path for chunk in RrdReader(tmp_path / "r.rrd").stream()}
    assert {"/world/ego_vehicle", "/world/ego_vehicle/CAM_FRONT", "/world/ego_vehicle/tracks/divider"} <= entities
    assert any(entity.startswith("/world/map/") for entity in entities)
    assert leftovers(tmp_path) == []


def test_json_tells_other_programs_what_the_table_tells_people(infer, tmp_path):
    result = infer("scene-0001", "--out", "map.geojson", "--json")
    assert result.code == 0, result.err
    told = json.loads(result.out)
    assert told["scene"] == "scene-0001"
    assert told["frames"] == 3
    assert sum(told["elements"].values()) == len(read_map(tmp_path / "map.geojson"))
    assert told["written"] == ["map.geojson"]


def test_an_empty_map_is_said_and_written_down(predmapnet, tiny_root, tmp_path):
    config = preset("lite")
    sure = config.tracking.model_copy(update={"tau_d": 0.999, "tau_t": 0.999})
    save_checkpoint(tmp_path / "w.safetensors", PredMapNet(config.model_copy(update={"tracking": sure})))
    options = ("--data-root", tiny_root, "--weights", "w.safetensors", "--threads", 1)
    result = predmapnet("infer", "scene-0001", "--out", "map.geojson", "--save-frames", "f.parquet", *options)
    assert result.code == 0, result.err
    assert "The map is empty" in result.err
    found = read_map(tmp_path / "map.geojson")
    assert len(found) == 0
    assert "The map is empty" in found.provenance["note"]
    again = predmapnet("integrate", "f.parquet", "--out", "again.geojson")
    assert "The map is empty" in again.err
    assert "The map is empty" in read_map(tmp_path / "again.geojson").provenance["note"]


def test_a_map_in_bfloat16_says_so(infer, tmp_path):
    result = infer("scene-0001", "--out", "map.geojson", "--precision", "bfloat16")
    assert result.code == 0, result.err
    found = read_map(tmp_path / "map.geojson")
    assert found.provenance["precision"] == "bfloat16"
    assert infer("scene-0001", "--out", "map.geojson", "--precision", "int4").code == 2


def test_weights_of_maptrackers_kind_map_a_scene_too(predmapnet, tiny_root, tmp_path):
    config = small_config("paper-nuscenes", bev={"cameras": NUSCENES_CAMERAS}, tracking={"tau_d": 0.01, "tau_t": 0.01})
    torch.manual_seed(0)
    save_checkpoint(tmp_path / "w.safetensors", PredMapNet(config), {"untrained": ["mask_head"], "seed": 0})
    arguments = ("infer", "scene-0001", "--data-root", tiny_root, "--threads", 1, "--out", "map.geojson")
    result = predmapnet(*arguments, "--weights", "w.safetensors", "--recording", "r.rrd", "--save-frames", "f.parquet")
    assert result.code == 0, result.err
    assert "have not been trained yet (mask_head)" in " ".join(result.err.split())
    provenance = read_map(tmp_path / "map.geojson").provenance
    assert provenance["configuration"] == json.loads(config.to_json())
    assert provenance["weights_sha256"] == weights_hash(tmp_path / "w.safetensors")
    assert "not been trained yet" in provenance["note"]
    assert pq.read_table(tmp_path / "f.parquet").num_rows == 3
    assert leftovers(tmp_path) == []

    others = small_config("paper-nuscenes", bev={"cameras": ("front", "back")})
    save_checkpoint(tmp_path / "others.safetensors", PredMapNet(others))
    result = predmapnet(*arguments, "--weights", "others.safetensors")
    assert result.code == 2
    said = " ".join(result.err.split())
    assert "each of 2 cameras (front, back), but this car has CAM_FRONT, " in said


def test_the_same_command_twice_writes_the_same_bytes_but_for_the_time(infer, tmp_path):
    assert infer("scene-0001", "--out", "first.geojson").code == 0
    assert infer("scene-0001", "--out", "second.geojson").code == 0
    assert without_time(tmp_path / "first.geojson") == without_time(tmp_path / "second.geojson")


def test_an_existing_map_is_replaced_only_by_a_whole_one(infer, tmp_path, tiny_root):
    (tmp_path / "map.geojson").write_text("old")
    image_path(tiny_root, "scene-0001", 2, "CAM_BACK").write_bytes(b"")
    assert infer("scene-0001", "--out", "map.geojson").code == 2
    assert (tmp_path / "map.geojson").read_text() == "old"


def test_an_unknown_scene_offers_the_nearest_names(infer):
    result = infer("scene-0011", "--out", "map.geojson")
    assert result.code == 2
    assert "scene-0001" in result.err
    assert "Traceback" not in result.err


@pytest.mark.parametrize(
    ("out", "words"),
    [
        ("nowhere/map.geojson", "does not exist"),
        (".", "folder"),
        ("file/map.geojson", "not a folder"),
    ],
)
def test_a_wrong_output_is_told_before_the_work_begins(infer, tmp_path, out, words):
    (tmp_path / "file").write_text("")
    result = infer("no-such-scene", "--out", out)
    assert result.code == 2
    assert words in result.err
    assert "no-such-scene" not in result.err


def test_two_outputs_may_not_have_one_name(infer):
    result = infer("scene-0001", "--out", "map.rrd", "--recording", "./map.rrd")
    assert result.code == 2
    assert "same name" in result.err


def test_a_missing_data_set_is_an_error_and_no_fallback(predmapnet, tmp_path, random_weights):
    nowhere = tmp_path / "nowhere"
    result = predmapnet(
        "infer", "scene-0103", "--out", "m.geojson", "--data-root", nowhere, "--weights", random_weights
    )
    assert result.code == 2
    assert str(nowhere) in result.err
    assert not (tmp_path / "m.geojson").exists()


def test_missing_weights_are_named(predmapnet, tiny_root):
    result = predmapnet(
        "infer", "scene-0001", "--out", "m.geojson", "--data-root", tiny_root, "--weights", "w.safetensors"
    )
    assert result.code == 2
    assert "w.safetensors" in result.err


def test_a_truncated_image_is_named_and_leaves_no_file(infer, tiny_root, tmp_path):
    broken = image_path(tiny_root, "scene-0001", 1, "CAM_FRONT")
    broken.write_bytes(broken.read_bytes()[:2000])
    result = infer("scene-0001", "--out", "map.geojson", "--recording", "r.rrd", "--save-frames", "f.parquet")
    assert result.code == 2
    assert str(broken) in result.err
    assert "cut short" in result.err
    assert not list(tmp_path.glob("map.geojson")) + list(tmp_path.glob("r.rrd")) + list(tmp_path.glob("f.parquet"))
    assert leftovers(tmp_path) == []


def test_a_missing_camera_stops_unless_allowed(infer, tiny_root):
    image_path(tiny_root, "scene-0001", 1, "CAM_BACK_LEFT").unlink()
    stopped = infer("scene-0001", "--out", "map.geojson")
    assert stopped.code == 2
    assert "CAM_BACK_LEFT" in stopped.err
    assert "--allow-missing-cameras" in stopped.err
    allowed = infer("scene-0001", "--out", "map.geojson", "--recording", "r.rrd", "--allow-missing-cameras")
    assert allowed.code == 0, allowed.err


def test_a_pose_that_is_not_a_number_is_named(infer, tiny_root):
    def spoil(records):
        records[1]["translation"][0] = float("nan")

    edit_table(tiny_root, "ego_pose", spoil)
    result = infer("scene-0001", "--out", "map.geojson")
    assert result.code == 2
    assert "frame 1" in result.err
    assert "ego_pose" in result.err


def test_a_full_disk_is_one_message_and_no_half_written_file(tiny_root, random_weights, tmp_path):
    """The process may write no file beyond 100 kB: the recording (about 1 MB) does not fit."""
    folder = tmp_path / "small"
    folder.mkdir()
    code = (
        "import resource, signal; signal.signal(signal.SIGXFSZ, signal.SIG_IGN);"
        "resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, 100_000)); from cli.main import main; main()"
    )
    settings = ["--data-root", str(tiny_root), "--weights", str(random_weights), "--threads", "1"]
    command = ["infer", "scene-0001", "--out", f"{folder}/map.geojson", "--recording", f"{folder}/r.rrd"]
    done = subprocess.run(
        [sys.executable, "-c", code, *command, *settings], capture_output=True, text=True, timeout=300
    )
    assert done.returncode == 2, done.stderr
    assert "r.rrd" in done.stderr
    assert done.stderr.count("Error:") == 1
    assert "Traceback" not in done.stderr
    assert not (folder / "r.rrd").exists()
    assert leftovers(folder) == []


@pytest.mark.skipif(sys.platform != "linux", reason="needs a folder that nobody may write to: /proc")
def test_a_folder_that_cannot_be_written_to_is_told_first(infer):
    result = infer("no-such-scene", "--out", "/proc/map.geojson")
    assert result.code == 2
    assert "cannot write /proc/map.geojson" in result.err
    assert "no-such-scene" not in result.err


def test_ctrl_c_says_one_line_and_leaves_nothing(random_weights, tmp_path):
    root = write_tiny_nuscenes(tmp_path / "long", frames=60)
    folder = tmp_path / "out"
    folder.mkdir()
    command = [sys.executable, "-m", "cli.main", "infer", "scene-0001", "--out", folder / "map.geojson"]
    settings = ["--recording", folder / "r.rrd", "--data-root", root, "--weights", random_weights, "--threads", "1"]
    with subprocess.Popen(
        [*command, *settings], stderr=subprocess.PIPE, text=True, preexec_fn=heed_interrupts
    ) as process:
        deadline = time.monotonic() + 300
        while not mapping_began(folder) and process.poll() is None and time.monotonic() < deadline:
            time.sleep(0.05)
        process.send_signal(signal.SIGINT)
        _, said = process.communicate(timeout=300)
    assert process.returncode == 130
    assert said.count("stopped") == 1
    assert "Traceback" not in said
    assert list(folder.iterdir()) == []


@pytest.mark.parametrize("name", ["map.gpkg", "map.fgb", "map.osm"])
def test_the_ending_chooses_the_format(infer, tmp_path, name):
    assert infer("scene-0001", "--out", name).code == 0
    assert infer("scene-0001", "--out", "map.geojson").code == 0
    written, expected = read_map(tmp_path / name), read_map(tmp_path / "map.geojson")
    assert len(written) == len(expected) > 0
    for one, two in zip(written, expected, strict=True):
        assert one.kind is two.kind
        assert abs(one.length - two.length) < 0.01
    assert written.provenance["observed"] == expected.provenance["observed"]
    assert len(written.provenance["observed"][0]) >= 5


def test_an_unknown_ending_is_told_before_the_work_begins(infer):
    result = infer("no-such-scene", "--out", "map.shp")
    assert result.code == 2
    assert "stands for no map format" in result.err
