"""Submissions in JSON as StreamMapNet and MapTracker write them: elements per frame token, without poses or truth."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import orjson
from numpy.typing import NDArray

from mapfusion.elements import FrameMap, RegionOfInterest
from predmapnet.datasets.source import Frame
from predmapnet.errors import UserError
from predmapnet.evaluation.frames_io import refuse_pickle

Float = NDArray[np.float64]
Integer = NDArray[np.int64]


@dataclass(frozen=True)
class SubmittedFrame:
    """The elements of one frame.

    Attributes:
        kinds: ``(n,) int64``; ids 0 ped_crossing, 1 divider, 2 boundary.
        scores: ``(n,) float64``.
        track_ids: ``(n,) int64``; -1 where the submission has none.
        polylines: arrays ``(k, 2) float64``, metres, ego frame.
    """

    kinds: Integer
    scores: Float
    track_ids: Integer
    polylines: tuple[Float, ...]

    def at(self, frame: Frame, roi: RegionOfInterest) -> FrameMap:
        """Put the elements where and when the data set says that the frame was taken."""
        return FrameMap(
            frame.timestamp, frame.ego_to_global, roi, self.kinds, self.scores, self.track_ids, self.polylines
        )


def read_submission(path: Path) -> Mapping[str, SubmittedFrame]:
    """Read a submission: ``{"results": {token: {"vectors": ..., "scores": ..., "labels": ...}}}``.

    ``vectors`` are lists of ``[x, y]`` (further coordinates are dropped), metres, ego frame. ``global_ids``, a list
    with one id per vector, gives the tracks where it is present.

    Args:
        path: JSON file.

    Returns:
        The frames by the data set's token.

    Raises:
        UserError: no such file, a pickle, no JSON, or a frame that is not as described; the message names it.
    """
    if not path.is_file():
        raise UserError(f"There is no file {path}.")
    refuse_pickle(path)
    try:
        content = orjson.loads(path.read_bytes())
    except orjson.JSONDecodeError as error:
        raise UserError(f"{path} is not valid JSON: {error}.") from error
    results = content.get("results") if isinstance(content, dict) else None
    if not isinstance(results, dict):
        raise UserError(f"{path} is no submission: it has no object 'results' with one entry per frame token.")
    return {token: _frame_of(f"{path}, frame {token}", entry) for token, entry in results.items()}


def _frame_of(where: str, entry: Any) -> SubmittedFrame:
    missing = [key for key in ("vectors", "scores", "labels") if key not in entry]
    if missing:
        raise UserError(f"{where}: {' and '.join(missing)} missing.")
    try:
        kinds = np.array(entry["labels"], dtype=np.int64).reshape(-1)
        scores = np.array(entry["scores"], dtype=np.float64).reshape(-1)
        polylines = tuple(np.array(vector, dtype=np.float64)[:, :2] for vector in entry["vectors"])
        track_ids = np.array(entry.get("global_ids", [-1] * len(kinds)), dtype=np.int64).reshape(-1)
    except (TypeError, ValueError, IndexError) as error:
        raise UserError(
            f"{where}: vectors, scores, labels or global_ids are not numbers as expected: {error}."
        ) from error
    counts = (len(polylines), len(scores), len(kinds), len(track_ids))
    if len(set(counts)) != 1:
        raise UserError(f"{where}: {counts[0]} vectors, {counts[1]} scores, {counts[2]} labels and {counts[3]} ids.")
    return SubmittedFrame(kinds, scores, track_ids, polylines)
