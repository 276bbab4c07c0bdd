"""Results of MapTR and of HDMapNet and its kin in JSON; submissions are recognised and read, too.

Two layouts are turned into that of submissions (:mod:`predmapnet.frame_files.submission`), so that one set of checks
holds for all. A vector is ``{"pts", "cls_name" or "type", "confidence_level"}``; where ``cls_name`` is absent,
``type`` is 0 divider, 1 ped_crossing, 2 boundary, as both families number them.

* MapTR, MapTRv2: ``{"results": [{"sample_token", "vectors": [vector, ...]}]}``.
* HDMapNet, SuperFusion: ``{"results": {token: [vector, ...]}}``.

On nuScenes MapTR's points are in the lidar's axes (x right, y forward), see :func:`turned`.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from mapfusion.arrays import Float
from mapfusion.elements import ElementKind, RegionOfInterest
from predmapnet.errors import UserError
from predmapnet.frame_files.submission import SubmittedFrame, is_maptr, load_results, submitted_frames

TYPES = {0: "divider", 1: "ped_crossing", 2: "boundary"}
"""Names of the classes by number, in the files of MapTR and HDMapNet."""


def read_detections(
    path: Path, notes: list[str], normalised: RegionOfInterest | None = None, y_forward: bool = False
) -> dict[str, SubmittedFrame]:
    """Read results of MapTR, HDMapNet or their kin, or a submission: frames by token, metres of the ego frame.

    Args:
        path: JSON file.
        notes: receives what the user should know of the file.
        normalised: region whose sides the points are shares of; None for points in metres.
        y_forward: x points right and y forward.

    Raises:
        UserError: no such file, a pickle, no JSON, or a frame that is not as described; the message names it.
    """
    results = load_results(path)
    if is_maptr(results):
        results = _without_repeats([_as_submission(path, number, entry) for number, entry in enumerate(results)])
    elif isinstance(results, dict) and any(isinstance(entry, list) for entry in results.values()):
        results = {
            token: _of_vectors(f"{path}, frame {token}", entry) if isinstance(entry, list) else entry
            for token, entry in results.items()
        }
    frames = submitted_frames(path, results, notes, metres=normalised is None)
    return {token: _ready(frame, normalised, y_forward) for token, frame in frames.items()}


def _as_submission(path: Path, number: int, entry: Any) -> dict[str, Any]:
    """Return a frame of MapTR as one of a submission, with its ``sample_token``."""
    token = entry.get("sample_token") if isinstance(entry, dict) else None
    if not isinstance(token, (str, int)) or isinstance(token, bool):
        raise UserError(f"{path}, entry {number}: its sample_token is missing; each frame of such a list needs one.")
    return {"sample_token": str(token), **_of_vectors(f"{path}, frame {token}", entry.get("vectors"))}


def _without_repeats(entries: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Drop frames that were written before: runs on several devices repeat the first ones, to give each as many."""
    first: dict[str, dict[str, Any]] = {}
    for entry in entries:
        first.setdefault(entry["sample_token"], entry)
    return [
        entry for entry in entries if entry is first[entry["sample_token"]] or entry != first[entry["sample_token"]]
    ]


def _of_vectors(where: str, vectors: Any) -> dict[str, Any]:
    """Return vectors with their class and score each as the parallel lists of a submission."""
    if not isinstance(vectors, list):
        raise UserError(f"{where}: a list 'vectors' is expected, not {str(vectors)[:40]}.")
    for number, vector in enumerate(vectors):
        needed = ("pts", "confidence_level")
        missing = [key for key in needed if not isinstance(vector, dict) or key not in vector]
        if missing or ("cls_name" not in vector and "type" not in vector):
            raise UserError(
                f"{where}, vector {number}: {' and '.join(missing) or 'cls_name'} missing; pts, cls_name "
                "(ped_crossing, divider or boundary) and confidence_level are expected in each vector."
            )
    return {
        "vectors": [vector["pts"] for vector in vectors],
        "labels": [vector.get("cls_name", _named(vector.get("type"))) for vector in vectors],
        "scores": [vector["confidence_level"] for vector in vectors],
    }


def _named(number: Any) -> Any:
    return TYPES.get(number, number) if isinstance(number, int) else number


def _ready(frame: SubmittedFrame, normalised: RegionOfInterest | None, y_forward: bool) -> SubmittedFrame:
    """Return a frame in metres, x forward, with closed crossings."""
    if normalised is not None:
        size = normalised.size[::-1] if y_forward else normalised.size
        frame = replace(frame, polylines=tuple((line - 0.5) * size for line in frame.polylines))
    if y_forward:
        frame = turned(frame)
    pairs = zip(frame.kinds.tolist(), frame.polylines, strict=True)
    return replace(frame, polylines=tuple(_closed(line) if ElementKind(kind).is_ring else line for kind, line in pairs))


def _closed(line: Float) -> Float:
    return np.vstack([line, line[:1]]) if len(line) and not np.array_equal(line[0], line[-1]) else line


def turned(frame: SubmittedFrame) -> SubmittedFrame:
    """Turn a frame from x right, y forward to x forward, y left."""
    visible = None if frame.visible is None else tuple(map(_turn, frame.visible))
    return replace(frame, polylines=tuple(map(_turn, frame.polylines)), visible=visible)


def _turn(line: Float) -> Float:
    return np.column_stack([line[:, 1], -line[:, 0]])
