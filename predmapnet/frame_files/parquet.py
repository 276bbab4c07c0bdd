"""Per-frame results in Parquet, one row per frame.

Schema, version 1 (``predmapnet_frames`` in the file's metadata; ``predmapnet_provenance`` beside it is JSON):

=================  =====================  =================================================================
column             type                   content
=================  =====================  =================================================================
scene              string                 name of the scene
index              int32                  position of the frame in the scene, from 0
token              string                 the data set's own name of the frame, may be empty
timestamp          int64                  nanoseconds
ego_to_global      list of 16 double      4 x 4 pose, row by row
roi_length, _width double                 metres
kinds              list of int8           0 ped_crossing, 1 divider, 2 boundary
scores             list of double         in [0, 1]
track_ids          list of int64          -1 for an element that is not tracked
polylines          list of list of double x0, y0, x1, y1, ... metres, ego frame
forecasts          list of list of double the same for the next instant; null without a forecaster
visible            list of list of double rings around the ground that could be seen, like polylines; null for all
ground_height      double                 z of the road under the car, metres, ego frame
=================  =====================  =================================================================

Files without the columns ``visible`` and ``ground_height`` are read, too. Rasters (segmentation, history masks) are
not stored.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from mapfusion import json_text
from mapfusion.arrays import Float
from mapfusion.elements import FrameMap, RegionOfInterest
from predmapnet.arrow_tables import arrow_errors_told, open_parquet, parquet_rows
from predmapnet.errors import UserError
from predmapnet.files import write_file

SCHEMA_VERSION = 1
_VERSION_KEY = b"predmapnet_frames"
_PROVENANCE_KEY = b"predmapnet_provenance"
_ROWS_PER_GROUP = 64
_LINES = pa.list_(pa.list_(pa.float64()))
_SCHEMA = pa.schema(
    [
        ("scene", pa.string()),
        ("index", pa.int32()),
        ("token", pa.string()),
        ("timestamp", pa.int64()),
        ("ego_to_global", pa.list_(pa.float64())),
        ("roi_length", pa.float64()),
        ("roi_width", pa.float64()),
        ("kinds", pa.list_(pa.int8())),
        ("scores", pa.list_(pa.float64())),
        ("track_ids", pa.list_(pa.int64())),
        ("polylines", _LINES),
        ("forecasts", _LINES),
        ("visible", _LINES),
        ("ground_height", pa.float64()),
    ]
)


@dataclass(frozen=True)
class StoredFrame:
    """One row of a file.

    Attributes:
        scene, index: of the frame.
        token: the data set's own name of it, empty if it was not stored.
        frame_map: without rasters.
    """

    scene: str
    index: int
    token: str
    frame_map: FrameMap


@dataclass(frozen=True)
class StoredFrames:
    """Content of a file: its frames in file order, and their provenance."""

    frames: tuple[StoredFrame, ...]
    provenance: Mapping[str, Any] = field(default_factory=dict)


def write_frames(path: Path, frames: Iterable[StoredFrame], provenance: Mapping[str, Any]) -> None:
    """Write frames to a Parquet file, whole or not at all.

    Args:
        path: the file; its folder exists.
        frames: in the order of the file; they may come from a generator, and only a few are held at a time.
        provenance: anything that JSON can hold: version, configuration, weights, data set.

    Raises:
        UserError: the file cannot be written.
    """
    metadata = {_VERSION_KEY: str(SCHEMA_VERSION), _PROVENANCE_KEY: json.dumps(dict(provenance), sort_keys=True)}
    schema = _SCHEMA.with_metadata(metadata)
    rows = map(_row_of, frames)
    with write_file(path) as temporary, pq.ParquetWriter(temporary, schema, compression="zstd") as writer:
        while group := list(islice(rows, _ROWS_PER_GROUP)):
            writer.write_table(pa.Table.from_pylist(group, schema=schema))


def _row_of(frame: StoredFrame) -> dict[str, Any]:
    frame_map = frame.frame_map
    return {
        "scene": frame.scene,
        "index": frame.index,
        "token": frame.token,
        "timestamp": frame_map.timestamp,
        "ego_to_global": frame_map.ego_to_global.ravel().tolist(),
        "roi_length": frame_map.roi.length,
        "roi_width": frame_map.roi.width,
        "kinds": frame_map.kinds.tolist(),
        "scores": frame_map.scores.tolist(),
        "track_ids": frame_map.track_ids.tolist(),
        "polylines": _flat(frame_map.polylines),
        "forecasts": _flat(frame_map.forecasts),
        "visible": _flat(frame_map.visible),
        "ground_height": frame_map.ground_height,
    }


def _flat(lines: Sequence[Float] | None) -> list[list[float]] | None:
    return None if lines is None else [points.ravel().tolist() for points in lines]


def stored_scenes(path: Path) -> tuple[str, ...]:
    """Names of the scenes in a Parquet file of per-frame results, in order of appearance. Raises UserError."""
    return tuple(dict.fromkeys(row["scene"] for row in parquet_rows(path, _opened(path), ["scene"])))


def read_frames(path: Path, scene: str | None = None) -> StoredFrames:
    """Read a Parquet file of per-frame results.

    Args:
        path: the file.
        scene: read this scene only.

    Raises:
        UserError: the file does not exist, is a pickle, is damaged, or has another schema or version.
    """
    file = _opened(path)
    frames = tuple(_frame_of(path, row) for row in parquet_rows(path, file, scene=scene))
    try:
        provenance = json_text.parse((file.schema_arrow.metadata or {}).get(_PROVENANCE_KEY, b"{}"))
    except ValueError:
        provenance = None
    if not isinstance(provenance, dict):
        raise UserError(f"{path}: its provenance is not a JSON object; write the file again with --save-frames.")
    return StoredFrames(frames, provenance)


def refuse_pickle(path: Path) -> None:
    """Raise UserError if ``path`` looks like a pickle by its name or its first bytes."""
    with path.open("rb") as file:
        start = file.read(2)
    if path.suffix.lower() in (".pkl", ".pickle") or (start[:1] == b"\x80" and start[1:2] <= b"\x05"):
        raise UserError(
            f"{path} is a Python pickle. Pickles can run any code when they are read, so they are refused: "
            "convert it to a submission JSON or to per-frame Parquet first."
        )


def _opened(path: Path) -> pq.ParquetFile:
    """Open a file whose schema is ours."""
    if path.is_file():
        refuse_pickle(path)
    file = open_parquet(path)
    with arrow_errors_told(path, "Parquet"):
        _check_schema(path, file.schema_arrow)
    return file


def _check_schema(path: Path, schema: pa.Schema) -> None:
    version = (schema.metadata or {}).get(_VERSION_KEY, b"").decode(errors="backslashreplace")
    if version != str(SCHEMA_VERSION):
        found = f"version {version}" if version else "no version"
        raise UserError(
            f"{path} is no per-frame result that this program reads: it has {found} in its metadata, "
            f"version {SCHEMA_VERSION} is expected. Write it with 'predmapnet infer --save-frames'."
        )
    optional = {"visible", "ground_height"} - set(schema.names)
    wrong = [
        field.name
        for field in _SCHEMA
        if field.name not in optional and (schema.names.count(field.name) != 1 or not _alike(schema, field))
    ]
    if wrong:
        raise UserError(
            f"{path} lacks the columns {', '.join(wrong)}, or holds something else in them; write it again with "
            "--save-frames."
        )


def _alike(schema: pa.Schema, wanted: pa.Field) -> bool:
    """Whether a column holds what it should: numbers of any width, texts, or lists of these."""
    found, expected = schema.field(wanted.name).type, wanted.type
    while pa.types.is_list(expected):
        if not (pa.types.is_list(found) or pa.types.is_large_list(found)):
            return False
        found, expected = found.value_type, expected.value_type
    if pa.types.is_string(expected):
        return bool(pa.types.is_string(found) or pa.types.is_large_string(found))
    return bool(pa.types.is_integer(found) or (pa.types.is_floating(found) and pa.types.is_floating(expected)))


def _frame_of(path: Path, row: dict[str, Any]) -> StoredFrame:
    where = f"{path}, scene {row['scene']}, frame {row['index']}"
    forecasts, visible = row["forecasts"], row.get("visible")
    absent = [name for name, value in row.items() if value is None and name not in ("token", "forecasts", "visible")]
    if absent:
        raise UserError(f"{where}: {', '.join(absent)} is null.")
    try:
        pose = np.array(row["ego_to_global"], dtype=np.float64)
        if pose.shape != (16,):
            raise ValueError(f"the pose has {pose.size} numbers instead of 16")
        frame_map = FrameMap(
            timestamp=row["timestamp"],
            ego_to_global=pose.reshape(4, 4),
            roi=RegionOfInterest(row["roi_length"], row["roi_width"]),
            kinds=np.array(row["kinds"], dtype=np.int64),
            scores=np.array(row["scores"], dtype=np.float64),
            track_ids=np.array(row["track_ids"], dtype=np.int64),
            polylines=tuple(_points(line) for line in row["polylines"]),
            forecasts=None if forecasts is None else tuple(_points(line) for line in forecasts),
            visible=None if visible is None else tuple(_points(line) for line in visible),
            ground_height=float(row.get("ground_height", 0.0)),
        )
    except (TypeError, ValueError, OverflowError) as error:
        raise UserError(f"{where}: {error}.") from error
    return StoredFrame(row["scene"], row["index"], row["token"] or "", frame_map)


def _points(numbers: list[float]) -> Float:
    return np.array(numbers, dtype=np.float64).reshape(-1, 2)
