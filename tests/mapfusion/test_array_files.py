"""Files of arrays are never unpickled, and never unpacked where they would fill the memory."""

import zipfile

import numpy as np
import pytest

from mapfusion import array_files
from mapfusion.array_files import read_arrays


def test_arrays_come_back_without_those_that_are_not_wanted(tmp_path):
    np.savez_compressed(tmp_path / "a.npz", one=np.arange(3), two=np.arange(4.0))
    assert read_arrays(tmp_path / "a.npz", without=["two"]).keys() == {"one"}
    with pytest.raises(FileNotFoundError):
        read_arrays(tmp_path / "b.npz")


def test_pickles_lies_and_bombs_are_refused(tmp_path, monkeypatch):
    path = tmp_path / "a.npz"
    np.savez(path, objects=np.array([{}], dtype=object))
    with pytest.raises(ValueError, match="allow_pickle"):
        read_arrays(path)
    path.write_bytes(b"PK\x03\x04 cut")
    with pytest.raises(ValueError, match="zip"):
        read_arrays(path)
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("a.npy", b"\x93NUMPY\x01\x00\x20\x00{'descr': '<f8', 'shape': (99,  ")
        archive.writestr("note.txt", b"hello")
    with pytest.raises(ValueError, match="statement"):
        read_arrays(path)
    np.savez_compressed(path, zeros=np.zeros(1_000_000))
    assert path.stat().st_size < 100_000
    monkeypatch.setattr(array_files, "MOST_BYTES", 1 << 20)
    with pytest.raises(ValueError, match="8,000,128 bytes"):
        read_arrays(path)
