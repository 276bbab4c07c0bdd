"""Cost of a frame, part by part and over a long drive; the figures depend on the machine and are printed."""

import pytest

from predmapnet.machine import use_threads
from tests.benchmarks import endless_drive, network_cost

pytestmark = pytest.mark.benchmark_only


@pytest.mark.parametrize("name", ["lite", "paper-nuscenes"])
def test_cost_of_the_parts(name, capsys):
    use_threads(0)
    lines = list(network_cost.report(name, frames=3))
    with capsys.disabled():
        print("", *lines, sep="\n")
    assert any(line.startswith("query generator") for line in lines)


def test_cost_of_a_long_drive(capsys):
    use_threads(0)
    lines = list(endless_drive.table(frames=2000, every=200))
    with capsys.disabled():
        print("", *lines, sep="\n")
    assert len(lines) == 11
