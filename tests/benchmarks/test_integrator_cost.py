"""Cost of a frame in the integrator, which does not grow with the map."""

from __future__ import annotations

import resource
import time
from pathlib import Path

import numpy as np
import pytest

from mapfusion import ElementKind, FrameMap, MapIntegrator
from mapfusion.integrate.evidence import Evidence
from mapfusion.integrate.fused_line import FusedLine
from mapfusion.integrate.station_curve import StationCurve
from tests.mapfusion.simulation import ROI, pose

pytestmark = pytest.mark.benchmark_only


def frames(count: int = 40) -> list[FrameMap]:
    """A drive past 20 elements per frame: 16 lines along the road and 4 crossings."""
    rng = np.random.default_rng(0)
    result = []
    for number in range(count):
        x = np.linspace(-30, 30, 20)
        lines = [np.stack([x, np.full(20, y) + rng.normal(0, 0.2)], axis=1) for y in np.linspace(-14, 14, 16)]
        rings = []
        for k in range(4):
            near = 40.0 * np.round((5.0 * number + 15.0 * k - 25.0) / 40.0) - 5.0 * number
            corners = np.array([[0, -6], [4, -6], [4, 6], [0, 6], [0, -6]])
            corners = np.clip(corners + np.array([near + 5.0 * k, 0.0]), [-30, -15], [30, 15])
            rings.append(corners + rng.normal(0, 0.1, 2))
        result.append(
            FrameMap(
                timestamp=number * 500_000_000,
                ego_to_global=pose(5.0 * number, 0.0, 0.0),
                roi=ROI,
                kinds=np.array([1 + k % 2 for k in range(16)] + [0] * 4),
                scores=np.full(20, 0.7),
                track_ids=np.arange(20),
                polylines=(*lines, *rings),
            )
        )
    return result


def filled(size: int) -> MapIntegrator:
    """An integrator that holds ``size`` lines of 40 m on a square grid, the road among them."""
    integrator = MapIntegrator()
    integrator.state.frame_log.drive("earlier")
    side = int(np.sqrt(size))
    x = np.linspace(0.0, 40.0, 41)
    for number in range(size):
        row, column = divmod(number, side)
        points = np.stack([x + 50.0 * (column - side // 2), np.full(41, 8.0 * (row - side // 2) + 100.0)], axis=1)
        sums = np.tile([50.0, 5.0, 5.0, 1.0, 0.0], (41, 1))
        curve = StationCurve(points, sums, np.ones((41, 2), dtype=np.uint64))
        line = FusedLine(ElementKind.DIVIDER, curve, Evidence(0, 1, 5, {(0, 1): 5}))
        integrator.put_line(number, line)
    integrator.state.next_id = size
    return integrator


def resident() -> float:
    """Memory of this process that is in use, MB."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * resource.getpagesize() / 1e6


@pytest.mark.parametrize("size", [1_000, 10_000, 100_000])
def test_cost_of_add(size, capsys):
    before = resident()
    integrator = filled(size)
    memory = resident() - before
    milliseconds: list[float] = []
    for _ in range(3):  # fresh drives past the same lines, so that chance weighs less
        for frame in frames():
            start = time.process_time()
            integrator.add(frame, log=f"drive {len(milliseconds) // 40}")
            milliseconds.append(1e3 * (time.process_time() - start))
    median, high = np.percentile(milliseconds, [50, 95])
    with capsys.disabled():
        print(f"\n{size:7d} lines: add {median:.2f} ms (95 %: {high:.2f}), {memory:.0f} MB for the lines")
    assert memory < 1000.0


@pytest.mark.parametrize("size", [1_000, 10_000, 100_000])
def test_cost_of_map(size, capsys):
    integrator = filled(size)
    start = time.process_time()
    integrator.map()
    first = time.process_time() - start
    milliseconds = []
    for frame in frames():
        integrator.add(frame)
        start = time.process_time()
        integrator.map()
        milliseconds.append(1e3 * (time.process_time() - start))
    median, high = np.percentile(milliseconds, [50, 95])
    with capsys.disabled():
        print(f"\n{size:7d} lines: map after each frame {median:.1f} ms (95 %: {high:.1f}), the first {first:.1f} s")
    assert median < 1000.0
