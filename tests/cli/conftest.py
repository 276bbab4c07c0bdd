"""Runs the real commands on a tiny data set with a random network that finds plenty."""

import sys
from dataclasses import dataclass
from pathlib import Path

import pytest

from tests.cli.random_weights import write_random_weights
from tests.cli.tiny_nuscenes import write_tiny_nuscenes


@pytest.fixture(scope="session")
def random_weights(tmp_path_factory) -> Path:
    """A checkpoint of an untrained network that is sure of what it finds; few queries keep it fast."""
    return write_random_weights(tmp_path_factory.mktemp("weights") / "random.safetensors")


@pytest.fixture
def tiny_root(tmp_path) -> Path:
    """A data set of its own for one test, so that the test may break it."""
    return write_tiny_nuscenes(tmp_path / "data", ("scene-0001", "scene-0002"))


@dataclass(frozen=True)
class Result:
    """What a command said."""

    code: int
    out: str
    err: str


@pytest.fixture
def predmapnet(monkeypatch, capsys, tmp_path):
    """Run a command as the shell would, in this process and in an empty folder without any configuration."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("PREDMAPNET_CACHE", str(tmp_path / "cache"))
    for variable in ("PREDMAPNET_DATASET", "PREDMAPNET_DATA_ROOT", "NUSCENES_ROOT", "AV2_ROOT", "PREDMAPNET_DEBUG"):
        monkeypatch.delenv(variable, raising=False)

    def run(*arguments: object) -> Result:
        from cli.main import main

        monkeypatch.setattr(sys, "argv", ["predmapnet", *map(str, arguments)])
        with pytest.raises(SystemExit) as end:
            main()
        said = capsys.readouterr()
        return Result(int(end.value.code or 0), said.out, said.err)

    return run
