"""Large JSON tables, read in pieces: exactly what a JSON reader sees in them, without holding all of it."""

from __future__ import annotations

import json
import mmap
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import orjson

from predmapnet.errors import UserError

Record = dict[str, Any]
Kept = TypeVar("Kept")

PIECE = 8_000_000
"""Bytes that are parsed at a time, about."""

_BETWEEN_RECORDS = re.compile(rb"\}\s*,\s*(?=\{)")
_BEGINNING = re.compile(rb"(?:\xef\xbb\xbf)?\s*\[")
_BYTE_ORDER_MARK = b"\xef\xbb\xbf"


class _CutInsideError(Exception):
    """A piece is no list of records by itself: the file was cut inside a record or a text."""


def select_records(path: Path, keep: Callable[[Record], Kept | None]) -> list[Kept]:
    """Parse a JSON list of records and return what ``keep`` makes of them, None left out.

    The file is cut where one record seems to end and the next to begin. A cut in the wrong place (inside a nested list
    or a text) leaves a piece that is no valid JSON; the file is then parsed as a whole. Whatever is valid JSON is read,
    in whatever way it is written; NaN and Infinity, which Python's own writer puts into files, are read, too.

    Raises:
        UserError: the file is missing, not JSON, or not a list of records.
    """
    try:
        with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
            return _select_in_pieces(data, path, keep)
    except _CutInsideError:
        return _select(parse_json(path.read_bytes(), path), path, keep)
    except ValueError:  # of mmap
        raise UserError(f"{path} is empty. The file is damaged: fetch it again.") from None
    except OSError as error:
        raise UserError(f"Cannot read {path}: {error.strerror}.") from None


def parse_json(data: bytes, path: Path) -> Any:
    """Parse JSON that may begin with a byte-order mark and hold NaN. Raises UserError."""
    data = data.removeprefix(_BYTE_ORDER_MARK)
    try:
        return orjson.loads(data)
    except orjson.JSONDecodeError as error:
        try:
            return json.loads(data)
        except (ValueError, RecursionError):
            raise UserError(f"{path} is not valid JSON ({error}). The file is damaged: fetch it again.") from None


def _select_in_pieces(data: mmap.mmap, path: Path, keep: Callable[[Record], Kept | None]) -> list[Kept]:
    opening, end = _BEGINNING.match(data), data.rfind(b"]")
    if opening is None or data[end + 1 :].strip():
        raise _CutInsideError
    found: list[Kept] = []
    start = opening.end()
    while start < end:
        cut = _BETWEEN_RECORDS.search(data, start + PIECE) if start + PIECE < end else None
        stop = end if cut is None else cut.start() + 1
        piece = b"[%b]" % data[start:stop]
        try:
            records = orjson.loads(piece)
        except orjson.JSONDecodeError:
            try:
                records = json.loads(piece)
            except (ValueError, RecursionError):
                raise _CutInsideError from None
        found.extend(_select(records, path, keep))
        start = end if cut is None else cut.end()
    return found


def _select(records: Any, path: Path, keep: Callable[[Record], Kept | None]) -> list[Kept]:
    if not isinstance(records, list) or not all(isinstance(record, dict) for record in records):
        raise UserError(f"{path} is not a nuScenes table: it must be a list of records.")
    return [kept for record in records if (kept := keep(record)) is not None]
