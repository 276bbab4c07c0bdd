"""Scenes of a batch are chosen by name, pattern or manifest, and what means none is told."""

import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from predmapnet.errors import UserError
from predmapnet.runs.scene_choice import ListedScene, choose_scenes, read_manifest
from tests.cli.tiny_nuscenes import write_tiny_nuscenes


def test_names_and_patterns_choose_each_scene_once(tmp_path):
    from predmapnet.sources import open_source

    write_tiny_nuscenes(tmp_path, ("scene-0001", "scene-0002", "scene-0103"), frames=1)
    source, _ = open_source(None, tmp_path)
    chosen = choose_scenes(source, ["scene-0103", "scene-00*", "scene-0001"], None)
    assert [scene.name for scene in chosen] == ["scene-0103", "scene-0001", "scene-0002"]
    assert len(choose_scenes(source, [], None)) == 3
    with pytest.raises(UserError, match="scene-2"):
        choose_scenes(source, ["scene-2*"], None)


def test_manifests_of_both_formats_say_the_same_and_relative_folders_lie_beside_them(tmp_path):
    (tmp_path / "list.csv").write_bytes("\ufeffscene,folder,note\r\na,monday,x\r\nb,/data/friday,y\r\n".encode())
    pq.write_table(pa.table({"folder": ["monday", "/data/friday"], "scene": ["a", "b"]}), tmp_path / "list.parquet")
    for name in ("list.csv", "list.parquet"):
        assert [(scene.name, str(scene.root)) for scene in read_manifest(tmp_path / name)] == [
            ("a", str(tmp_path / "monday")),
            ("b", "/data/friday"),
        ]
    assert str(ListedScene("a")) == "a"


@pytest.mark.parametrize(
    ("content", "told"),
    [
        (b"scene,place\na,b\n", "no column folder"),
        (b"scene,folder\na,x\na,y\n", "row 2: a is there twice"),
        (b"scene,folder\na\n", "row 1"),
        (b"scene,folder\n", "names no scene"),
        (b"\xff\xfe\x00", "no CSV"),
    ],
)
def test_broken_manifests_are_told_with_their_row(tmp_path, content, told):
    (tmp_path / "list.csv").write_bytes(content)
    with pytest.raises(UserError, match=told):
        read_manifest(tmp_path / "list.csv")
    (tmp_path / "list.parquet").write_bytes(content)
    with pytest.raises(UserError, match="cannot be read as Parquet"):
        read_manifest(tmp_path / "list.parquet")
