"""Rows of pose files: columns of CSV, and times in any unit."""

from __future__ import annotations

import csv
import math
from collections.abc import Mapping
from decimal import Decimal, InvalidOperation
from pathlib import Path
from typing import Any

from predmapnet.errors import UserError

TIMES = {
    "timestamp": 1,
    "timestamp_ns": 1,
    "timestamp_us": 1_000,
    "timestamp_ms": 1_000_000,
    "timestamp_s": 1_000_000_000,
}
"""Names of the time of a pose, and the nanoseconds of their unit."""
MOST_DIGITS = 18
"""Exponent of the largest time that is looked at."""


def csv_pose_rows(path: Path, how: str) -> list[tuple[str, Mapping[str, Any]]]:
    """Read a CSV file of poses with a head line.

    Args:
        path: the file.
        how: what a file of poses should hold, for messages.

    Returns:
        Place in the file and fields of each row, with ``translation`` (x, y, z) and ``rotation`` (w, x, y, z).

    Raises:
        UserError: no CSV, or columns of the pose are missing.
    """
    try:
        with path.open(encoding="utf-8-sig", newline="") as file:
            reader = csv.DictReader(file)
            rows, names = list(reader), [name.strip() for name in reader.fieldnames or () if name]
    except (UnicodeDecodeError, csv.Error) as error:
        raise UserError(f"{path} is no CSV in UTF-8: {error}. Save it as UTF-8.") from error
    repeated = next((name for name in names if names.count(name) > 1), None)
    if repeated is not None:
        raise UserError(f"{path} has two columns {repeated}. Which is right? Keep one.")
    result: list[tuple[str, Mapping[str, Any]]] = []
    for line, row in enumerate(rows, start=2):
        values: dict[str, Any] = {key.strip(): value for key, value in row.items() if key and value not in (None, "")}
        try:
            values["translation"] = [float(values[axis]) for axis in "xy"] + [float(values.get("z", 0.0))]
            if "yaw" in values:
                half = float(values["yaw"]) / 2
                values["rotation"] = [math.cos(half), 0.0, 0.0, math.sin(half)]
            else:
                values["rotation"] = [float(values[name]) for name in ("qw", "qx", "qy", "qz")]
        except KeyError as error:
            known = f"; the columns are: {', '.join(names)[:80]}" if error.args[0] not in names else ""
            raise UserError(f"{path}, line {line}: {error} is missing{known}. {how}.") from error
        except (TypeError, ValueError) as error:
            raise UserError(f"{path}, line {line}: {error}.") from error
        result.append((f"line {line}", values))
    return result


def time_column(row: Mapping[str, Any]) -> str:
    """Return the name under which a row says its time; ``timestamp`` if it says none."""
    return next((name for name in TIMES if row.get(name) is not None), "timestamp")


def nanoseconds(value: Any, column: str) -> int:
    """Return the nanoseconds of a time in the unit of its column; raises ValueError for no whole number of them."""
    try:
        number = Decimal(str(value).strip())
    except InvalidOperation:
        number = Decimal("NaN")
    if isinstance(value, bool) or not number.is_finite():
        raise ValueError(f"the {column} is no number: {str(value)[:40]!r}")
    if number.adjusted() > MOST_DIGITS:
        raise ValueError(f"the {column} {str(value)[:40]} is too large")
    scaled = number * TIMES[column]
    if column == "timestamp" and scaled != scaled.to_integral_value():
        raise ValueError(
            f"the timestamp {value} is no whole number of nanoseconds; a column timestamp_s, timestamp_ms or "
            "timestamp_us says another unit"
        )
    if not -(2**63) <= scaled < 2**63:
        raise ValueError(f"the {column} {value} is too large")
    return round(scaled)
