"""The stated uncertainty is honest: about 95 % of the truth lies within 1.96 stated deviations."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from mapfusion import ElementKind, GlobalMap, MapIntegrator
from mapfusion.diff import Change, DiffConfig, diff_maps
from mapfusion.integrate.marks import distinct, place_mark, track_mark
from mapfusion.integrate.uncertainty import CAPACITY, LASTING, PROBE_SPACING, ErrorModel, Probe
from mapfusion.merge.merge import merge_maps
from tests.mapfusion.argoverse import LOGS
from tests.mapfusion.calibration import CORRELATIONS, drives_of, errors_of, share_inside, standard_errors
from tests.mapfusion.simulation import simulate, town_road

LEAST, MOST = 0.90, 0.99
"""Of three drives' errors, some thirty independent ones; the table of tests.mapfusion.calibration has more."""


@pytest.mark.parametrize("noise", [0.1, 0.3, 0.5])
@pytest.mark.parametrize("errors", ["independent", "per track", "slowly varying"])
def test_towns_lie_within_the_stated_band(errors, noise):
    drives = drives_of("towns", CORRELATIONS[errors].scaled(noise), 20, range(50, 53))
    assert LEAST <= share_inside(errors_of(drives)) <= MOST


@pytest.mark.reference
@pytest.mark.parametrize("errors", CORRELATIONS)
def test_real_roads_lie_within_the_stated_band(errors):
    if not LOGS.is_dir():
        pytest.skip(f"no Argoverse 2 logs in {LOGS}: set PREDMAPNET_REFERENCE")
    drives = drives_of("Argoverse 2", CORRELATIONS[errors].scaled(0.3), 40, range(50, 54))
    assert LEAST <= share_inside(errors_of(drives)) <= MOST


def test_two_maps_of_one_place_have_not_moved_apart_beyond_their_uncertainty():
    truth, road = town_road(np.random.default_rng(7))
    maps = []
    for seed in (0, 1):
        poses = [road.pose(30.0 + 4.5 * number, -1.75) for number in range(30)]
        detector = CORRELATIONS["both"].scaled(0.4)
        integrator = MapIntegrator()
        for frame in simulate(truth, poses, np.random.default_rng(seed), detector).frames:
            integrator.add(frame)
        maps.append(integrator.map())
    bare = [GlobalMap(tuple(replace(element, deviation=None) for element in one)) for one in maps]
    config = DiffConfig(tolerance=0.2, align=False)
    honest, blind = diff_maps(*maps, config=config), diff_maps(*bare, config=config)
    moved, guessed = (sum(found.metres(Change.MOVED, kind) for kind in ElementKind) for found in (honest, blind))
    length = sum(element.length for element in maps[0])
    assert moved < 0.15 * length < guessed


def test_a_merged_map_lies_within_its_stated_band():
    truth, road = town_road(np.random.default_rng(8))
    poses = [road.pose(30.0 + 4.5 * number, -1.75) for number in range(30)]
    maps = []
    for seed in range(3):
        drive = simulate(truth, poses, np.random.default_rng(seed), CORRELATIONS["both"])
        integrator = MapIntegrator()
        for frame in drive.frames:
            integrator.add(frame)
        maps.append(integrator.map())
    merged = merge_maps(maps)[0]
    assert LEAST <= share_inside(standard_errors(merged, drive)) <= MOST


def learnt(new: float, lasting: float, track: float, frames: int = 12, elements: int = 300) -> np.ndarray:
    """Return what the model makes of detections with known parts, 4 m apart, two tracks per element."""
    rng = np.random.default_rng(0)
    model = ErrorModel()
    kept = np.exp(-4.0 / LASTING[1])
    for element in range(elements):
        slow = rng.normal()
        offsets = rng.normal(0.0, np.sqrt(track), 2)
        for frame in range(frames):
            slow = kept * slow + np.sqrt(1.0 - kept**2) * rng.normal()
            y = rng.normal(0.0, np.sqrt(new)) + np.sqrt(lasting) * slow + offsets[2 * frame // frames]
            probe = Probe(
                element,
                np.array([PROBE_SPACING]),
                np.array([[3.0, y]]),
                np.array([[1.0, 0.0]]),
                np.ones(1),
                np.array([4.0 * frame, 0.0]),
                2 * frame // frames,
            )
            model.note(probe)
    assert elements * frames < CAPACITY
    return model.parts()


@pytest.mark.parametrize("true", [(1.0, 0.0, 0.0), (0.3, 0.7, 0.0), (0.4, 0.0, 0.6), (2.0, 1.0, 1.0)])
def test_parts_of_the_error_are_learnt_from_differences(true):
    new, *lasting, track = learnt(*true)
    assert [new, sum(lasting), track] == pytest.approx(true, abs=0.3 * sum(true))


def test_different_places_and_tracks_are_counted():
    def marks(values):
        return np.array([np.bitwise_or.reduce(np.array(values, dtype=np.uint64))])

    places = [place_mark(0, np.array([4.5 * k, 2.0 * k])) for k in range(14)]
    assert distinct(marks(places))[0] == pytest.approx(14, abs=3)
    assert distinct(marks(places[:1] * 30))[0] == pytest.approx(1, abs=0.1)
    both = places + [place_mark(1, np.array([4.5 * k, 2.0 * k])) for k in range(14)]
    assert distinct(marks(both))[0] == pytest.approx(28, rel=0.3)
    assert distinct(marks([track_mark(0, k) for k in (3, 4, 9)]))[0] == pytest.approx(3, abs=0.2)
