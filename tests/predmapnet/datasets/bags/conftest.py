"""One log for all tests of bags: two cameras, twelve frames."""

import pytest

from tests.predmapnet.datasets.bags.drawn_bag import bag_of
from tests.predmapnet.datasets.own_logs.drawn_log import bend, entry, write_log

CAMERAS = {"front": entry(0, 160, 96, 90.0), "left": entry(80, 160, 96, 90.0)}


@pytest.fixture(scope="session")
def log(tmp_path_factory):
    return write_log(tmp_path_factory.mktemp("logs") / "drive", CAMERAS, bend(12), late=20_000_000)


@pytest.fixture
def drawn(log):
    return bag_of(log)
