"""All metrics of a scene together, the report that is made of them, and what holds for any input."""

import json
import re
from dataclasses import replace

import numpy as np
import pytest

from mapfusion.elements import ElementKind, FrameMap, GlobalMap, MapElement, RegionOfInterest
from mapfusion.geometry import transform_points
from predmapnet.errors import UserError
from predmapnet.evaluation.ahead_rear_ap import Half, half_matches
from predmapnet.evaluation.chamfer_ap import chamfer_average_precision
from predmapnet.evaluation.comparison import POOLED
from predmapnet.evaluation.consistency_ap import consistency_average_precision
from predmapnet.evaluation.frames import EvaluationFrame
from predmapnet.evaluation.measurement import measure_scene, pool_scenes
from predmapnet.evaluation.precision_recall import accumulate
from predmapnet.evaluation.raster_ap import raster_average_precision
from predmapnet.evaluation.report import write_figures, write_report
from predmapnet.evaluation.scene_figures import SCENE_FIGURES, scene_figures
from predmapnet.evaluation.stability import scene_instances, stability
from predmapnet.scenes import FrameTruth

RING = np.array([[10.0, -3.0], [14.0, -3.0], [14.0, 5.0], [10.0, 5.0], [10.0, -3.0]])
CONTEXT = {"dataset": "demo", "split": "test", "synthetic": True, "warnings": ["these are few scenes"]}
ORIGIN = {"date": "2026-11-29", "weights": "lite", "command": "predmapnet evaluate"}


def drive(count=6, speed=2.0, offset=0.0, switch_at=None):
    """A straight drive past a crossing, with a kerb and an oblique divider; every element predicted exactly."""
    frames = []
    world = [RING, np.array([[-40.0, 9.0], [80.0, 9.0]]), np.array([[-25.0, -12.0], [25.0, 10.0]])]
    kinds = np.array([0, 2, 1])
    for index in range(count):
        pose = np.eye(4)
        pose[0, 3] = speed * index
        global_to_ego = np.linalg.inv(pose)
        following = np.linalg.inv(pose)
        following[0, 3] -= speed
        lines = tuple(transform_points(global_to_ego, line) for line in world)
        ids = np.array([0, 1, 2]) + (10 if switch_at is not None and index >= switch_at else 0)
        predicted = FrameMap(
            timestamp=index,
            ego_to_global=pose,
            roi=RegionOfInterest(),
            kinds=kinds,
            scores=np.array([0.9, 0.8, 0.7]),
            track_ids=ids,
            polylines=tuple(line + np.array([0.0, offset]) for line in lines),
            forecasts=tuple(transform_points(following, line) for line in world),
        )
        truth = FrameTruth(kinds, lines, np.arange(3))
        frames.append(EvaluationFrame("scene-0001", index, predicted, truth))
    elements = tuple(MapElement(ElementKind(kind), line, 0.9, 3, 0, 1) for kind, line in zip(kinds, world, strict=True))
    return frames, GlobalMap(elements)


def test_perfect_predictions_are_perfect_by_every_measure():
    frames, truth_map = drive()
    measured = measure_scene(frames, truth_map, truth_map, 3.0)
    figures = pool_scenes([measured], [measured.global_matches]).figures()
    precisions = [key for key in figures if key.endswith("_ap") or key == "consistency_ap_formed_ids"]
    assert len(precisions) == 9
    for metric in precisions:
        # The drive ends before the crossing lies behind the car, and a kind without truth counts as 0. The kerb of the
        # map runs on where nothing was seen, and GlobalMapNet cuts only the truth there.
        lacking = metric in ("rear_ap", "global_map_ap", "place_map_ap")
        assert figures[metric]["mAP"] == pytest.approx(2 / 3 if lacking else 1.0), metric
    assert figures["stability"]["presence"] == figures["stability"]["shape"] == 1.0
    assert figures["global_map"]["f1@1.0"] == pytest.approx(1.0)
    assert figures["tracks"]["id_switches"] == 0
    assert figures["tracks"]["tracked_share"] == 1.0
    assert figures["frames_per_second"] == pytest.approx(2.0)


def test_the_figures_together_are_those_of_each_metric_alone(case):
    """And those of one scene are those of a data set that holds nothing else, in `compare`, too."""
    frames = [frame for frame in case.frames if frame.scene == case.frames[0].scene]
    pose, truth = frames[0].predicted.ego_to_global, frames[0].truth
    true = [transform_points(pose, line) for line in truth.polylines]
    found = [transform_points(pose, line + np.array([0.0, 1.2])) for line in truth.polylines]
    maps = [
        GlobalMap(
            tuple(MapElement(ElementKind(k), line, 0.9, 3, 0, 1) for k, line in zip(truth.kinds, lines, strict=True))
        )
        for lines in (found, [*true[:-1], true[-1] + 30.0])
    ]
    scene = measure_scene(frames, *maps)
    figures, alone = pool_scenes([scene]).figures(), scene_figures(scene)
    standard = (0.5, 1.0, 1.5)
    assert figures["chamfer_ap"] == chamfer_average_precision(frames).figures()
    for section, half in (("ahead_ap", Half.AHEAD), ("rear_ap", Half.REAR)):
        matches = [half_matches(frame, half, standard) for frame in frames]
        assert figures[section] == accumulate(matches, standard).figures()
    ids = [frame.truth.element_ids for frame in frames]
    steady = stability([(frames, scene_instances(frames, ids))])
    assert figures["stability"] == steady.figures() and figures["stability"]["protocol"] == "anchored"
    assert figures["raster_ap"] == raster_average_precision(frames).figures()
    assert figures["consistency_ap"].items() >= consistency_average_precision(frames).figures().items()
    pooled = {name: figures[section][key] for name, (section, key) in POOLED.items()}
    assert len(set(pooled.values())) == len(pooled), "figures that are equal would hide that one stands for another"
    assert {name: alone[name] for name in pooled} == pytest.approx(pooled)


def test_ids_that_change_cost_consistency_only():
    frames, _ = drive(switch_at=3)
    figures = pool_scenes([measure_scene(frames)]).figures()
    assert figures["chamfer_ap"]["mAP"] == pytest.approx(1.0)
    assert figures["consistency_ap"]["mAP_without_consistency"] == pytest.approx(1.0)
    # Half of the frames keep the anchored id; the other half are false positives of equal score.
    assert figures["consistency_ap"]["mAP"] == pytest.approx(0.5)
    assert figures["consistency_ap_formed_ids"]["mAP"] == pytest.approx(1.0)
    assert figures["tracks"]["id_switches"] == 3


def test_a_forecast_that_knows_the_motion_beats_the_constant_position():
    frames, _ = drive()
    forecast = pool_scenes([measure_scene(frames)]).figures()["forecast"]
    for horizon, steps in (("t+1", 1), ("t+2", 2)):
        assert forecast[horizon]["forecast_mean_m"] == pytest.approx(0.0, abs=1e-9)
        assert forecast[horizon]["constant_position_mean_m"] == pytest.approx(2.0 * steps, abs=0.2)
        # It moves the lines as well, but clips them to the ROI, which the unclipped truth here does not.
        assert forecast[horizon]["ego_motion_median_m"] < forecast[horizon]["constant_position_median_m"]


def test_without_tracks_the_formed_ids_stand_in():
    frames, _ = drive()
    untracked = [replace(frame, predicted=replace(frame.predicted, track_ids=np.full(3, -1))) for frame in frames]
    figures = pool_scenes([measure_scene(untracked)]).figures()
    assert figures["consistency_ap"]["ids"] == "formed"
    assert figures["consistency_ap"]["mAP"] == pytest.approx(1.0)
    assert figures["global_map"] is None and figures["forecast"]["t+1"]["count"] == 0


def test_the_report_needs_nothing_else_and_the_json_has_the_promised_keys(tmp_path):
    frames, truth_map = drive(offset=0.7)
    scene = measure_scene(frames, truth_map, truth_map)
    measurement = pool_scenes([scene])
    figures_of, maps = {"scene-0001": scene_figures(scene)}, {"scene-0001": (truth_map, truth_map)}
    write_report(tmp_path / "report.html", measurement, CONTEXT, figures_of, ORIGIN, maps)
    html = (tmp_path / "report.html").read_text()
    for text in (*ORIGIN.values(), "these are few scenes", ">scene-0001</td>", '"rows":["scene-0001"]'):
        assert text in html
    assert not re.findall(r"(?:src|href|url)\s*[=(]", html)
    assert html.count("<svg") >= 3 + 2 + 2 * len(frames)
    write_figures(tmp_path / "figures.json", measurement.figures(), CONTEXT)
    figures = json.loads((tmp_path / "figures.json").read_text())
    assert figures["evaluated"]["split"] == "test"
    for metric in ("chamfer_ap", "consistency_ap", "raster_ap"):
        assert 0.0 <= figures[metric]["mAP"] <= 1.0
    assert figures["global_map"]["f1@1.0"] == pytest.approx(1.0)
    assert set(figures["chamfer_ap"]["divider"]) >= {"AP", "AP@0.5", "AP@1.0", "AP@1.5"}


def test_the_same_scenes_give_the_same_bytes(tmp_path, case):
    for name in ("a", "b"):
        scene = [frame for frame in case.frames if frame.scene == case.frames[0].scene]
        measured = measure_scene(scene)
        measurement = pool_scenes([measured])
        write_figures(tmp_path / name, measurement.figures(), CONTEXT)
        write_report(tmp_path / f"{name}.html", measurement, CONTEXT, {"a scene": scene_figures(measured)}, ORIGIN)
    assert (tmp_path / "a").read_bytes() == (tmp_path / "b").read_bytes()
    assert (tmp_path / "a.html").read_bytes() == (tmp_path / "b.html").read_bytes()


def test_a_kind_that_a_scene_lacks_is_no_part_of_its_figures():
    frames, _ = drive()
    kerbs = [
        replace(
            frame,
            predicted=frame.predicted.select(frame.predicted.kinds == 2),
            truth=FrameTruth(frame.truth.kinds[1:2], frame.truth.polylines[1:2], frame.truth.element_ids[1:2]),
        )
        for frame in frames
    ]
    scene = measure_scene(kerbs)
    figures = scene_figures(scene)
    assert set(figures) == {"frames", *SCENE_FIGURES}
    assert figures["chamfer_mAP"] == pytest.approx(1.0)
    assert figures["mAS"] == pytest.approx(0.5), "both ends of the kerb lie outside the window of the localisation"
    assert pool_scenes([scene]).chamfer.mean == pytest.approx(1 / 3)
    assert any("no ground truth of crossings, dividers" in text for text in pool_scenes([scene]).missing())
    assert figures["map_f1@1.0"] is None and figures["global_mAP"] is None


def test_scenes_of_two_methods_are_no_measurement():
    frames, _ = drive()
    scene = measure_scene(frames)
    with pytest.raises(UserError, match="different weights"):
        pool_scenes([replace(scene, weights_sha256="a"), replace(scene, weights_sha256="b")])


def test_what_is_missing_is_named():
    frames, truth_map = drive()
    assert pool_scenes([measure_scene(frames, truth_map, truth_map)]).missing() == []
    bare = [replace(frame, predicted=replace(frame.predicted, track_ids=np.full(3, -1))) for frame in frames]
    missing = pool_scenes([replace(measure_scene(bare), absent_frames=2)]).missing()
    assert [text.split(":")[0] for text in missing] == [
        "2 of 6 frames are not in the results and count as empty",
        "no track ids",
        "no true map of some scenes, so no figures of the map of the drive",
        "no forecasts",
    ]


def test_a_crossing_that_the_motion_takes_out_of_the_region_is_still_measured():
    frames, _ = drive(count=16, speed=4.0)
    assert any((frame.predicted.polylines[0].max(axis=0)[0] < -30.0) for frame in frames)
    figures = pool_scenes([measure_scene(frames)]).figures()
    assert np.isfinite(figures["forecast"]["t+1"]["ego_motion_mean_m"])
