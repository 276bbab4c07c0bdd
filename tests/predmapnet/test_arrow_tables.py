"""Tables of Arrow: how large they are is known before they are unpacked."""

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from pyarrow import feather

from predmapnet import arrow_tables
from predmapnet.arrow_tables import open_parquet, parquet_rows, read_feather
from predmapnet.errors import UserError

ROWS = 200_000
TABLE = pa.table({"zeros": np.zeros(ROWS), "names": pa.array(["a"] * ROWS).dictionary_encode()})
SIZE = 8 * ROWS + 4 * ROWS


@pytest.mark.parametrize("packing", ["lz4", "zstd", "uncompressed"])
def test_a_feather_file_that_would_fill_the_memory_is_not_unpacked(tmp_path, monkeypatch, packing):
    path = tmp_path / "a.feather"
    feather.write_feather(TABLE, path, compression=packing)
    for most in (1.02 * SIZE, 0.98 * SIZE):
        monkeypatch.setattr(arrow_tables, "MOST_BYTES", most)
        if most > SIZE:
            assert read_feather(path).equals(TABLE)
        else:
            with pytest.raises(UserError, match=r"a\.feather would take"):
                read_feather(path)


def test_a_parquet_file_is_read_a_few_rows_at_a_time(tmp_path, monkeypatch):
    path = tmp_path / "a.parquet"
    pq.write_table(pa.table({"scene": ["a", "b"] * 100, "x": np.arange(200)}), path)
    rows = [row["x"] for row in parquet_rows(path, open_parquet(path), ["scene", "x"], scene="b")]
    assert rows == list(range(1, 200, 2))
    monkeypatch.setattr(arrow_tables, "MOST_BYTES", 100)
    with pytest.raises(UserError, match=r"a\.parquet would take"):
        open_parquet(path)


def test_damage_is_told_with_the_file(tmp_path):
    path = tmp_path / "a.feather"
    feather.write_feather(TABLE.slice(0, 3), path)
    path.write_bytes(path.read_bytes()[:300])
    with pytest.raises(UserError, match=r"a\.feather cannot be read as feather"):
        read_feather(path)
    path.write_bytes(b"PAR1")
    with pytest.raises(UserError, match=r"a\.feather cannot be read as Parquet"):
        open_parquet(path)
