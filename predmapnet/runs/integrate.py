"""Fusion of any detector's per-frame results: our Parquet, submissions of MapTracker and kin, results of MapTR."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import shapely

from mapfusion import FrameMap, GlobalMap, MapIntegrator, RegionOfInterest, correct_poses
from mapfusion.ground import seen_along
from mapfusion.provenance import united_provenance
from mapfusion.road_heights import RoadHeights
from predmapnet.errors import UserError
from predmapnet.frame_files.maptr import read_detections
from predmapnet.frame_files.parquet import read_frames
from predmapnet.frame_files.pose_file import FramePose, read_poses
from predmapnet.frame_files.submission import NOTHING, SubmittedFrame, position_name
from predmapnet.mapping import NETWORK_ERRORS, check_left_out
from predmapnet.runs.gaps import empty_sentence

UNTRACKED_SCORE = 0.4
"""Score from which elements without track ids are used."""

NAMED = 3
"""Number of tokens that a message names."""


@dataclass(frozen=True)
class LoggedFrame:
    """The frame map of one instant of one drive."""

    log: str
    frame_map: FrameMap


@dataclass(frozen=True)
class Integration:
    """A map that was fused from per-frame results.

    Attributes:
        map: metric global frame.
        frames: number of frames.
        logs: names of the drives.
        rejections: of the integrator, counted by reason.
        notes: for the user.
        observed: ground seen in the fused frames, global frame, metres.
        provenance: of the frames, if they state any.
    """

    map: GlobalMap
    frames: int
    logs: tuple[str, ...]
    rejections: Mapping[str, int]
    observed: shapely.Geometry
    notes: tuple[str, ...] = ()
    provenance: Mapping[str, Any] = field(default_factory=dict)


def integrate_file(
    frames: Path,
    poses: Path | None = None,
    roi: RegionOfInterest | None = None,
    min_score: float = UNTRACKED_SCORE,
    y_forward: bool = False,
    normalised: bool = False,
    correct: bool = False,
) -> Integration:
    """Read per-frame results and fuse them.

    Args:
        frames: Parquet of ours (poses included), or JSON in the layout of MapTracker or MapTR.
        poses: for JSON; see :func:`predmapnet.frame_files.pose_file.read_poses`.
        roi: region that the detector looked at, for JSON; 60 m x 30 m without.
        min_score: elements below are left out where the file has no track ids, since nothing has picked them.
        y_forward: the file's x points right and its y forward, as MapTR's on nuScenes.
        normalised: points are shares of the region's sides, from 0 to 1, instead of metres.
        correct: take out what the poses of single frames are off, see :func:`mapfusion.correct_poses`.

    Raises:
        UserError: a file that cannot be read, tokens without poses, points that cannot be metres of the ego frame.
    """
    notes: list[str] = []
    provenance: Mapping[str, Any] = {}
    if frames.suffix.lower() == ".parquet":
        if poses is not None:
            raise UserError(f"{frames} holds its poses itself; leave out --poses.")
        stored = read_frames(frames)
        logged = [LoggedFrame(frame.scene, frame.frame_map) for frame in stored.frames]
        provenance = stored.provenance
    else:
        if poses is None:
            raise UserError(f"{frames} holds no poses: give them with --poses poses.json or --poses poses.csv.")
        region = roi or RegionOfInterest()
        submitted = read_detections(frames, notes, region if normalised else None, y_forward)
        known = read_poses(poses, notes)
        logged = _placed(frames, poses, submitted, known, region, min_score, notes)
    if correct:
        logged = _corrected(logged, notes)
    found = integrate_frames(logged)
    if len(found.map) == 0:
        notes.append(empty_sentence(found.frames))
        provenance = united_provenance([provenance, {"note": notes[-1]}])
    return replace(found, notes=tuple(notes), provenance=provenance)


def _corrected(frames: Sequence[LoggedFrame], notes: list[str]) -> list[LoggedFrame]:
    """Correct the poses of each drive, and note by how much."""
    corrected: list[LoggedFrame] = []
    for log in dict.fromkeys(frame.log for frame in frames):
        before = [frame.frame_map for frame in frames if frame.log == log]
        after = correct_poses(before)
        moves = [(b.ego_to_global - a.ego_to_global)[:2, 3] for a, b in zip(before, after, strict=True)]
        size = np.sqrt(np.nanmean(np.square(moves).sum(axis=1)))
        notes.append(f"poses of {log or 'the drive'} corrected by {size:.2f} m on average")
        corrected += [LoggedFrame(log, frame) for frame in after]
    return corrected


def integrate_frames(frames: Iterable[LoggedFrame]) -> Integration:
    """Fuse frames in the order of their times; raises UserError where none can be used."""
    ordered = sorted(frames, key=lambda frame: (frame.log, frame.frame_map.timestamp))
    if not ordered:
        raise UserError("there is no frame to integrate")
    integrator = MapIntegrator(NETWORK_ERRORS)
    fused = []
    for frame in ordered:
        before = integrator.frames
        integrator.add(frame.frame_map, frame.log)
        if integrator.frames > before:
            fused.append(frame.frame_map)
    check_left_out(len(ordered), len(fused), integrator.rejections)
    logs = tuple(dict.fromkeys(frame.log for frame in ordered))
    global_map = RoadHeights.along(fused).lifted_map(integrator.map())
    return Integration(global_map, len(ordered), logs, dict(integrator.rejections), seen_along(fused))


def _placed(
    frames_path: Path,
    poses_path: Path,
    submitted: Mapping[str, SubmittedFrame],
    poses: Mapping[str, FramePose],
    roi: RegionOfInterest,
    min_score: float,
    notes: list[str],
) -> list[LoggedFrame]:
    """Put each frame where its pose says; a pose without a frame is an instant at which nothing was seen."""
    found = _by_name(submitted, poses)
    lost = [token for token in submitted if token not in found]
    if lost:
        some = ", ".join(lost[:NAMED]) + (" ..." if len(lost) > NAMED else "")
        raise UserError(
            f"{len(lost)} of {len(submitted)} frames of {frames_path} have no pose in {poses_path}: {some}. "
            f"Its tokens look like {', '.join(list(poses)[:NAMED])}."
        )
    _check_region(frames_path, submitted.values(), roi)
    _check_scores(frames_path, submitted.values())
    seen = {pose.token: frame for token, frame in submitted.items() for pose in (found[token],)}
    empty = len(poses) - len(seen)
    if empty:
        notes.append(
            f"{empty} poses have no frame in {frames_path.name}: there the detector is taken to have seen nothing"
        )
    tracked = any((frame.track_ids >= 0).any() for frame in submitted.values())
    if not tracked:
        notes.append(
            f"{frames_path.name} has no track ids: elements with a score of at least {min_score:g} are used, "
            "and put together by where they lie"
        )
    placed = [seen.get(pose.token, NOTHING).at(pose, roi) for pose in poses.values()]
    maps = placed if tracked else with_own_ids(placed, min_score)
    return [LoggedFrame(pose.scene, frame_map) for pose, frame_map in zip(poses.values(), maps, strict=True)]


def with_own_ids(frame_maps: Sequence[FrameMap], min_score: float = UNTRACKED_SCORE) -> list[FrameMap]:
    """Give each element with at least this score an id of its own, so that it is fused by where it lies."""
    first = np.cumsum([0, *(len(frame_map) for frame_map in frame_maps)])
    return [
        replace(each, track_ids=np.where(each.scores >= min_score, start + np.arange(len(each)), -1))
        for each, start in zip(frame_maps, first, strict=False)
    ]


def _by_name(submitted: Mapping[str, SubmittedFrame], poses: Mapping[str, FramePose]) -> dict[str, FramePose]:
    """Find poses by token, or by scene and place in it where the frames are named so."""
    if any(token in poses for token in submitted):
        return {token: poses[token] for token in submitted if token in poses}
    scenes: dict[str, list[FramePose]] = {}
    for pose in sorted(poses.values(), key=lambda pose: pose.timestamp):
        scenes.setdefault(pose.scene, []).append(pose)
    places = {position_name(scene, i): pose for scene, own in scenes.items() for i, pose in enumerate(own)}
    return {token: places[token] for token in submitted if token in places}


def _check_scores(path: Path, frames: Iterable[SubmittedFrame]) -> None:
    scores = np.concatenate([np.zeros(0), *(frame.scores for frame in frames)])
    told = scores[np.isfinite(scores)]
    if 2 * ((told < 0.0) | (told > 1.0)).sum() > max(len(scores), 1):
        raise UserError(
            f"{path}: most scores lie outside of 0 to 1 (from {told.min():g} to {told.max():g}). Are they percent, or "
            "logits? Probabilities are expected."
        )


def _check_region(path: Path, frames: Iterable[SubmittedFrame], roi: RegionOfInterest) -> None:
    lines = [line for frame in frames for line in frame.polylines if np.isfinite(line).all()]
    if not lines:
        return
    points = np.concatenate(lines)
    half = roi.size / 2 + 1.0
    outside = float((np.abs(points) > half).any(axis=1).mean())
    if outside > 0.25:
        turned = float((np.abs(points[:, ::-1]) > half).any(axis=1).mean())
        hint = (
            "They fit with x to the right and y forward: add --y-forward."
            if turned < 0.05
            else "Metres of the ego frame, x forward, are expected; --roi LENGTHxWIDTH says how far the detector looks."
        )
        raise UserError(
            f"{path}: {100 * outside:.0f} % of the points lie outside the region of {roi.length:g} m x "
            f"{roi.width:g} m. {hint}"
        )
