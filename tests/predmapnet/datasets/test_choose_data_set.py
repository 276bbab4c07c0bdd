"""Choice of the data set by option, environment and folder; messages where it is missing."""

import pytest

from predmapnet.errors import UserError
from predmapnet.sources import open_source

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


def test_the_new_split_is_chosen_and_said(nuscenes_root):
    source, why = open_source(None, nuscenes_root, split_scheme="new")
    assert source.split_scheme == "new"
    assert why.endswith("Splits are the new, geographically disjoint ones.")


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ({"split_scheme": "disjoint"}, "no split scheme 'disjoint'. There are: old .* and new"),
        ({"split_scheme": "new"}, "demo world has no new split"),
        ({"official_frames": True}, "Official frames are a matter of Argoverse 2"),
    ],
)
def test_a_choice_that_does_not_fit_the_data_set_is_an_error(arguments, said):
    with pytest.raises(UserError, match=said):
        open_source("demo", None, **arguments)


def test_the_new_split_has_no_test_and_names_no_logs_of_ones_own(write_nuscenes_data, tmp_path):
    write_nuscenes_data(tmp_path, scenes=("my-drive",), frames=1)
    source, _ = open_source("nuscenes", tmp_path, split_scheme="new")
    with pytest.raises(UserError, match="no test"):
        source.scenes("test")
    with pytest.raises(UserError, match="names none of the 1 scenes"):
        source.scenes()
