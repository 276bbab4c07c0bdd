"""Names that data brings never lead out of a folder, and different ones stay different."""

from __future__ import annotations

from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from predmapnet.errors import UserError
from predmapnet.evaluation.comparison import compare_evaluations
from predmapnet.files import check_output, file_name, whole_folder


@given(st.text(max_size=300))
def test_a_file_of_any_name_lies_in_its_folder(name):
    path = Path("folder") / f"{file_name(name)}.geojson"
    assert path.parent == Path("folder")
    assert not path.name.startswith(".")
    assert len(path.name.encode()) < 2000
    assert "\0" not in path.name
    assert path.resolve().parent == Path("folder").resolve()


@given(st.text(max_size=40), st.text(max_size=40))
def test_different_names_stay_different(first, second):
    assert (file_name(first) == file_name(second)) == (first == second)


@pytest.mark.parametrize("name", ["scene-0103", "own log (2)", "0a1b2c3d-0000-3000-8000-000000000001", "München"])
def test_plain_names_stay_as_they_are(name):
    assert file_name(name) == name


@pytest.mark.parametrize("companion", ["map.gpkg-wal", "map.gpkg-journal", ".~lock.map.gpkg#", "map.gpkg.lock"])
def test_a_file_that_a_program_has_open_is_refused_before_the_work(tmp_path, companion):
    (tmp_path / companion).write_text("changes")
    with pytest.raises(UserError, match="has it open"):
        check_output(tmp_path / "map.gpkg")
    (tmp_path / companion).unlink()
    (tmp_path / "map.gpkg-wal").touch()
    check_output(tmp_path / "map.gpkg")


def test_another_ending_is_refused(tmp_path):
    with pytest.raises(UserError, match=r"only \.rrd"):
        check_output(tmp_path / "recording.txt", (".rrd",))


def test_links_that_lead_in_a_circle_are_told(tmp_path):
    circle, other = tmp_path / "circle.json", tmp_path / "other.json"
    circle.symlink_to(other)
    other.symlink_to(circle)
    with pytest.raises(OSError, match="symbolic links"):
        check_output(circle)
    with pytest.raises(UserError, match="exists already"), whole_folder(circle):
        pass
    with pytest.raises(UserError, match=r"no file .*circle\.json"):
        compare_evaluations([circle, other])
