"""Results of MapTR in JSON, whose classes have names; submissions are recognised and read, too.

The layout is ``{"results": [{"sample_token", "vectors": [{"pts", "cls_name", "confidence_level"}]}]}``. On nuScenes the
points are in the lidar's axes (x right, y forward), see :func:`turned`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from mapfusion.arrays import Float
from mapfusion.elements import ElementKind
from predmapnet.errors import UserError
from predmapnet.frame_files.submission import SubmittedFrame, is_maptr, load_results, submitted_frames


def read_detections(path: Path) -> dict[str, SubmittedFrame]:
    """Read results of MapTR or a submission (:mod:`predmapnet.frame_files.submission`): frames by token.

    Raises:
        UserError: no such file, a pickle, no JSON, or a frame that is not as described; the message names it.
    """
    results = load_results(path)
    if not is_maptr(results):
        return submitted_frames(path, results)
    entries = [entry if isinstance(entry, dict) else {} for entry in results]
    return {str(entry.get("sample_token")): _maptr_frame(path, entry) for entry in entries}


def _maptr_frame(path: Path, entry: Mapping[str, Any]) -> SubmittedFrame:
    where = f"{path}, frame {entry.get('sample_token')}"
    try:
        vectors = entry["vectors"]
        kinds = np.array([ElementKind[str(v["cls_name"]).upper()] for v in vectors], dtype=np.int64)
        scores = np.array([v["confidence_level"] for v in vectors], dtype=np.float64)
        points = tuple(np.array(v["pts"], dtype=np.float64)[:, :2] for v in vectors)
    except KeyError as error:
        raise UserError(
            f"{where}: {error} is missing or unknown; pts, cls_name (ped_crossing, divider or boundary) and "
            "confidence_level are expected in each vector."
        ) from error
    except (TypeError, ValueError, IndexError) as error:
        raise UserError(f"{where}: the points or scores are not numbers as expected: {error}.") from error
    rings = (
        np.vstack([line, line[:1]])
        if kind == ElementKind.PED_CROSSING and not np.array_equal(line[0], line[-1])
        else line
        for kind, line in zip(kinds, points, strict=True)
    )
    return SubmittedFrame(kinds, scores, np.full(len(kinds), -1), tuple(rings))


def turned(frame: SubmittedFrame) -> SubmittedFrame:
    """Turn a frame from x right, y forward to x forward, y left."""
    visible = None if frame.visible is None else tuple(map(_turn, frame.visible))
    return replace(frame, polylines=tuple(map(_turn, frame.polylines)), visible=visible)


def _turn(line: Float) -> Float:
    return np.column_stack([line[:, 1], -line[:, 0]])
