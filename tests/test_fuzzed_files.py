"""Damaged files are read or refused; ``python -m tests.benchmarks.fuzzed_files`` tries many more of them."""

import sys

import pytest

from tests.fuzzing.judge import judge
from tests.fuzzing.readers import READERS

SLOW = {"weights", "training-run", "log", "map.gpkg"}


@pytest.mark.skipif(sys.platform != "linux", reason="the limit of memory is Linux's")
@pytest.mark.parametrize("name", [name for name in READERS if name != "map.json"])
def test_mutated_files_are_read_or_refused(tmp_path, name):
    verdict = judge(READERS[name], tmp_path, range(8 if name in SLOW else 40), seed=2)
    assert verdict.faults == {}
    assert verdict.refused + verdict.read > 0
