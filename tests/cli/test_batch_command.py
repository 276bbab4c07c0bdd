"""``predmapnet batch``: many scenes, failures by name, and the same maps however often it was interrupted."""

import json
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from predmapnet.runs.batch import BatchSettings
from predmapnet.runs.output_folder import OutputFolder
from predmapnet.runs.scene_choice import ListedScene
from tests.cli.tiny_nuscenes import image_path, write_tiny_nuscenes

SCENES = ("scene-0001", "scene-0002", "scene-0003", "scene-0004")


@pytest.fixture
def data(tmp_path) -> Path:
    return write_tiny_nuscenes(tmp_path / "data", SCENES, frames=4)


def settings(data: Path, weights: Path) -> list[str]:
    return ["--data-root", str(data), "--weights", str(weights)]


def without_time(path: Path) -> str:
    return re.sub(r'"created":"[^"]*"', "", path.read_text())


def log_lines(folder: Path) -> list[dict]:
    return [json.loads(line) for line in (folder / "log.jsonl").read_text().splitlines()]


def alive(group: int) -> bool:
    try:
        os.killpg(group, 0)
    except ProcessLookupError:
        return False
    return True


def test_after_sigkill_the_rest_is_mapped_and_the_maps_are_the_same(predmapnet, data, random_weights, tmp_path):
    reference = tmp_path / "reference"
    reference.mkdir()
    for scene in SCENES:
        command = ("infer", scene, "--out", reference / f"{scene}.geojson")
        assert predmapnet(*command, *settings(data, random_weights)).code == 0

    out = tmp_path / "maps"
    arguments = ["batch", "--out", str(out), "--jobs", "2", *settings(data, random_weights)]
    command = [sys.executable, "-m", "cli.main", *arguments]
    with subprocess.Popen(command, stderr=subprocess.DEVNULL, start_new_session=True) as process:
        deadline = time.monotonic() + 300
        while not list(out.glob("*.summary.json")) and process.poll() is None and time.monotonic() < deadline:
            time.sleep(0.01)
        process.send_signal(signal.SIGKILL)
    done_before = {path.name.split(".")[0] for path in out.glob("*.summary.json")}
    while alive(process.pid) and time.monotonic() < deadline:
        time.sleep(0.05)
    assert not alive(process.pid), "workers should end when their parent is gone"

    result = predmapnet(*arguments)
    assert result.code == 0, result.err
    summary = json.loads((out / "summary.json").read_text())
    status = {scene["scene"]: scene["status"] for scene in summary["scenes"]}
    assert set(status) == set(SCENES)
    assert done_before <= {scene for scene, how in status.items() if how == "done before"}
    for scene in SCENES:
        assert without_time(out / f"{scene}.geojson") == without_time(reference / f"{scene}.geojson")
    assert not [path for path in out.iterdir() if ".part" in path.name]


def test_a_failed_scene_is_listed_with_its_reason_and_tried_again(predmapnet, data, random_weights, tmp_path):
    broken = image_path(data, "scene-0002", 1, "CAM_FRONT")
    whole = broken.read_bytes()
    broken.write_bytes(whole[:1000])
    arguments = ["batch", "scene-0001", "scene-0002", "--out", "maps", *settings(data, random_weights)]
    first = predmapnet(*arguments)
    assert first.code == 1
    assert "scene-0002  FAILED" in first.err
    assert "cut short" in first.err
    assert "1 of 2 scenes are done" in first.out
    out = tmp_path / "maps"
    failure = json.loads((out / "scene-0002.failed.json").read_text())
    assert failure["error"] == "UserError"
    assert "cut short" in failure["reason"]
    assert sorted(path.name for path in out.glob("*.geojson")) == ["scene-0001.geojson"]
    assert {line["scene"]: line["status"] for line in log_lines(out)} == {"scene-0001": "done", "scene-0002": "failed"}

    broken.write_bytes(whole)
    second = predmapnet(*arguments)
    assert second.code == 0
    assert [line["status"] for line in log_lines(out)][2:] == ["done before", "done"]
    assert not (out / "scene-0002.failed.json").exists()


def test_a_manifest_names_scenes_of_several_folders_and_the_summary_keeps_all_of_them(
    predmapnet, data, random_weights, tmp_path
):
    write_tiny_nuscenes(tmp_path / "other", ("scene-0007",), frames=2)
    image_path(tmp_path / "other", "scene-0007", 1, "CAM_BACK").unlink()
    (tmp_path / "list.csv").write_text("scene,folder\nscene-0001,data\nscene-0007,other\nscene-0009,other\n")
    result = predmapnet("batch", "list.csv", "--out", "maps", "--weights", random_weights, "--allow-missing-cameras")
    assert result.code == 1
    assert "scene-0009" in result.err
    (line,) = (line for line in result.err.splitlines() if "scene-0007  " in line)
    assert "Images are missing (CAM_BACK in 1 of 2 frames)" in line
    again = predmapnet("batch", "scene-*2", "--out", "maps", "--json", *settings(data, random_weights))
    assert again.code == 0, again.err
    told = json.loads(again.out)
    assert (told["scenes"], told["done"], told["failed"], told["frames"]) == (1, 1, 0, 4)
    assert [Path(file).name for file in told["written"]] == ["summary.json", "report.html"]
    assert sorted(path.stem for path in (tmp_path / "maps").glob("*.geojson")) == [
        "scene-0001",
        "scene-0002",
        "scene-0007",
    ]
    summary = json.loads((tmp_path / "maps" / "summary.json").read_text())
    assert summary["counts"] == {"done before": 2, "done": 1, "failed": 1}
    assert {scene["scene"]: scene["status"] for scene in summary["scenes"]} == {
        "scene-0001": "done before",
        "scene-0002": "done",
        "scene-0007": "done before",
        "scene-0009": "failed",
    }


def test_wrong_scenes_and_folders_are_told_before_the_work(predmapnet, data, random_weights, tmp_path):
    unknown = predmapnet("batch", "scene-0009", "--out", "maps", *settings(data, random_weights))
    assert unknown.code == 2
    assert "scene-000" in unknown.err
    (tmp_path / "file").write_text("")
    blocked = predmapnet("batch", "--out", "file/maps", *settings(data, random_weights))
    assert blocked.code == 2
    assert "cannot make the folder" in blocked.err
    empty = predmapnet("batch", "--split", "train", "--out", "maps", *settings(data, random_weights))
    assert empty.code == 2
    degrees = predmapnet("batch", "--out", "maps", "--crs", "EPSG:32632", *settings(data, random_weights))
    assert degrees.code == 2
    assert "RFC 7946" in degrees.err
    for name in ("osm", "shp"):
        assert predmapnet("batch", "--out", "maps", "--format", name, *settings(data, random_weights)).code == 2


def test_maps_of_another_format_are_made_again():
    plain, projected = BatchSettings("demo", None), BatchSettings("demo", None, map_suffix=".gpkg", crs="EPSG:32632")
    outputs = projected.outputs("scene-0001", Path("maps"))
    assert (outputs.map, outputs.crs) == (Path("maps/scene-0001.gpkg"), "EPSG:32632")
    scene = ListedScene("scene-0001", None)
    assert plain.fingerprint(scene) != projected.fingerprint(scene)


def test_maps_go_to_an_object_store_and_what_is_there_is_not_made_again(predmapnet, data, random_weights, bucket):
    out = f"{bucket}/maps"
    arguments = ["batch", "scene-0001", "--out", out, "--jobs", "1", *settings(data, random_weights)]
    assert predmapnet(*arguments).code == 0
    folder = OutputFolder(out)
    assert folder.names() == {"scene-0001.geojson", "scene-0001.summary.json", "summary.json", "report.html"}
    again = predmapnet(*arguments)
    assert again.code == 0
    assert "1 of them done before" in again.err
    page = dict(folder.read(["report.html"]))["report.html"].decode()
    assert 'href="scene-0001.geojson"' in page
