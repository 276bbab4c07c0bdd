"""Memory that large tensors have left between results that stay goes back to the system."""

import subprocess
import sys

import pytest

FRAGMENTS = """
import numpy as np
from predmapnet.machine import trim_memory, use_threads
from tests.benchmarks.endless_drive import resident_megabytes
use_threads(1)
kept = []
for _ in range(40):
    large = [np.ones(2**19) for _ in range(4)]  # 16 MB
    kept.append([np.ones(600), large])
for pair in kept:
    pair[1] = None
del large
before = resident_megabytes()
trim_memory()
print(before - resident_megabytes())
"""


@pytest.mark.skipif(sys.platform != "linux", reason="of glibc")
def test_freed_memory_between_what_stays_goes_back():
    done = subprocess.run([sys.executable, "-c", FRAGMENTS], capture_output=True, text=True, timeout=300)
    assert float(done.stdout) > 300.0, done.stderr
