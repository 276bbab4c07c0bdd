"""Files of an Argoverse 2 log on disk, and their readers."""

from __future__ import annotations

import re
from collections.abc import Iterable
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pyarrow import types

from mapfusion.arrays import Integer
from predmapnet.arrow_tables import arrow_errors_told, read_feather
from predmapnet.datasets.large_tables import parse_json
from predmapnet.datasets.splits import SPLITS
from predmapnet.errors import UserError

POSES = "city_SE3_egovehicle.feather"
ARGOVERSE2_CAMERAS = (
    "ring_front_center",
    "ring_front_right",
    "ring_front_left",
    "ring_rear_right",
    "ring_rear_left",
    "ring_side_right",
    "ring_side_left",
)
"""The cameras in the order of the official vector-map data sets."""
SWEEP_LIST = "lidar_timestamps_ns.json"
IMAGE_ENDINGS = (".jpg", ".jpeg", ".png")
_TIME_STAMP = re.compile(r"[0-9]{1,19}")


def find_logs(root: Path) -> dict[str, Path]:
    """Return log folders by log id: ``root`` itself, its children, or those of its train, val and test folders."""
    if (root / POSES).is_file():
        return {root.name: root}
    patterns = [f"*/{POSES}", *(f"{split}/*/{POSES}" for split in SPLITS)]
    return named_apart(path.parent for pattern in patterns for path in sorted(root.glob(pattern)))


def named_apart(folders: Iterable[Path]) -> dict[str, Path]:
    """Return folders by name; where another one had the name before, a number tells them apart."""
    found: dict[str, Path] = {}
    for folder in folders:
        names = (folder.name if number == 1 else f"{folder.name} ({number})" for number in count(1))
        found[next(name for name in names if name not in found)] = folder
    return found


def every_sweep(folder: Path) -> Integer:
    """Time stamps of all lidar sweeps; without lidar files, of front images at the sweeps' rate."""
    sweeps, _ = timed_files(folder / "sensors" / "lidar", ".feather")
    if len(sweeps) == 0 and (folder / SWEEP_LIST).is_file():
        sweeps = _sweep_list(folder / SWEEP_LIST)
    if len(sweeps):
        return sweeps
    # The front camera runs at twice the lidar's rate.
    images, _ = timed_files(folder / "sensors" / "cameras" / ARGOVERSE2_CAMERAS[0], *IMAGE_ENDINGS)
    return images[::2]


def _sweep_list(path: Path) -> Integer:
    """Time stamps of the file that lists them, ascending. Raises UserError."""
    times = parse_json(path.read_bytes(), path)
    if not isinstance(times, list) or not all(type(time) is int and 0 <= time < 2**63 for time in times):
        raise UserError(f"{path} must be a list of time stamps (integer nanoseconds), not {str(times)[:60]}.")
    return np.array(sorted(set(times)), dtype=np.int64)


def timed_files(folder: Path, *endings: str) -> tuple[Integer, list[Path]]:
    """Files named by their time stamps: ``(n,)`` ascending nanoseconds, and the files; empty without folder."""
    found = (path for path in folder.glob("*") if path.suffix.lower() in endings)
    files = sorted(
        (int(path.stem), path) for path in found if _TIME_STAMP.fullmatch(path.stem) and int(path.stem) < 2**63
    )
    return np.array([time for time, _ in files], dtype=np.int64), [path for _, path in files]


def city(folder: Path) -> str:
    """Three-letter city of a log, from the name of its map file (``..._PIT_city_47896.json``)."""
    for path in sorted((folder / "map").glob("log_map_archive_*.json")):
        found = re.search(r"_([A-Z]{3})_city_", path.name)
        if found:
            return found.group(1)
    return "unknown"


def rows_by_sensor(path: Path, columns: tuple[str, ...]) -> dict[str, dict[str, Any]]:
    """Read a calibration table: its rows by sensor. Raises UserError like :func:`read_table`."""
    table = read_table(path, columns, texts=("sensor_name",))
    names = [str(name) for name in table["sensor_name"]]
    if len(set(names)) < len(names):
        repeated = next(name for name in names if names.count(name) > 1)
        raise UserError(f"{path} describes the sensor {repeated} twice. Which is right? Keep one row.")
    return {
        str(name): {column: values[row] for column, values in table.items()}
        for row, name in enumerate(table["sensor_name"])
    }


def read_table(path: Path, columns: tuple[str, ...], texts: tuple[str, ...] = ()) -> dict[str, NDArray[Any]]:
    """Read a feather file, by name the ``columns`` of numbers and the ``texts`` that it must have.

    Raises UserError where the file is missing or damaged, or lacks a column of that kind.
    """
    table = read_feather(path)
    there = table.column_names
    missing = [name for name in (*columns, *texts) if there.count(name) != 1]
    if missing:
        raise UserError(f"{path} lacks the columns {', '.join(missing)}, or has them twice; it has {', '.join(there)}.")
    for name in columns:
        kind = table.schema.field(name).type
        if not (types.is_integer(kind) or types.is_floating(kind)):
            raise UserError(f"{path}: the column {name} must hold numbers, not {kind}.")
    for name in texts:
        kind = table.schema.field(name).type
        if not (types.is_string(kind) or types.is_large_string(kind) or types.is_dictionary(kind)):
            raise UserError(f"{path}: the column {name} must hold texts, not {kind}.")
    with arrow_errors_told(path, "feather"):
        return {name: table.column(name).to_numpy() for name in (*columns, *texts)}
