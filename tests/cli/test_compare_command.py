"""``predmapnet compare``: evaluations of the real command side by side."""

import json

from predmapnet.frame_files.parquet import write_frames
from tests.cli.test_evaluate_command import stored, truth_as_results


def test_two_evaluations_side_by_side(predmapnet, tiny_root, tmp_path, monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")
    _, maps = truth_as_results(tiny_root, "scene-0001")
    for name, found in (("truth", maps), ("half", [frame_map.select(frame_map.kinds > 1) for frame_map in maps])):
        write_frames(tmp_path / f"{name}.parquet", stored(found, "scene-0001"), {})
        arguments = ["evaluate", f"{name}.parquet", "--data-root", tiny_root, "--json", f"{name}.json"]
        assert predmapnet(*arguments).code == 0
    result = predmapnet("compare", "truth.json", "half.json")
    assert result.code == 0, result.err
    assert "chamfer mAP" in result.out and "truth" in result.out and "half" in result.out
    assert "1 scene only" in result.err and "of the 2 scenes of the split" in " ".join(result.err.split())
    assert max(map(len, result.out.splitlines())) <= 80
    content = json.loads(predmapnet("compare", "truth.json", "half.json", "--json", "--seed", 3).out)
    assert content["methods"] == ["truth", "half"] and content["seed"] == 3
    assert content["figures"]["chamfer_mAP"]["truth"]["mean"] == 1.0
    assert content["figures"]["chamfer_mAP"]["half"]["difference"] < 0.0


def test_an_evaluation_of_an_older_version_says_what_to_do(predmapnet, tmp_path):
    old = {"evaluated": {"version": "0.0.9", "dataset": "demo"}, "scenes": 1, "chamfer_ap": {"mAP": 0.5}}
    for name in ("a.json", "b.json"):
        (tmp_path / name).write_text(json.dumps(old))
    result = predmapnet("compare", "a.json", "b.json")
    assert result.code == 2 and result.err.count("Error:") == 1
    assert "evaluate --json' again" in " ".join(result.err.split())


def test_the_help_is_whole_at_80_columns(predmapnet, monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")
    for command in ("compare", "evaluate"):
        told = predmapnet(command, "--help").out
        assert max(map(len, told.splitlines())) <= 80 and "…" not in told, told
