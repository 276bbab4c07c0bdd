"""Files of an Argoverse 2 log on disk, and their readers."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
import orjson
from numpy.typing import NDArray
from pyarrow import ArrowInvalid, feather

from mapfusion.arrays import Integer
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


def find_logs(root: Path) -> dict[str, Path]:
    """Return log folders by log id: ``root`` itself, its children, or those of its train, val and test folders."""
    if (root / POSES).is_file():
        return {root.name: root}
    patterns = [f"*/{POSES}", *(f"{split}/*/{POSES}" for split in SPLITS)]
    return {path.parent.name: path.parent for pattern in patterns for path in sorted(root.glob(pattern))}


def every_sweep(folder: Path) -> Integer:
    """Time stamps of all lidar sweeps; without lidar files, of front images at the sweeps' rate."""
    sweeps, _ = timed_files(folder / "sensors" / "lidar", ".feather")
    if len(sweeps) == 0 and (folder / SWEEP_LIST).is_file():
        sweeps = np.sort(np.array(_read_json(folder / SWEEP_LIST), dtype=np.int64))
    if len(sweeps):
        return sweeps
    # The front camera runs at twice the lidar's rate.
    images, _ = timed_files(folder / "sensors" / "cameras" / ARGOVERSE2_CAMERAS[0], ".jpg")
    return images[::2]


def timed_files(folder: Path, suffix: str) -> tuple[Integer, list[Path]]:
    """Files named by their time stamps: ``(n,)`` ascending nanoseconds, and the files; empty without folder."""
    files = sorted((int(path.stem), path) for path in folder.glob(f"*{suffix}") if path.stem.isdigit())
    return np.array([time for time, _ in files], dtype=np.int64), [path for _, path in files]


def city(folder: Path) -> str:
    """Three-letter city of a log, from the name of its map file (``..._PIT_city_47896.json``)."""
    for path in sorted((folder / "map").glob("log_map_archive_*.json")):
        found = re.search(r"_([A-Z]{3})_city_", path.name)
        if found:
            return found.group(1)
    return "unknown"


def rows_by_sensor(path: Path) -> dict[str, dict[str, Any]]:
    """Read a calibration table: its rows by sensor. Raises UserError like :func:`read_table`."""
    table = read_table(path)
    return {
        str(name): {column: values[row] for column, values in table.items()}
        for row, name in enumerate(table["sensor_name"])
    }


def read_table(path: Path) -> dict[str, NDArray[Any]]:
    """Read a feather file: its columns by name. Raises UserError if it is missing or damaged."""
    try:
        table = feather.read_table(path)
    except FileNotFoundError:
        raise UserError(f"{path} does not exist. The log is incomplete: fetch it again.") from None
    except (ArrowInvalid, OSError) as error:
        raise UserError(f"{path} is not a readable feather file ({error}). Fetch it again.") from None
    return {name: table.column(name).to_numpy() for name in table.column_names}


def _read_json(path: Path) -> Any:
    try:
        return orjson.loads(path.read_bytes())
    except orjson.JSONDecodeError as error:
        raise UserError(f"{path} is not valid JSON ({error}). Fetch it again.") from None
