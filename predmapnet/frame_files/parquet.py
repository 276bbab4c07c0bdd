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
=================  =====================  =================================================================

Files without the column ``visible`` are read, too. Rasters (segmentation, history masks) are not stored.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from mapfusion.elements import FrameMap, RegionOfInterest
from predmapnet.errors import UserError
from predmapnet.files import write_file

Float = NDArray[np.float64]

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

    @property
    def scenes(self) -> tuple[str, ...]:
        """Names of the scenes in the file, in order of appearance."""
        return tuple(dict.fromkeys(frame.scene for frame in self.frames))


class FrameWriter:
    """Writer of frames as they come; the file appears under its name only if all goes well.

    Use it as a context manager. An exception inside leaves no file.

    Args:
        path: the Parquet file; its folder exists.
        provenance: anything that JSON can hold: version, configuration, weights, data set.
    """

    def __init__(self, path: Path, provenance: Mapping[str, Any]) -> None:
        metadata = {_VERSION_KEY: str(SCHEMA_VERSION), _PROVENANCE_KEY: json.dumps(dict(provenance), sort_keys=True)}
        self._schema = _SCHEMA.with_metadata(metadata)
        self._path = path
        self._rows: list[dict[str, Any]] = []
        self._stack = ExitStack()

    def __enter__(self) -> Self:
        temporary = self._stack.enter_context(write_file(self._path))
        self._writer = self._stack.enter_context(pq.ParquetWriter(temporary, self._schema, compression="zstd"))
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if kind is None:
            try:
                self._flush()
            except BaseException as failure:
                self._stack.__exit__(type(failure), failure, failure.__traceback__)
                raise
        self._stack.__exit__(kind, error, trace)

    def write(self, scene: str, index: int, frame_map: FrameMap, token: str = "") -> None:
        """Append one frame."""
        forecasts, visible = frame_map.forecasts, frame_map.visible
        self._rows.append(
            {
                "scene": scene,
                "index": index,
                "token": token,
                "timestamp": frame_map.timestamp,
                "ego_to_global": frame_map.ego_to_global.ravel().tolist(),
                "roi_length": frame_map.roi.length,
                "roi_width": frame_map.roi.width,
                "kinds": frame_map.kinds.tolist(),
                "scores": frame_map.scores.tolist(),
                "track_ids": frame_map.track_ids.tolist(),
                "polylines": [points.ravel().tolist() for points in frame_map.polylines],
                "forecasts": None if forecasts is None else [points.ravel().tolist() for points in forecasts],
                "visible": None if visible is None else [points.ravel().tolist() for points in visible],
            }
        )
        if len(self._rows) >= _ROWS_PER_GROUP:
            self._flush()

    def _flush(self) -> None:
        if self._rows:
            self._writer.write_table(pa.Table.from_pylist(self._rows, schema=self._schema))
            self._rows.clear()


def write_frames(
    path: Path,
    scene: str,
    frame_maps: Sequence[FrameMap],
    provenance: Mapping[str, Any],
    tokens: Sequence[str] | None = None,
) -> None:
    """Write all frames of one scene to a Parquet file, whole or not at all.

    Args:
        path: the file; its folder exists.
        scene: name of the scene.
        frame_maps: frames 0, 1, ... of the scene.
        provenance: anything that JSON can hold.
        tokens: the data set's own names of the frames, if it has any.

    Raises:
        UserError: the file cannot be written.
    """
    with FrameWriter(path, provenance) as writer:
        for index, frame_map in enumerate(frame_maps):
            writer.write(scene, index, frame_map, tokens[index] if tokens else "")


def stored_scenes(path: Path) -> tuple[str, ...]:
    """Names of the scenes in a Parquet file of per-frame results, in order of appearance. Raises UserError."""
    table = _open_table(path, columns=["scene"])
    return tuple(dict.fromkeys(table.column("scene").to_pylist()))


def read_frames(path: Path, scene: str | None = None) -> StoredFrames:
    """Read a Parquet file of per-frame results.

    Args:
        path: the file.
        scene: read this scene only.

    Raises:
        UserError: the file does not exist, is a pickle, is damaged, or has another schema or version.
    """
    table = _open_table(path, filters=None if scene is None else [("scene", "=", scene)])
    frames = tuple(_frame_of(path, row) for row in table.to_pylist())
    return StoredFrames(frames, json.loads((table.schema.metadata or {}).get(_PROVENANCE_KEY, b"{}")))


def refuse_pickle(path: Path) -> None:
    """Raise UserError if ``path`` looks like a pickle by its name or its first bytes."""
    with path.open("rb") as file:
        start = file.read(2)
    if path.suffix in (".pkl", ".pickle") or (start[:1] == b"\x80" and start[1:2] <= b"\x05"):
        raise UserError(
            f"{path} is a Python pickle. Pickles can run any code when they are read, so they are refused: "
            "convert it to a submission JSON or to per-frame Parquet first."
        )


def _open_table(path: Path, **selection: Any) -> pa.Table:
    """Read a selection of a file whose schema is ours."""
    if not path.is_file():
        raise UserError(f"There is no file {path}.")
    refuse_pickle(path)
    try:
        schema = pq.read_schema(path)
        _check_schema(path, schema)
        return pq.read_table(path, **selection)
    except (pa.ArrowException, OSError) as error:
        raise UserError(f"{path} cannot be read as Parquet: {error}. Is it complete?") from error


def _check_schema(path: Path, schema: pa.Schema) -> None:
    version = (schema.metadata or {}).get(_VERSION_KEY, b"").decode()
    if version != str(SCHEMA_VERSION):
        found = f"version {version}" if version else "no version"
        raise UserError(
            f"{path} is no per-frame result that this program reads: it has {found} in its metadata, "
            f"version {SCHEMA_VERSION} is expected. Write it with 'predmapnet infer --save-frames'."
        )
    missing = sorted(set(_SCHEMA.names) - {"visible"} - set(schema.names))
    if missing:
        raise UserError(f"{path} lacks the columns {', '.join(missing)}; write it again with --save-frames.")


def _frame_of(path: Path, row: dict[str, Any]) -> StoredFrame:
    where = f"{path}, scene {row['scene']}, frame {row['index']}"
    pose = np.array(row["ego_to_global"], dtype=np.float64)
    if pose.shape != (16,):
        raise UserError(f"{where}: the pose has {pose.size} numbers instead of 16.")
    forecasts, visible = row["forecasts"], row.get("visible")
    try:
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
        )
    except ValueError as error:
        raise UserError(f"{where}: {error}.") from error
    return StoredFrame(row["scene"], row["index"], row["token"], frame_map)


def _points(numbers: list[float]) -> Float:
    return np.array(numbers, dtype=np.float64).reshape(-1, 2)
