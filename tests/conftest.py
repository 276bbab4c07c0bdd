"""The whole suite runs in a process for each core; chosen tests, and those that print or time things, in one.

Also the fixtures of several rooms.
"""

from __future__ import annotations

import os
from collections.abc import Iterator

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


@pytest.fixture
def bucket(monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    """URL of an empty bucket of an S3 server on this machine, which other processes reach, too."""
    pytest.importorskip("s3fs")
    servers = pytest.importorskip("moto.server")
    import boto3
    import s3fs

    server = servers.ThreadedMotoServer("127.0.0.1", 0, verbose=False)
    server.start()
    host, port = server.get_host_and_port()
    monkeypatch.setenv("AWS_ENDPOINT_URL", f"http://{host}:{port}")
    monkeypatch.setenv("AWS_DEFAULT_REGION", "us-east-1")
    for name in ("AWS_ACCESS_KEY_ID", "AWS_SECRET_ACCESS_KEY"):
        monkeypatch.setenv(name, "testing")
    s3fs.S3FileSystem.clear_instance_cache()
    boto3.client("s3").create_bucket(Bucket="fleet")
    yield "s3://fleet"
    s3fs.S3FileSystem.clear_instance_cache()
    server.stop()
