"""Folders on a disk and in an object store behave alike: files are whole or not there, and whoever reads finds them."""

from __future__ import annotations

import pickle
import socket

import pytest

from predmapnet.errors import UserError
from predmapnet.runs.output_folder import OutputFolder


@pytest.fixture(params=["disk", "store"])
def folder(request, tmp_path) -> OutputFolder:
    if request.param == "disk":
        found = OutputFolder(str(tmp_path / "maps" / "city"))
    else:
        found = OutputFolder(request.getfixturevalue("bucket") + "/maps/city")
    found.prepare()
    return found


def test_what_is_written_is_whole_and_found_by_all(folder):
    assert folder.names() == set()
    with folder.write("a.json") as temporary:
        temporary.write_bytes(b"one")
        assert "a.json" not in folder.names()
    with pytest.raises(RuntimeError, match="stopped"), folder.write("b.json") as temporary:
        temporary.write_bytes(b"half")
        raise RuntimeError("stopped")
    with folder.staged() as place:
        (place / "c.geojson").write_bytes(b"two")
    elsewhere = pickle.loads(pickle.dumps(folder))
    assert elsewhere.names() == {"a.json", "c.geojson"}
    assert dict(elsewhere.read(["a.json", "c.geojson"])) == {"a.json": b"one", "c.geojson": b"two"}
    elsewhere.remove("a.json")
    elsewhere.remove("a.json")
    assert folder.names() == {"c.geojson"}
    assert folder.link("c.geojson").endswith("maps/city/c.geojson")


def test_a_store_that_cannot_be_reached_is_told(monkeypatch):
    pytest.importorskip("s3fs")
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    monkeypatch.setenv("AWS_ENDPOINT_URL", f"http://127.0.0.1:{port}")
    monkeypatch.setenv("AWS_MAX_ATTEMPTS", "1")
    for name in ("AWS_ACCESS_KEY_ID", "AWS_SECRET_ACCESS_KEY"):
        monkeypatch.setenv(name, "testing")
    with pytest.raises(UserError, match="s3://nowhere"):
        OutputFolder("s3://nowhere/maps").prepare()
    with pytest.raises(UserError, match="thing"):
        OutputFolder("thing://maps").prepare()
