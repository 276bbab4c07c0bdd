"""Values of map files as editors of maps leave them: nulls, numbers and lists as text, times written anew."""

from __future__ import annotations

import math
import re
from datetime import UTC, datetime, timedelta
from typing import Any

import numpy as np

from mapfusion import json_text

EPOCH = datetime(1970, 1, 1, tzinfo=UTC)
_TIME = re.compile(
    r"(\d{4})[-/](\d\d)[-/](\d\d)[T ](\d\d):(\d\d)(?::(\d\d)(?:[.,](\d{1,12}))?)?\s*(Z|[+-]\d\d(?::?\d\d)?)?", re.ASCII
)


def format_timestamp(nanoseconds: int) -> str:
    """Return ISO 8601 UTC with nine digits: ``format_timestamp(1)`` is ``1970-01-01T00:00:00.000000001Z``."""
    seconds, rest = divmod(int(nanoseconds), 1_000_000_000)
    return (EPOCH + timedelta(seconds=seconds)).strftime("%Y-%m-%dT%H:%M:%S") + f".{rest:09d}Z"


def parse_timestamp(text: str) -> int:
    """Return the nanoseconds of a time as :func:`format_timestamp` writes it, or as GDAL and QGIS write it back.

    Those leave fewer digits (or none) after the second, a blank for the T, slashes in the date, or another zone.
    A time without a zone is UTC.

    Raises:
        ValueError: no time.
    """
    match = _TIME.fullmatch(text.strip())
    if match is None:
        raise ValueError(f"not a timestamp of the form 2024-01-31T12:00:00.123456789Z: {text!r}")
    *_, second, fraction, zone = match.groups()
    year, month, day, hour, minute = map(int, match.groups()[:5])
    moment = datetime(year, month, day, hour, minute, int(second or 0), tzinfo=UTC) - EPOCH
    offset = 0
    if zone not in (None, "Z"):
        digits = zone[1:].replace(":", "").ljust(4, "0")
        offset = (int(digits[:2]) * 3600 + int(digits[2:]) * 60) * (-1 if zone[0] == "-" else 1)
    seconds = moment.days * 86_400 + moment.seconds - offset
    return seconds * 1_000_000_000 + int((fraction or "0").ljust(9, "0")[:9])


def time_of(value: Any) -> int | None:
    """Return nanoseconds of a text or a date of numpy; None for null. Raises ValueError."""
    if value is None or value == "" or (isinstance(value, float) and math.isnan(value)):
        return None
    if isinstance(value, np.datetime64):
        return None if np.isnat(value) else int(value.astype("datetime64[ns]").astype(np.int64))
    if not isinstance(value, str):
        raise ValueError(f"not a time: {value!r}")
    return parse_timestamp(value)


def number_of(value: Any) -> float | None:
    """Return a number, also one that is written as text; None for null and NaN. Raises ValueError."""
    if value is None or (isinstance(value, str) and not value.strip()):
        return None
    if isinstance(value, bool) or not isinstance(value, (int, float, str, np.number)):
        raise ValueError(f"not a number: {str(value)[:40]!r}")
    try:
        number = float(value)
    except OverflowError as error:
        raise ValueError("a number that is too large") from error
    if math.isinf(number):
        raise ValueError("not a finite number")
    return None if math.isnan(number) else number


def json_of(text: str | None) -> Any:
    """Return what JSON text holds; None for no text, or for what is no JSON."""
    try:
        return None if text is None else json_text.parse(text.encode())
    except ValueError:
        return None


def list_of(value: Any) -> list[Any] | None:
    """Return a list, also one that is written as JSON text; None for null. Raises ValueError."""
    if isinstance(value, str):
        value = json_text.parse(value.encode()) if value.strip() else None
    if isinstance(value, np.ndarray):
        value = value.tolist()
    if value is None or isinstance(value, list):
        return value
    if isinstance(value, tuple):
        return list(value)
    raise ValueError(f"not a list: {str(value)[:40]!r}")


def whole_numbers_of(value: Any) -> tuple[int, ...]:
    """Return integers of a list; an empty tuple for null. Raises ValueError."""
    whole = []
    for entry in list_of(value) or ():
        number = number_of(entry)
        if number is None or number != round(number):
            raise ValueError(f"not all whole numbers: {str(value)[:40]!r}")
        whole.append(entry if isinstance(entry, int) else int(number))  # large ids are kept to the last digit
    return tuple(whole)
