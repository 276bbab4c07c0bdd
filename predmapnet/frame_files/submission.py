"""Submissions in JSON as StreamMapNet and MapTracker write them: elements per frame, without poses or truth.

Two layouts are read; further keys are ignored.

* ``submission_vector.json``: ``{"results": {token: {"vectors", "scores", "labels"}}}``. The token is the sample token
  on nuScenes and the lidar time stamp on Argoverse 2 (``<log>_<timestamp>`` is taken too). A frame without predictions
  may be absent. It carries no tracks, unless an entry has ``global_ids`` beside the rest.
* The content of ``pos_predictions.pkl``, saved as JSON: a list of ``{"scene_name", "local_idx", "vectors", "scores",
  "labels", "global_ids"}``, tracked elements only.

A vector is a list of ``[x, y]``, further coordinates dropped, or the flat list ``x0, y0, x1, y1, ...``; metres, ego
frame (x forward, y left). Labels are 0 ped_crossing, 1 divider, 2 boundary. An entry may say what ground could be seen
with ``visible``, a list of rings, which are lists of points like vectors; a ring within another is a hole.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mapfusion.arrays import Float, Integer
from mapfusion.elements import ElementKind, FrameMap, RegionOfInterest
from predmapnet.datasets.fields import EXACT, numbers
from predmapnet.datasets.large_tables import parse_json
from predmapnet.errors import UserError
from predmapnet.frame_files.parquet import refuse_pickle
from predmapnet.scenes import Instant

_ENOUGH_TO_JUDGE = 10
"""Number of elements from which on frames whose points all lie in [0, 1] are taken to be normalised."""
_NORMALISED_REACH = 0.55
"""Normalised coordinates lie this close to 0.5; they may leave [0, 1] a little."""


@dataclass(frozen=True)
class SubmittedFrame:
    """The elements of one frame.

    Attributes:
        kinds: ``(n,) int64``; ids 0 ped_crossing, 1 divider, 2 boundary.
        scores: ``(n,) float64``.
        track_ids: ``(n,) int64``; -1 where the submission has none.
        polylines: arrays ``(k, 2) float64``, metres, ego frame.
        visible: rings around the ground that could be seen, as in ``FrameMap.visible``; None for all.
    """

    kinds: Integer
    scores: Float
    track_ids: Integer
    polylines: tuple[Float, ...]
    visible: tuple[Float, ...] | None = None

    def at(self, instant: Instant, roi: RegionOfInterest) -> FrameMap:
        """Return the elements as a frame map with the time and pose of an instant."""
        return FrameMap(
            instant.timestamp,
            instant.ego_to_global,
            roi,
            self.kinds,
            self.scores,
            self.track_ids,
            self.polylines,
            visible=self.visible,
        )


NOTHING = SubmittedFrame(np.zeros(0, dtype=np.int64), np.zeros(0), np.zeros(0, dtype=np.int64), ())


def position_name(scene: str, index: int) -> str:
    """Return the name of a frame in :func:`read_submission` if the file gives its scene and its index there."""
    return f"{scene}/{index}"


def read_submission(path: Path, notes: list[str] | None = None) -> dict[str, SubmittedFrame]:
    """Read a submission in one of the layouts above.

    Args:
        path: JSON file.
        notes: receives what was left out.

    Returns:
        The frames by the data set's token, or by :func:`position_name`.

    Raises:
        UserError: no such file, a pickle, no JSON, or a frame that is not as described; the message names it.
    """
    results = load_results(path)
    if is_maptr(results):
        raise UserError(
            f"{path} is a result file of MapTR (a list with 'sample_token'), whose classes have other numbers and "
            "whose axes on nuScenes are the lidar's. Convert it first: labels by cls_name to 0 ped_crossing, "
            "1 divider, 2 boundary, and on nuScenes (x, y) to (y, -x)."
        )
    return submitted_frames(path, results, notes)


def submitted_frames(
    path: Path, results: Any, notes: list[str] | None = None, metres: bool = True
) -> dict[str, SubmittedFrame]:
    """Check and convert what :func:`load_results` returned, the frames of whatever detector.

    Elements of classes that a map does not have (centerlines, for example) are left out.

    Args:
        path: of the file, for messages.
        results: in one of the layouts above.
        notes: receives what was left out.
        metres: refuse points that all lie between 0 and 1.

    Returns, raises: as :func:`read_submission`.
    """
    entries: dict[str, Any] = {}
    for name, entry in _entries(path, results):
        if name in entries:
            raise UserError(f"{path} holds the frame {name} twice.")
        entries[name] = entry
    left_out: Counter[str] = Counter()
    frames = {name: _frame_of(f"{path}, frame {name}", entry, left_out) for name, entry in entries.items()}
    if not frames:
        raise UserError(f"{path} holds no frame.")
    if metres:
        _check_metres(path, frames)
    if notes is not None:
        notes.extend(f"{count} elements of the class {name} are left out" for name, count in sorted(left_out.items()))
    return frames


def load_results(path: Path) -> Any:
    """Load a JSON file of results: the content of its key ``results``, or all of it. Raises UserError."""
    if not path.is_file():
        raise UserError(f"There is no file {path}.")
    refuse_pickle(path)
    data = path.read_bytes()
    # Python's own writer puts NaN into files; it is read, so that the element that holds it can be named.
    content = parse_json(data, path)
    results = content.get("results") if isinstance(content, dict) else content
    if isinstance(results, dict):
        held = sum(len(entry) if isinstance(entry, list) else 1 for entry in results.values())
        if data.count(b'"vectors"') + data.count(b'"pts"') > held:  # it may hold a frame twice
            parse_json(data, path, unique=True)
    return results


def is_maptr(results: Any) -> bool:
    """Whether loaded results have MapTR's layout: a list of entries with ``sample_token``."""
    return isinstance(results, list) and any("sample_token" in entry for entry in results if isinstance(entry, dict))


def _entries(path: Path, results: Any) -> Iterator[tuple[str, Any]]:
    """Yield the name and the entry of each frame, in either layout."""
    if isinstance(results, dict):
        yield from results.items()
    elif isinstance(results, list):
        for number, entry in enumerate(results):
            if isinstance(entry, dict) and "sample_token" in entry:
                yield str(entry["sample_token"]), entry
                continue
            if not isinstance(entry, dict) or "scene_name" not in entry or "local_idx" not in entry:
                raise UserError(
                    f"{path}, entry {number}: a list of frames needs sample_token, or scene_name and local_idx."
                )
            yield position_name(entry["scene_name"], entry["local_idx"]), entry
    else:
        raise UserError(f"{path} is no submission: it has no object 'results' with one entry per frame token.")


def _frame_of(where: str, entry: Any, left_out: Counter[str]) -> SubmittedFrame:
    if not isinstance(entry, dict):
        raise UserError(f"{where}: an object with vectors, scores and labels is expected, not {str(entry)[:40]}.")
    missing = [key for key in ("vectors", "scores", "labels") if key not in entry]
    if missing:
        raise UserError(f"{where}: {' and '.join(missing)} missing.")
    kinds = _kinds(where, entry["labels"])
    scores = _numbers(f"{where}, scores", entry["scores"], np.float64)
    ids = entry.get("global_ids")
    track_ids = np.full(len(kinds), -1) if ids is None else _numbers(f"{where}, global_ids", ids, np.int64)
    if not isinstance(entry["vectors"], list):
        raise UserError(f"{where}: vectors must be a list.")
    polylines = tuple(_polyline(f"{where}, vector {row}", vector) for row, vector in enumerate(entry["vectors"]))
    counts = (len(polylines), len(scores), len(kinds), len(track_ids))
    if len(set(counts)) != 1:
        raise UserError(f"{where}: {counts[0]} vectors, {counts[1]} scores, {counts[2]} labels and {counts[3]} ids.")
    rings = entry.get("visible")
    if rings is not None and not isinstance(rings, list):
        raise UserError(f"{where}: visible must be a list of rings.")
    visible = None if rings is None else tuple(_polyline(f"{where}, visible ring {i}", r) for i, r in enumerate(rings))
    kept = [row for row, kind in enumerate(kinds) if isinstance(kind, ElementKind)]
    left_out.update(str(kind) for kind in kinds if not isinstance(kind, ElementKind))
    return SubmittedFrame(
        np.array([kinds[row] for row in kept], dtype=np.int64),
        scores[kept],
        track_ids[kept],
        tuple(polylines[row] for row in kept),
        visible,
    )


def _kinds(where: str, labels: Any) -> list[ElementKind | str]:
    """Return the kinds of labels, numbers or names; those that a map does not have as texts."""
    if not isinstance(labels, list):
        raise UserError(f"{where}: labels must be a list, not {str(labels)[:40]}.")
    kinds: list[ElementKind | str] = []
    for label in labels:
        if isinstance(label, str) and not label.strip().lstrip("-").isdigit():
            kinds.append(ElementKind.__members__.get(label.strip().upper(), label.strip()[:40]))
            continue
        (number,) = _numbers(f"{where}, labels", [label], np.int64).tolist()
        kinds.append(ElementKind(number) if number in list(ElementKind) else f"number {number}")
    return kinds


def _numbers(where: str, values: Any, kind: type[np.generic]) -> NDArray[Any]:
    try:
        found = numbers(values)
    except ValueError as error:
        raise UserError(f"{where} are not numbers: {error}.") from error
    if found.ndim != 1:
        raise UserError(f"{where} are no list of numbers: {str(values)[:40]}.")
    if kind is np.int64 and not ((np.abs(found) < EXACT) & (found == np.round(found))).all():
        raise UserError(f"{where} are not all whole numbers: {found.tolist()[:5]}.")
    return found.astype(kind)


def _polyline(where: str, vector: Any) -> Float:
    try:
        points = numbers(vector)
    except ValueError as error:
        raise UserError(f"{where} is not a list of points: {error}.") from error
    if points.ndim == 1 and points.size % 2 == 0:
        return points.reshape(-1, 2)
    if points.ndim != 2 or points.shape[1] < 2:
        raise UserError(f"{where} has the shape {points.shape}; points as [x, y] or x0, y0, x1, y1, ... are expected.")
    return points[:, :2]


def _check_metres(path: Path, frames: Mapping[str, SubmittedFrame]) -> None:
    held = [frame.polylines for frame in frames.values() if frame.polylines]
    normalised = [lines for lines in held if all((np.abs(line - 0.5) <= _NORMALISED_REACH).all() for line in lines)]
    about_zero = all((np.abs(line) <= 1.0).all() for lines in held for line in lines)
    if about_zero and len(normalised) < len(held) and sum(map(len, held)) >= _ENOUGH_TO_JUDGE:
        raise UserError(f"{path}: all points lie between -1 and 1, so they are normalised; metres are expected.")
    if sum(map(len, normalised)) < _ENOUGH_TO_JUDGE:
        return
    if len(normalised) < len(held):
        raise UserError(
            f"{path} mixes frames in metres with normalised ones: in {len(normalised)} of {len(held)} frames with "
            "elements, all points lie between 0 and 1. Metres are expected."
        )
    raise UserError(
        f"{path}: all points lie between 0 and 1, so they are normalised; metres are expected. "
        "integrate reads them with --normalised, as shares of the sides of the region (--roi)."
    )
