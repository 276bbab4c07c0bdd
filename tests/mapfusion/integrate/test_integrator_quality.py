"""The figures that the integrator promises, on simulated detections of made-up and of real roads."""

from __future__ import annotations

import numpy as np
import pytest
import shapely

from mapfusion import ElementKind, MapIntegrator
from tests.mapfusion.argoverse import LOGS, log_drive
from tests.mapfusion.baselines import LastObservationWins, PairwiseAveraging
from tests.mapfusion.compare_integrators import average
from tests.mapfusion.map_quality import Quality, faults, looked_at
from tests.mapfusion.simulation import town_drive


@pytest.fixture(scope="module")
def town_drives():
    return [town_drive(seed) for seed in range(4)]


def check(quality: Quality) -> None:
    assert quality.precision >= 0.95
    assert quality.recall >= 0.95
    assert quality.lateral <= 0.10
    assert quality.elements_per_true <= 1.2
    assert quality.ghosts_alive == 0


def test_town_roads_are_mapped_as_promised(town_drives):
    check(average(MapIntegrator, town_drives))


@pytest.mark.parametrize("baseline", [PairwiseAveraging, LastObservationWins])
def test_better_than_the_baselines_in_every_figure(town_drives, baseline):
    ours, theirs = average(MapIntegrator, town_drives[:2]), average(baseline, town_drives[:2])
    assert ours.precision > theirs.precision
    assert ours.recall > theirs.recall
    assert ours.lateral < theirs.lateral
    assert abs(ours.elements_per_true - 1.0) < abs(theirs.elements_per_true - 1.0)
    assert ours.ghosts_alive < theirs.ghosts_alive


@pytest.mark.parametrize("seed", range(4))
def test_lines_are_clean(town_drives, seed):
    integrator = MapIntegrator()
    for frame in town_drives[seed].frames:
        integrator.add(frame)
    assert faults(integrator.map()) == []


@pytest.mark.reference
def test_real_roads_are_mapped_as_promised():
    logs = sorted(path.parent for path in LOGS.glob("*/city_SE3_egovehicle.feather"))
    if not logs:
        pytest.skip(f"no Argoverse 2 logs in {LOGS}: set PREDMAPNET_REFERENCE")
    check(average(MapIntegrator, [log_drive(log, seed) for log in logs for seed in range(2)]))


def test_double_divider_stays_double(town_drives):
    drive = town_drives[0]
    integrator = MapIntegrator()
    for frame in drive.frames:
        integrator.add(frame)
    true = [e.points for e in drive.truth.of_kind(ElementKind.DIVIDER)]
    middles = [line[len(line) // 2] for line in true if looked_at(line[len(line) // 2][None], drive)[0] > 8]
    double = [middle for middle in middles if (distances(middle, true) < 0.5).sum() == 2]
    fused = [e.points for e in integrator.map().of_kind(ElementKind.DIVIDER)]
    assert len(double) == 2
    assert all((distances(middle, fused) < 0.6).sum() == 2 for middle in double)


def distances(point, lines):
    return np.array([shapely.distance(shapely.Point(point), shapely.LineString(line)) for line in lines])
