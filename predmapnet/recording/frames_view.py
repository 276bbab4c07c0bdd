"""Per-frame results of a file in Rerun: the car, its tracks and forecasts and the growing map, without images."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import rerun as rr

from mapfusion.elements import FrameMap, RegionOfInterest
from mapfusion.geometry import rigid_pose_problem
from mapfusion.integrate.integrator import MapIntegrator
from predmapnet.datasets.georeference import georeference_of
from predmapnet.errors import UserError
from predmapnet.frame_files.parquet import read_frames, stored_scenes
from predmapnet.mapping import NETWORK_ERRORS, Step
from predmapnet.recording.recorder import SceneRecorder
from predmapnet.runs.gaps import empty_sentence
from predmapnet.scenes import Frame, Instant, Rig


@dataclass(frozen=True)
class _StoredDrive:
    """Drive of a file, as far as the recorder asks for it."""

    frames: tuple[Frame, ...]
    rig: Rig = ()

    def __len__(self) -> int:
        return len(self.frames)

    def instant(self, index: int) -> Instant:
        frame = self.frames[index]
        return Instant(frame.token, frame.timestamp, frame.ego_to_global)

    def truth_map(self, roi: RegionOfInterest) -> None:
        """A file of results has none."""


def log_frames(
    recording: rr.RecordingStream, path: Path, scene: str | None = None, track: int | None = None
) -> list[str]:
    """Draw the per-frame results of one scene, frame by frame, and the map that they make.

    Args:
        recording: the stream to log into.
        path: Parquet of ours (:mod:`predmapnet.frame_files.parquet`).
        scene: which one of the file; the first without.
        track: id of the track that is picked.

    Returns:
        Notes for the user.

    Raises:
        UserError: the file cannot be read, there is no such scene in it, or no frame with a sound pose.
    """
    names = stored_scenes(path)
    if scene is not None and scene not in names:
        raise UserError(f"{path} holds no scene '{scene}'; it holds {', '.join(names[:5])}.")
    if not names:
        raise UserError(f"{path} holds no frames, so there is nothing to look at.")
    chosen = scene or names[0]
    stored = read_frames(path, chosen)
    drawn = sorted(
        (one for one in stored.frames if rigid_pose_problem(one.frame_map.ego_to_global) is None),
        key=lambda one: one.frame_map.timestamp,
    )
    if not drawn:
        raise UserError(f"{path}: no frame of {chosen} has a sound pose.")
    notes = [] if scene or len(names) == 1 else [f"{path} holds {len(names)} scenes; {chosen} is shown, the first"]
    if lost := len(stored.frames) - len(drawn):
        notes.append(f"{chosen}: {lost} of {len(stored.frames)} frames have broken poses and are left out")
    known = not stored.provenance.get("synthetic")
    place = georeference_of(str(stored.provenance.get("location") or "")) if known else None
    text = f"# {chosen}\n\n{len(drawn)} frames of {path.name}, without images.\n\n{stored.provenance.get('note', '')}"
    recorder = SceneRecorder(recording, text, place=place, track=track)
    frames = tuple(_frame(number, chosen, one.token, one.frame_map) for number, one in enumerate(drawn))
    recorder.begin(_StoredDrive(frames), drawn[0].frame_map.roi)
    integrator = MapIntegrator(NETWORK_ERRORS)
    for frame, one in zip(frames, drawn, strict=True):
        integrator.add(one.frame_map)
        recorder.observe(Step(frame, one.frame_map, {}, True), integrator.map)
    finished = integrator.map()
    recorder.end(finished)
    return notes if len(finished) else [*notes, empty_sentence(len(drawn))]


def _frame(number: int, scene: str, token: str, found: FrameMap) -> Frame:
    return Frame(scene, number, token, found.timestamp, found.ego_to_global, (), {})
