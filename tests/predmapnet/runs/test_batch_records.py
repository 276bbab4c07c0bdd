"""Records of a batch: what counts as done, what the summary says, and on what a map depends."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest

from mapfusion.formats.local_plane import LocalPlane
from predmapnet.errors import UserError
from predmapnet.machine import NetworkOptions, Precision
from predmapnet.runs.batch import BatchSettings, _map_scene
from predmapnet.runs.batch_records import (
    DONE,
    Outcome,
    done_before,
    forget_records,
    log_outcome,
    outcomes_in,
    write_done,
    write_failed,
    write_summary,
)
from predmapnet.runs.output_folder import OutputFolder
from predmapnet.runs.scene_choice import ListedScene

REPORT = {"frames": 3, "seconds": 1.0, "frames_per_second": 3.0, "elements": {"divider": 1}, "metres": {"divider": 9.0}}
REPORT |= {"rejections": {}}


@pytest.fixture
def folder(tmp_path) -> OutputFolder:
    found = OutputFolder(str(tmp_path))
    for name in ("one", "two"):
        (tmp_path / f"{name}.geojson").write_text("{}")
        write_done(found, name, "same", 2.0, REPORT | {"scene": name})
    write_failed(found, Outcome("bad", "failed", 1.0, error="KeyError", reason="x", trace="Traceback"))
    return found


def done(folder: OutputFolder, *files: str, fingerprint: str = "same") -> set[str]:
    wanted = {name + DONE: (name, fingerprint, [f"{name}.geojson", *files]) for name in ("one", "two", "bad", "new")}
    return set(done_before(folder, wanted, folder.names()))


def test_done_is_what_has_its_record_its_files_and_the_same_settings(folder, tmp_path):
    assert done(folder) == {"one", "two"}
    assert done(folder, fingerprint="other") == set()
    assert done(folder, "one.rrd") == set()
    (tmp_path / "one.geojson").unlink()
    assert done(folder) == {"two"}
    (tmp_path / f"two{DONE}").write_text('{"scene": "two", "sett')
    assert done(folder) == set()


def test_a_scene_that_is_mapped_again_is_neither_done_nor_failed_until_it_ends(folder):
    for name in ("one", "bad", "new"):
        forget_records(folder, name, folder.names())
    assert [outcome.scene for outcome in outcomes_in(folder)] == ["two"]


def test_the_summary_has_every_scene_once_and_what_is_done_has_not_failed(folder, tmp_path):
    write_failed(folder, Outcome("two", "failed", 1.0, error="KeyError", reason="an earlier time"))
    write_summary(folder, {"two"})
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert summary["counts"] == {"done before": 1, "done": 1, "failed": 1}
    assert {scene["scene"]: scene["status"] for scene in summary["scenes"]} == {
        "one": "done before",
        "two": "done",
        "bad": "failed",
    }
    failed = next(scene for scene in summary["scenes"] if scene["status"] == "failed")
    assert (failed["error"], failed["reason"], failed["trace"]) == ("KeyError", "x", "Traceback")
    for outcome in outcomes_in(folder):
        log_outcome(folder, outcome)
        log_outcome(folder, outcome)
    assert len((tmp_path / "log.jsonl").read_text().splitlines()) == 6


SETTINGS = BatchSettings("nuscenes", Path("/data"), weights_sha256="ab")


@pytest.mark.parametrize(
    "change",
    [
        {"version": "9.9"},
        {"weights_sha256": "cd"},
        {"dataset": "argoverse2"},
        {"data_root": Path("/other")},
        {"allow_missing_cameras": True},
        {"network": NetworkOptions(precision=Precision.BFLOAT16)},
        {"network": NetworkOptions(compiled=True)},
        {"origin": LocalPlane(8.4, 49.0)},
        {"threads": 2},
        {"rate": 2.0},
        {"crs": "EPSG:32632"},
    ],
    ids=lambda change: "-".join(change),
)
def test_a_map_made_with_other_settings_is_not_done(change):
    scene = ListedScene("one", None)
    assert replace(SETTINGS, **change).fingerprint(scene) != SETTINGS.fingerprint(scene)


def test_what_changes_no_digit_does_not_make_maps_anew():
    scene = ListedScene("one", None)
    for change in ({"force": True}, {"recordings": True}, {"frames": True}):
        assert replace(SETTINGS, **change).fingerprint(scene) == SETTINGS.fingerprint(scene)
    assert SETTINGS.fingerprint(ListedScene("one", Path("/other"))) != SETTINGS.fingerprint(scene)


def test_an_error_that_nobody_foresaw_keeps_its_traceback_and_one_of_the_data_has_none(folder):
    def outcome(error: Exception) -> Outcome:
        def pipeline(root):
            raise error

        return _map_scene(pipeline, folder, SETTINGS, ListedScene("new", None))

    fault = outcome(KeyError("ego_pose"))
    assert (fault.status, fault.error, fault.reason) == ("failed", "KeyError", "'ego_pose'")
    assert "Traceback" in (fault.trace or "")
    told = outcome(UserError("an image is cut short"))
    assert (told.error, told.reason, told.trace) == ("UserError", "an image is cut short", None)
    assert done(folder) == {"one", "two"}
