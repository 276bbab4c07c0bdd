"""A submission for Argoverse 2 is measured on logs of which only poses and maps are at hand."""

import json
import os
from pathlib import Path

import pytest

from mapfusion.elements import RegionOfInterest
from predmapnet.datasets.argoverse2 import Argoverse2Source
from predmapnet.errors import UserError
from predmapnet.evaluation.measurement import pool_scenes
from predmapnet.runs.evaluate import EvaluationSettings, measure_scenes, scenes_to_measure

pytestmark = pytest.mark.reference

PROJECT = Path(__file__).resolve().parents[3]
REFERENCE = Path(os.environ.get("PREDMAPNET_REFERENCE", PROJECT.parent / "shared" / "reference" / "public"))
LOGS = REFERENCE / "ground_truth" / "av2" / "logs"


@pytest.fixture(scope="module")
def source():
    if not LOGS.is_dir():
        pytest.skip(f"no Argoverse 2 logs in {LOGS}: set PREDMAPNET_REFERENCE")
    return Argoverse2Source(LOGS)


def submitted_truth(scene, roi, name_of):
    entries = {}
    for index in range(len(scene)):
        truth = scene.truth(index, roi)
        entries[name_of(scene.instant(index))] = {
            "vectors": [line.tolist() for line in truth.polylines],
            "scores": [1.0] * len(truth.kinds),
            "labels": truth.kinds.tolist(),
        }
    return entries


@pytest.mark.parametrize("size", [(60.0, 30.0), (100.0, 50.0)], ids=["60x30", "100x50"])
@pytest.mark.parametrize(
    "name_of", [lambda instant: str(instant.timestamp), lambda instant: instant.token], ids=["time", "log_time"]
)
def test_the_truth_as_a_submission_is_perfect(source, tmp_path, size, name_of):
    roi = RegionOfInterest(*size)
    scene = source.open(source.scenes()[0].name)
    entries = submitted_truth(scene, roi, name_of)
    (tmp_path / "submission.json").write_text(json.dumps({"meta": {}, "results": entries}))
    settings = EvaluationSettings(dataset="argoverse2", data_root=LOGS, results=tmp_path / "submission.json", roi=roi)
    scenes = scenes_to_measure(settings, source, None)
    assert scenes == [scene.info.name]
    figures = pool_scenes(list(measure_scenes(settings, scenes))).figures()
    present = {label for entry in entries.values() for label in entry["labels"]}
    assert figures["chamfer_ap"]["mAP"] == pytest.approx(len(present) / 3, abs=0.01)
    assert figures["raster_ap"]["mAP"] == pytest.approx(1.0, abs=0.03)


def test_frames_at_another_phase_are_refused_with_a_hint(source, tmp_path):
    between = Argoverse2Source(LOGS, stride=1).open(source.scenes()[0].name).instant(1)
    entry = {"vectors": [], "scores": [], "labels": []}
    (tmp_path / "submission.json").write_text(json.dumps({"results": {str(between.timestamp): entry}}))
    settings = EvaluationSettings(dataset="argoverse2", data_root=LOGS, results=tmp_path / "submission.json")
    with pytest.raises(UserError, match=r"1 of 1 frames are not in argoverse2 .* --official-frames\?"):
        scenes_to_measure(settings, source, None)
