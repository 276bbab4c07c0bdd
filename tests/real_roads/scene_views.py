"""Scenes that are other scenes seen differently; each is a :class:`predmapnet.scenes.Scene` itself."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

from mapfusion.arrays import Float
from mapfusion.elements import GlobalMap, RegionOfInterest
from mapfusion.georeference import Georeference
from predmapnet.scenes import (
    STANDARD_REGION,
    Camera,
    Frame,
    FrameTruth,
    Instant,
    Rig,
    Scene,
    SceneInfo,
)


class SceneView:
    """A scene that passes everything on; what differs is overridden."""

    def __init__(self, scene: Scene) -> None:
        self.scene = scene

    @property
    def info(self) -> SceneInfo:
        return replace(self.scene.info, frames=len(self))

    @property
    def rig(self) -> Rig:
        return self.scene.rig

    @property
    def georeference(self) -> Georeference | None:
        return self.scene.georeference

    def __len__(self) -> int:
        return len(self.scene)

    def frame(self, index: int) -> Frame:
        return self.scene.frame(index)

    def instant(self, index: int) -> Instant:
        return self.scene.instant(index)

    def lidar(self, index: int) -> Float | None:
        return self.scene.lidar(index)

    def truth(self, index: int, roi: RegionOfInterest) -> FrameTruth | None:
        return self.scene.truth(index, roi)

    def truths(self, roi: RegionOfInterest, cache: Path | None = None) -> list[FrameTruth] | None:
        return self.scene.truths(roi, cache)

    def truth_map(self, roi: RegionOfInterest = STANDARD_REGION) -> GlobalMap | None:
        return self.scene.truth_map(roi)


class ChosenFrames(SceneView):
    """Some frames of a scene, counted anew from 0."""

    def __init__(self, scene: Scene, rows: Sequence[int]) -> None:
        super().__init__(scene)
        self.rows = list(rows)

    def __len__(self) -> int:
        return len(self.rows)

    def frame(self, index: int) -> Frame:
        return replace(self.scene.frame(self.rows[index]), index=index)

    def instant(self, index: int) -> Instant:
        return self.scene.instant(self.rows[index])

    def lidar(self, index: int) -> Float | None:
        return self.scene.lidar(self.rows[index])

    def truth(self, index: int, roi: RegionOfInterest) -> FrameTruth | None:
        return self.scene.truth(self.rows[index], roi)

    def truths(self, roi: RegionOfInterest, cache: Path | None = None) -> list[FrameTruth] | None:
        """Return the truth of the chosen frames; nothing is kept in ``cache``."""
        found = [self.scene.truth(row, roi) for row in self.rows]
        return None if any(truth is None for truth in found) else [truth for truth in found if truth is not None]


def every(scene: Scene, step: int) -> Scene:
    """Return every ``step``-th frame of a scene."""
    return scene if step == 1 else ChosenFrames(scene, range(0, len(scene), step))


def moved_rig(rig: Rig, mounting: Callable[[Camera], Float]) -> Rig:
    """Return a rig whose cameras sit where ``mounting`` says (``camera_to_ego``, ``(4, 4)``)."""
    return tuple(replace(camera, camera_to_ego=mounting(camera)) for camera in rig)
