"""Tables of Arrow from anywhere (feather, Parquet): faults told, and not unpacked where they would fill the memory."""

from __future__ import annotations

import struct
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq
from pyarrow import compute, feather

from predmapnet.errors import UserError

MOST_BYTES = 2 << 30
"""A table that takes more when it is unpacked is none of those that drives leave."""
ROWS_AT_A_TIME = 64
_RECORDS, _DICTIONARY = 3, 2
"""Kinds of messages."""


@contextmanager
def arrow_errors_told(path: Path, kind: str) -> Iterator[None]:
    """Raise what Arrow says of a damaged file as a UserError that names ``path`` and the ``kind`` of file."""
    try:
        yield
    except (pa.ArrowException, OSError, ValueError, KeyError, IndexError) as error:
        raise UserError(f"{path} cannot be read as {kind}: {str(error).rstrip('. ')}. Is the file whole?") from error


def read_feather(path: Path) -> pa.Table:
    """Read a feather file. Raises UserError if it is missing, damaged or too large."""
    if not path.is_file():
        raise UserError(f"{path} does not exist. Fetch it again.")
    with arrow_errors_told(path, "feather"):
        with pa.memory_map(str(path)) as file:
            _check_size(path, sum(map(_unpacked, _messages(file.read_buffer()))))
        return feather.read_table(path, memory_map=False)


def open_parquet(path: Path) -> pq.ParquetFile:
    """Open a Parquet file; its rows are not read yet. Raises UserError if it is missing, damaged or too large."""
    if not path.is_file():
        raise UserError(f"There is no file {path}.")
    with arrow_errors_told(path, "Parquet"):
        file = pq.ParquetFile(path)
        # Of its columns nothing is asked here: damaged descriptions of them end the process.
        groups = range(file.metadata.num_row_groups)
        _check_size(path, sum(file.metadata.row_group(index).total_byte_size for index in groups))
    return file


def parquet_rows(
    path: Path, file: pq.ParquetFile, columns: Sequence[str] | None = None, scene: str | None = None
) -> Iterator[dict[str, Any]]:
    """Yield the rows of a Parquet file, a few of which are held at a time; only those of a ``scene`` if one is given.

    Raises UserError, naming ``path``, for damage.
    """
    with arrow_errors_told(path, "Parquet"):
        for batch in file.iter_batches(ROWS_AT_A_TIME, columns=columns):
            chosen = batch if scene is None else batch.filter(compute.equal(batch.column("scene"), scene))
            yield from chosen.to_pylist()


def _check_size(path: Path, unpacked: int) -> None:
    if unpacked > MOST_BYTES:
        raise UserError(
            f"{path} would take {unpacked / (1 << 30):,.0f} GB when it is unpacked, which no such file does. Fetch it "
            "again."
        )


def _messages(data: pa.Buffer) -> Iterator[pa.Message]:
    """Yield the messages of an Arrow file; none of the former layout of feather, which packs nothing."""
    if data[:6].to_pybytes() == b"ARROW1":
        reader = pa.ipc.MessageReader.open_stream(data.slice(8))
        try:
            while True:
                yield reader.read_next_message()
        except StopIteration:
            return


def _unpacked(message: pa.Message) -> int:
    """Return the bytes that the columns of a message take: of packed ones their first eight bytes say it."""
    data = message.metadata.to_pybytes()
    root = _number("<I", data, 0)
    kind = _field(data, root, 1)
    records = _reference(data, _field(data, root, 2))
    if kind is not None and data[kind] == _DICTIONARY:
        records = _reference(data, _field(data, records, 1))
    elif kind is None or data[kind] != _RECORDS:
        return 0
    buffers = _field(data, records, 2)
    if buffers is None or _field(data, records, 3) is None:
        return int(message.body.size)
    at, total = _reference(data, buffers), 0
    for number in range(_number("<I", data, at)):
        offset, length = struct.unpack_from("<qq", data, at + 4 + 16 * number)
        total += max(_number("<q", message.body.slice(offset, 8).to_pybytes(), 0), length) if length >= 8 else length
    return total


def _field(data: bytes, table: int, number: int) -> int | None:
    """Return where a field of a table of flatbuffers lies; None if it is absent."""
    layout = table - _number("<i", data, table)
    place = 4 + 2 * number
    offset = _number("<H", data, layout + place) if place < _number("<H", data, layout) else 0
    return table + offset if offset else None


def _reference(data: bytes, place: int | None) -> int:
    if place is None:
        raise ValueError("its layout is broken")
    return place + _number("<I", data, place)


def _number(form: str, data: bytes, place: int) -> int:
    try:
        return int(struct.unpack_from(form, data, place)[0])
    except struct.error:
        raise ValueError("its layout is broken") from None
