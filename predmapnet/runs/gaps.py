"""Oddities of a run: images that it lacked, how its car drove, an empty map. They are said, and written down."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

from predmapnet.datasets.plausibility import drives_backwards
from predmapnet.mapping import SceneRun
from predmapnet.scenes import Frame

BACKWARDS = (
    "By its poses the car drives sideways or backwards throughout: the map is right only if it did (x of the ego frame "
    "points forward; headings are in radians)."
)


def missing_images(frames: Iterable[Frame]) -> dict[str, int]:
    """Return the number of frames without an image, by name of the camera; empty if none is missing."""
    return dict(Counter(camera.name for frame in frames for camera in frame.rig if camera.name not in frame.images))


def missing_sentence(missing: Mapping[str, int], frames: int) -> str:
    """Return what the user should know of missing images."""
    cameras = ", ".join(f"{camera} in {count} of {frames} frames" for camera, count in missing.items())
    return f"Images are missing ({cameras}): what only these cameras saw is not in the map."


def empty_sentence(frames: int) -> str:
    """Return what the user should know of a map without elements."""
    return f"The map is empty: nothing was found often enough in {frames} frames."


def with_gaps(provenance: Mapping[str, Any], run: SceneRun) -> tuple[dict[str, Any], tuple[str, ...]]:
    """Return a provenance that tells what its run lacked, and the same as notes for the user."""
    told, notes = dict(provenance), []
    if missing := missing_images(run.frames):
        told["missing_images"] = missing
        notes.append(missing_sentence(missing, len(run.frames)))
    poses = np.array([frame.ego_to_global for frame in run.frames])
    if drives_backwards(poses[:, :3, :3], poses[:, :2, 3]):
        notes.append(BACKWARDS)
    if len(run.global_map) == 0:
        notes.append(empty_sentence(len(run.frames)))
    if notes:
        told["note"] = " ".join([*([told["note"]] if "note" in told else []), *notes])
    return told, tuple(notes)
