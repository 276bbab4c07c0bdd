"""Large JSON tables, read in pieces: exactly what a JSON reader sees in them, without holding all of it."""

from __future__ import annotations

import gc
import mmap
import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import compress
from pathlib import Path
from typing import Any, TypeVar

from mapfusion import json_text
from predmapnet.errors import UserError

Record = dict[str, Any]
Kept = TypeVar("Kept")

PIECE = 8_000_000
"""Bytes that are parsed at a time, about."""

_BETWEEN_RECORDS = re.compile(rb"\}\s*,\s*(?=\{)")
_BEGINNING = re.compile(rb"(?:\xef\xbb\xbf)?\s*\[")


@dataclass(frozen=True)
class Mark:
    """Field by whose text most records of a table can be passed over without being parsed.

    Group 1 of the pattern is its value, and ``wanted`` says whether records of a value are looked at.
    """

    pattern: re.Pattern[bytes]
    wanted: Callable[[bytes], bool]


class _CutInsideError(Exception):
    """A piece is no list of records by itself: the file was cut inside a record or a text."""


def select_records(path: Path, keep: Callable[[Record], Kept | None], mark: Mark | None = None) -> list[Kept]:
    """Parse a JSON list of records and return what ``keep`` makes of them, None left out.

    The file is cut where one record seems to end and the next to begin. A cut in the wrong place (inside a nested list
    or a text) leaves a piece that is no valid JSON; the file is then parsed as a whole. Whatever is valid JSON is read,
    in whatever way it is written; NaN and Infinity, which Python's own writer puts into files, are read, too.

    Args:
        path: the file.
        keep: called with records; None leaves one out.
        mark: tells records that ``keep`` would leave out by their text, where the text allows it (:func:`_marked`).

    Raises:
        UserError: the file is missing, not JSON, or not a list of records.
    """
    try:
        with (
            _no_collection(),
            path.open("rb") as file,
            mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data,
        ):
            return _select_in_pieces(data, path, keep, mark)
    except _CutInsideError:
        return _select(parse_json(path.read_bytes(), path), path, keep)
    except ValueError:  # of mmap
        raise UserError(f"{path} is empty. The file is damaged: fetch it again.") from None
    except OSError as error:
        raise UserError(f"Cannot read {path}: {error.strerror}.") from None


def parse_json(data: bytes, path: Path, unique: bool = False) -> Any:
    """Parse JSON as :func:`mapfusion.json_text.parse` does, but raise UserError."""
    try:
        return json_text.parse(data, unique)
    except ValueError as error:
        raise UserError(f"{path} is not valid JSON: {error}. Is the file whole?") from None


def _select_in_pieces(
    data: mmap.mmap, path: Path, keep: Callable[[Record], Kept | None], mark: Mark | None
) -> list[Kept]:
    opening, end = _BEGINNING.match(data), data.rfind(b"]")
    if opening is None or data[end + 1 :].strip():
        raise _CutInsideError
    found: list[Kept] = []
    start = opening.end()
    while start < end:
        cut = _BETWEEN_RECORDS.search(data, start + PIECE) if start + PIECE < end else None
        stop = end if cut is None else cut.start() + 1
        piece = data[start:stop]
        chosen = None if mark is None else _marked(piece, mark)
        found.extend(_select(_parse(piece if chosen is None else chosen), path, keep))
        start = end if cut is None else cut.end()
    return found


def _parse(piece: bytes) -> Any:
    """Parse records without their list; raises _CutInsideError."""
    try:
        return json_text.parse(b"[%b]" % piece)
    except ValueError:
        raise _CutInsideError from None


def _marked(piece: bytes, mark: Mark) -> bytes | None:
    """Return the records whose mark is wanted, or None where the text does not show for sure which those are.

    It does if nothing is escaped and there are as many marks as opening and as closing braces, all of them but one
    between two records. Then no text holds a brace, since a mark cannot stand inside of a text without escaped quotes,
    and no record holds another, since those would not be between two records.
    """
    opening = piece.count(b"{")
    if b"\\" in piece or piece.count(b"}") != opening:
        return None
    between = _BETWEEN_RECORDS.search(piece)
    separator = b"" if between is None else between.group() + b"{"
    records = piece.strip()[1:-1].split(separator) if separator else [piece.strip()[1:-1]]
    values = mark.pattern.findall(piece)
    if not len(records) == len(values) == opening:
        return None
    chosen = [*compress(records, map(mark.wanted, values))]
    return b"{%b}" % b"},{".join(chosen) if chosen else b""


def _select(records: Any, path: Path, keep: Callable[[Record], Kept | None]) -> list[Kept]:
    if not isinstance(records, list) or set(map(type, records)) - {dict}:
        raise UserError(f"{path} is not a nuScenes table: it must be a list of records.")
    return [kept for record in records if (kept := keep(record)) is not None]


@contextmanager
def _no_collection() -> Iterator[None]:
    """Hold the collector of cycles: it would go through millions of new records, which have none."""
    enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if enabled:
            gc.enable()
