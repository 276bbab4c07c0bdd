"""All commands: quick help, the version and error messages; and the output of view and scenes."""

import json
import subprocess
import sys
from pathlib import Path

import predmapnet as package
from cli.console import say_error

HEAVY = ("torch", "numba", "rerun", "cv2", "shapely", "pyarrow", "scipy", "numpy")


def test_help_needs_nothing_heavy():
    code = "import sys, cli.main; print([name for name in sys.argv[1:] if name in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code, *HEAVY], capture_output=True, text=True, check=True, timeout=300)
    assert done.stdout.strip() == "[]"


def test_help_and_version(predmapnet):
    help_ = predmapnet("--help")
    assert help_.code == 0
    for command in ("infer", "view", "batch", "scenes", "evaluate", "train"):
        assert command in help_.out
    assert predmapnet("--version").out == f"predmapnet {package.__version__}\n"


def test_a_wrong_option_is_one_message(predmapnet):
    result = predmapnet("infer", "scene-0001", "--oout", "map.geojson")
    assert result.code == 2
    assert "--oout" in result.err
    assert "Traceback" not in result.err


def test_scenes_are_listed_as_a_table_and_as_json(predmapnet, tiny_root):
    table = predmapnet("scenes", "--data-root", tiny_root)
    assert table.code == 0
    assert "scene-0002" in table.out
    found = json.loads(predmapnet("scenes", "--json", "--data-root", tiny_root).out)
    assert [scene["name"] for scene in found] == ["scene-0001", "scene-0002"]
    assert found[0]["frames"] == 3


def test_the_demo_world_is_listed_without_any_configuration(predmapnet):
    result = predmapnet("scenes", "--split", "test", "--json")
    names = [scene["name"] for scene in json.loads(result.out)]
    assert "scene-0103" in names
    assert len(names) == 10


def test_without_a_display_a_scene_is_recorded_and_view_says_how_to_look(
    predmapnet, tiny_root, random_weights, tmp_path, monkeypatch
):
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    settings = ("--data-root", tiny_root, "--weights", random_weights, "--threads", 1)
    result = predmapnet("view", "scene-0001", *settings)
    assert result.code == 0, result.err
    assert (tmp_path / "scene-0001.rrd").exists()
    assert "predmapnet view scene-0001.rrd --web" in result.out
    again = predmapnet("view", "scene-0001.rrd")
    assert again.code == 0
    assert "--web" in again.out


def test_a_map_can_be_looked_at_and_a_broken_one_is_told(predmapnet, tiny_root, random_weights, tmp_path):
    settings = ("--data-root", tiny_root, "--weights", random_weights, "--threads", 1)
    assert predmapnet("infer", "scene-0001", "--out", "map.geojson", *settings).code == 0
    seen = predmapnet("view", "map.geojson", "--out", "map.rrd", "--json")
    assert (seen.code, json.loads(seen.out)) == (0, {"written": ["map.rrd"], "notes": []})
    assert json.loads(predmapnet("report", "map.geojson", "--out", "r.html", "--json").out) == {"written": ["r.html"]}
    for options in (("map.rrd", "--out", "copy.rrd"), ("maps", "--json")):
        assert predmapnet("view", *options).code == 2
    assert not Path("copy.rrd").exists()
    verify = [sys.executable, "-m", "rerun", "rrd", "verify", tmp_path / "map.rrd"]
    assert subprocess.run(verify, timeout=300, capture_output=True).returncode == 0
    Path("broken.geojson").write_text("{")
    assert "give one of them" in predmapnet("view", "broken.geojson", "--web", "--out", "x.rrd").err
    assert predmapnet("view", "map.geojson", "--out", "map.mp4").code == 2
    assert predmapnet("view", "map.geojson", "map.geojson", "--out", "changes.rrd").code == 0
    Path("maps").mkdir()
    assert "no map in the folder maps" in predmapnet("view", "maps").err
    Path("maps/one.gpkg").write_bytes(b"")
    assert "maps/one.gpkg" in predmapnet("view", "maps", "--out", "maps.rrd").err
    assert "scene-0001 is no map" in predmapnet("view", "scene-0001", "map.geojson").err
    broken = predmapnet("view", "broken.geojson", "--out", "map.rrd")
    assert broken.code == 2
    assert "broken.geojson" in broken.err
    assert predmapnet("view", "nothing.rrd").code == 2


def test_names_from_data_cannot_write_to_the_terminal(capsys):
    say_error("no scene 'a\x1b[2J\u202e[bold]'\nNext line.")
    assert capsys.readouterr().err == "Error: no scene 'a\\x1b[2J\\u202e[bold]'\nNext line.\n"
