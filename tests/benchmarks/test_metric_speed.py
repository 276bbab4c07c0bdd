"""Speed of the metrics, as ratios to the official code on the same 93 frames, and at the size of nuScenes val.

The official seconds are CPU seconds of a single process (``timing_official.json`` beside the fixtures). On a machine
that does nothing else:

    pytest -m benchmark_only -s tests/benchmarks/test_metric_speed.py -k official     # ratios, one core, a minute
    pytest -m benchmark_only -s tests/benchmarks/test_metric_speed.py -k nuscenes_val  # 6,019 frames, two cores
"""

import json
import multiprocessing
import resource
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from itertools import groupby
from time import perf_counter, process_time

import cv2
import pytest

from predmapnet.evaluation.chamfer_ap import chamfer_average_precision
from predmapnet.evaluation.consistency_ap import consistency_average_precision, with_formed_tracks
from predmapnet.evaluation.measurement import measure_scene, pool_scenes
from predmapnet.evaluation.raster_ap import raster_average_precision
from tests.predmapnet.evaluation.metric_fixtures import BUNDLED, load_metric_case

pytestmark = pytest.mark.benchmark_only

NUSCENES_VAL_FRAMES = 6019
ROUNDS = 5

_case = None


@pytest.fixture(scope="module")
def case():
    cv2.setNumThreads(1)
    return load_metric_case(BUNDLED)


@pytest.mark.parametrize(
    ("measure", "official", "wanted"),
    [
        (chamfer_average_precision, ["chamfer_ap_stable"], 10),
        (with_formed_tracks, ["prepare_pred_tracks"], 10),
        (consistency_average_precision, ["prepare_gt_tracks", "cmap_own_ids_stable"], 10),
        (raster_average_precision, ["raster_ap_mapvr_frame__gt_raw"], 5),
    ],
    ids=["chamfer_ap", "formed_tracks", "consistency_ap", "raster_ap"],
)
def test_faster_than_the_official_code(case, measure, official, wanted, capsys):
    timing = json.loads((BUNDLED / "timing_official.json").read_text())
    theirs = sum(timing[name]["cpu_s"] for name in official)
    measure(case.frames[:2])  # compiles
    ours = []
    for _ in range(ROUNDS):
        start = process_time()
        measure(case.frames)
        ours.append(process_time() - start)
    ratio = theirs / min(ours)
    with capsys.disabled():
        print(f"\n{measure.__name__}: {min(ours):.3f} CPU s, official {theirs:.2f} CPU s, {ratio:.0f} times as fast")
    assert ratio >= wanted


def _measure_copy(scene: str, copy: int):
    global _case
    if _case is None:
        cv2.setNumThreads(1)
        _case = load_metric_case(BUNDLED)
    return measure_scene([replace(frame, scene=f"{scene}-{copy}") for frame in _case.frames if frame.scene == scene])


def test_nuscenes_val_in_two_minutes_on_two_cores(case, capsys):
    lengths = {name: len(list(group)) for name, group in groupby(case.frames, key=lambda frame: frame.scene)}
    copies = -(-NUSCENES_VAL_FRAMES // len(case.frames))
    start = perf_counter()
    with ProcessPoolExecutor(2, mp_context=multiprocessing.get_context("spawn")) as pool:
        futures = [pool.submit(_measure_copy, name, copy) for copy in range(copies) for name in lengths]
        total = pool_scenes([future.result() for future in futures])
    seconds = perf_counter() - start
    own = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    workers = 2 * resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss
    gigabytes = (own + workers) / 2**20
    with capsys.disabled():
        print(f"\n{len(total.frames)} frames, all metrics: {seconds:.0f} s on two cores, {gigabytes:.1f} GB in all")
    assert len(total.frames) >= NUSCENES_VAL_FRAMES
    assert seconds < 120.0
    assert gigabytes < 4.0
