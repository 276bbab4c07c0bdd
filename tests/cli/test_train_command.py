"""``predmapnet train``: the plan, and mistakes that are told before anything is made."""

import json
import re

from tests.cli.tiny_nuscenes import write_tiny_nuscenes


def test_a_dry_run_prints_the_plan_and_makes_nothing(predmapnet, tmp_path):
    plan = predmapnet("train", "--dry-run", "--towns", "100", "--devices", "2", "--batch", "12", "--seed", "3")
    assert plan.code == 0
    said = " ".join(plan.out.split())
    assert "lite, 4000 frames" in said
    single = next(line for line in plan.out.splitlines() if "single" in line)
    assert all(part in single for part in ("24", str(24 * (4000 // 12)), "0.00141", "GiB"))
    unbroken = "".join(plan.out.split())
    assert re.search(r"cacheof2\d{4}imagesin\S+takesabout0\.[3-6]GB", unbroken)
    told = json.loads(predmapnet("train", "--dry-run", "--towns", "100", "--batch", "12", "--json").out)
    assert [stage["stage"] for stage in told["stages"]] == ["single", "temporal"]
    assert not (tmp_path / "runs").exists() and not (tmp_path / "cache" / "training").exists()


def test_mistakes_are_told_before_anything_is_made(predmapnet, tmp_path):
    for arguments, says in (
        (("--batch", "5", "--devices", "2", "--dry-run"), "cannot be shared out to 2 processes"),
        (("--preset", "paper-nuscenes", "--minutes", "10", "--dry-run"), "--minutes is for lite"),
        (("--stage", "joint"), "no stage 'joint' for this network"),
        (("--stage", "temporal"), "needs a network that sees"),
    ):
        result = predmapnet("train", *arguments)
        assert result.code != 0
        assert says in " ".join(result.err.split())
    assert not (tmp_path / "runs").exists()


def test_a_data_set_is_learned_and_what_is_finished_stays_so(predmapnet, tmp_path):
    root = write_tiny_nuscenes(tmp_path / "data", ("scene-0001", "scene-0003"), frames=4)
    data = ("--data", "nuscenes", "--data-root", root, "--out", "run")
    arguments = ("train", *data, "--steps", "1", "--batch", "2", "--devices", "1")
    first = predmapnet(*arguments)
    assert first.code == 0, first.err
    assert "weights are in run/weights.safetensors" in " ".join(first.out.split())
    lines = [json.loads(line) for line in (tmp_path / "run" / "metrics.jsonl").read_text().splitlines()]
    assert [(line["stage"], line["frames"]) for line in lines if "loss" in line] == [("single", 2), ("temporal", 6)]
    assert "holds a run already" in " ".join(predmapnet(*arguments).err.split())
    again = predmapnet(*arguments, "--resume", "--json")
    assert (again.code, json.loads(again.out)["written"]) == (0, ["run/weights.safetensors"])
    assert "Nothing to train" in again.err and "Nothing to train" not in first.out + first.err
    assert len((tmp_path / "run" / "metrics.jsonl").read_text().splitlines()) == len(lines)
