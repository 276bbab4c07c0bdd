"""Which data set a command gets, and what it is told when there is none where it was said to be."""

import pytest

from predmapnet.datasets.selection import open_source
from predmapnet.errors import UserError

VARIABLES = ("PREDMAPNET_DATASET", "PREDMAPNET_DATA_ROOT", "NUSCENES_ROOT", "AV2_ROOT")


@pytest.fixture(autouse=True)
def nothing_configured(monkeypatch):
    for variable in VARIABLES:
        monkeypatch.delenv(variable, raising=False)


def test_with_nothing_configured_it_is_the_demo_world_and_says_so():
    source, why = open_source(None, None)
    assert (source.name, source.synthetic) == ("demo", True)
    assert why == "Using the demo world (synthetic towns), because no data set is configured."


def test_the_kind_is_recognised_from_the_folder(nuscenes_root):
    source, why = open_source(None, nuscenes_root)
    assert source.name == "nuscenes"
    assert f"nuscenes v1.0-mini in {nuscenes_root}" in why


def test_the_environment_is_used_and_named(nuscenes_root, monkeypatch):
    monkeypatch.setenv("NUSCENES_ROOT", str(nuscenes_root))
    source, why = open_source(None, None)
    assert source.name == "nuscenes"
    assert "NUSCENES_ROOT" in why


def test_the_command_line_wins_over_the_environment(nuscenes_root, monkeypatch):
    monkeypatch.setenv("NUSCENES_ROOT", str(nuscenes_root))
    monkeypatch.setenv("PREDMAPNET_DATASET", "nuscenes")
    assert open_source("demo", None)[0].name == "demo"


@pytest.mark.parametrize(
    ("environment", "said"),
    [
        ({"PREDMAPNET_DATA_ROOT": "/not/there"}, "PREDMAPNET_DATA_ROOT says the data lie in /not/there, but"),
        ({"NUSCENES_ROOT": "/not/there"}, "NUSCENES_ROOT says the data lie in /not/there, but"),
        ({"PREDMAPNET_DATASET": "nuscenes"}, "nothing says where it lies"),
        ({"PREDMAPNET_DATASET": "waymo"}, "PREDMAPNET_DATASET says 'waymo', but the data sets are"),
        ({"NUSCENES_ROOT": "/a", "AV2_ROOT": "/b"}, "Both NUSCENES_ROOT and AV2_ROOT are set"),
    ],
)
def test_what_is_configured_but_missing_is_never_replaced(environment, said, monkeypatch):
    for variable, value in environment.items():
        monkeypatch.setenv(variable, value)
    with pytest.raises(UserError, match=said):
        open_source(None, None)


def test_a_folder_that_is_neither(tmp_path):
    with pytest.raises(UserError, match=r"neither nuScenes .* nor Argoverse 2"):
        open_source(None, tmp_path)
    with pytest.raises(UserError, match="holds no nuScenes tables"):
        open_source("nuscenes", tmp_path)
