"""State of the integrator, in memory and on disk: arrays and JSON in one ``.npz`` file, no pickle."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from mapfusion import json_text
from mapfusion.array_files import read_arrays
from mapfusion.elements import ElementKind
from mapfusion.files import write_whole
from mapfusion.integrate.config import IntegratorConfig
from mapfusion.integrate.evidence import Evidence
from mapfusion.integrate.frame_log import DriveLog, FrameLog
from mapfusion.integrate.fused_line import FusedLine
from mapfusion.integrate.fused_ring import FusedRing
from mapfusion.integrate.station_curve import StationCurve
from mapfusion.integrate.uncertainty import ErrorModel
from mapfusion.integrate.views import ViewGrid

STATE_VERSION = 3
"""Version of the file's layout; files of another version are refused."""

Holder = TypeVar("Holder")


@dataclass
class IntegratorState:
    """State of a map integrator; all else that it holds follows from this.

    Attributes:
        config: assumptions about the detector and the road.
        rejections: number of frames and elements left out, by reason.
        frames: number of frames that were fused.
        next_id: id of the next new element.
        frame_log: which frames of which drives were taken in.
        errors: model of the detector's errors, learnt so far.
        lines: dividers and boundaries by id.
        rings: crossings by id.
        views: how often the car has looked where.
    """

    config: IntegratorConfig = field(default_factory=IntegratorConfig)
    rejections: Counter[str] = field(default_factory=Counter)
    frames: int = 0
    next_id: int = 0
    frame_log: FrameLog = field(default_factory=FrameLog)
    errors: ErrorModel = field(default_factory=ErrorModel)
    lines: dict[int, FusedLine] = field(default_factory=dict)
    rings: dict[int, FusedRing] = field(default_factory=dict)
    views: ViewGrid = field(init=False)

    def __post_init__(self) -> None:
        self.views = ViewGrid(self.config)


def save_state(state: IntegratorState, path: Path) -> None:
    """Write the state of an integrator; the file appears complete or not at all. Raises OSError."""
    lines, rings, tiles = state.lines, state.rings, state.views.tiles
    curves = [line.curve for line in lines.values()]
    header = {
        "format": STATE_VERSION,
        "config": asdict(state.config),
        "rejections": dict(state.rejections),
        "frames": state.frames,
        "next_id": state.next_id,
        "logs": {log: [drive.times, drive.positions, drive.believed] for log, drive in state.frame_log.logs.items()},
        "lines": [
            {
                "id": i,
                "kind": int(line.kind),
                "count": len(line.curve),
                "first": line.first,
                "evidence": _plain(line.evidence),
            }
            for i, line in lines.items()
        ],
        "rings": [
            {
                "id": i,
                "corner": ring.corner.tolist(),
                "shape": ring.looked.shape,
                "seen": ring.seen,
                "scatter": ring.scatter,
                "evidence": _plain(ring.evidence),
            }
            for i, ring in rings.items()
        ],
        "tiles": list(tiles),
    }
    arrays = {
        "header": np.frombuffer(json.dumps(header).encode(), dtype=np.uint8),
        "points": _flat(curves, lambda curve: curve.points.ravel(), np.float64),
        "sums": _flat(curves, lambda curve: curve.sums.ravel(), np.float64),
        "marks": _flat(curves, lambda curve: curve.marks.ravel(), np.uint64),
        "ring_marks": _flat(rings.values(), lambda ring: ring.marks, np.uint64),
        "errors": state.errors.state(),
        "ring_distance": _flat(rings.values(), lambda ring: ring.distance.ravel(), np.float32),
        "ring_looked": _flat(rings.values(), lambda ring: ring.looked.ravel(), np.float32),
        "ring_seen_view": _flat(rings.values(), lambda ring: ring.seen_view.ravel(), np.float32),
        "views": _flat(tiles.values(), lambda tile: tile.ravel(), np.float32),
    }
    with write_whole(path) as temporary, temporary.open("wb") as file:
        np.savez_compressed(file, allow_pickle=False, **arrays)


def load_state(path: Path) -> IntegratorState:
    """Read the state that :func:`save_state` wrote; raises ValueError for other files, OSError."""
    try:
        arrays = read_arrays(path)
        header = json_text.parse(arrays["header"].tobytes())
        version = header.get("format")
        state = _restored(header, arrays) if version == STATE_VERSION else None
    except (KeyError, ValueError, TypeError, AttributeError, IndexError, OverflowError) as error:
        raise ValueError(f"{path}: not the saved state of a map integrator: {error}") from error
    if state is None:
        raise ValueError(f"{path}: layout {version} of another version; this one reads {STATE_VERSION}")
    return state


def _restored(header: dict[str, Any], arrays: dict[str, NDArray[Any]]) -> IntegratorState:
    state = IntegratorState(
        config=IntegratorConfig(**header["config"]),
        rejections=Counter(header["rejections"]),
        frames=header["frames"],
        next_id=header["next_id"],
        errors=ErrorModel.from_state(arrays["errors"]),
    )
    state.frame_log.logs = {
        log: DriveLog(number, times, [(x, y) for x, y in positions], believed)
        for number, (log, (times, positions, believed)) in enumerate(header["logs"].items())
    }
    curves = StationCurve(
        arrays["points"].astype(np.float64).reshape(-1, 2),
        arrays["sums"].astype(np.float64).reshape(-1, 5),
        arrays["marks"].astype(np.uint64).reshape(-1, 2),
    )
    at = 0
    for entry in header["lines"]:
        curve = curves.part(at, at + entry["count"]).copy()
        line = FusedLine(ElementKind(entry["kind"]), curve, _evidence(entry["evidence"]), entry["first"])
        state.lines[entry["id"]] = line
        at += len(curve)
    at = 0
    for entry, marks in zip(header["rings"], arrays["ring_marks"].reshape(-1, 2), strict=True):
        shape = tuple(entry["shape"])
        part = slice(at, at + shape[0] * shape[1])
        distance, looked, seen_view = (
            arrays[name][part].reshape(shape) for name in ("ring_distance", "ring_looked", "ring_seen_view")
        )
        corner = np.array(entry["corner"], dtype=np.int64)
        evidence = _evidence(entry["evidence"])
        ring = FusedRing(corner, distance, looked, seen_view, entry["seen"], evidence, entry["scatter"], marks.copy())
        state.rings[entry["id"]] = ring
        at = part.stop
    tiles = [(int(row), int(column)) for row, column in header["tiles"]]
    side = state.views.side
    state.views.tiles = dict(zip(tiles, arrays["views"].reshape(len(tiles), side, side).copy(), strict=True))
    return state


def _flat(items: Iterable[Holder], part: Callable[[Holder], NDArray[Any]], dtype: type) -> NDArray[Any]:
    return np.concatenate([np.zeros(0, dtype), *(part(item) for item in items)])


def _plain(evidence: Evidence) -> list[Any]:
    tracks = [[*track, count] for track, count in evidence.tracks.items()]
    return [evidence.first_seen, evidence.last_seen, evidence.observations, tracks, list(evidence.beside.items())]


def _evidence(plain: list[Any]) -> Evidence:
    first, last, observations, tracks, beside = plain
    return Evidence(first, last, observations, {(log, track): count for log, track, count in tracks}, dict(beside))
