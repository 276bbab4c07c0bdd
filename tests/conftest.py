"""The whole suite runs in a process for each core; chosen tests, and those that print or time things, in one."""

from __future__ import annotations

import os

import pytest

from predmapnet.machine import available_cores

MOST = 4
"""Processes; each may need 3 GB."""

if "PYTEST_XDIST_WORKER" in os.environ:  # Before torch is there: in many processes, threads only wait for each other.
    os.environ.setdefault("OMP_NUM_THREADS", "1")


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_auto_num_workers(config: pytest.Config) -> int:
    """Return the number of processes, 0 for this one alone."""
    chosen = config.args_source is not pytest.Config.ArgsSource.TESTPATHS
    timed = "benchmark_only" in config.option.markexpr.replace("not benchmark_only", "")
    return 0 if chosen or timed or config.option.capture == "no" else min(available_cores(), MOST)
