"""A scene whose ground truth never decides over its mapping."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

from mapfusion.arrays import Float
from mapfusion.elements import GlobalMap, RegionOfInterest
from mapfusion.georeference import Georeference
from predmapnet.scenes import STANDARD_REGION, Frame, FrameTruth, Instant, Rig, Scene, SceneInfo

Found = TypeVar("Found")


class GuardedTruth:
    """Scene that has no ground truth where the scene behind it fails to give it; ``problem`` says why."""

    def __init__(self, scene: Scene) -> None:
        self._scene = scene
        self.problem = ""

    @property
    def info(self) -> SceneInfo:
        """The scene's line in the listing."""
        return self._scene.info

    @property
    def rig(self) -> Rig:
        """The car's cameras."""
        return self._scene.rig

    @property
    def georeference(self) -> Georeference | None:
        """Georeference of the global frame, if it is known."""
        return self._scene.georeference

    def __len__(self) -> int:
        return len(self._scene)

    def frame(self, index: int) -> Frame:
        """Return frame ``index``."""
        return self._scene.frame(index)

    def instant(self, index: int) -> Instant:
        """Return token, time stamp and pose of frame ``index``."""
        return self._scene.instant(index)

    def lidar(self, index: int) -> Float | None:
        """Return the lidar sweep of frame ``index``."""
        return self._scene.lidar(index)

    def truth(self, index: int, roi: RegionOfInterest) -> FrameTruth | None:
        """Return the ground truth of frame ``index``; None without one or if it cannot be had."""
        return self.guarded(lambda: self._scene.truth(index, roi))

    def truths(self, roi: RegionOfInterest, cache: Path | None = None) -> list[FrameTruth] | None:
        """Return the ground truth of all frames; None without one or if it cannot be had."""
        return self.guarded(lambda: self._scene.truths(roi, cache))

    def truth_map(self, roi: RegionOfInterest = STANDARD_REGION) -> GlobalMap | None:
        """Return the ground-truth map of the whole log; None without one or if it cannot be had."""
        return self.guarded(lambda: self._scene.truth_map(roi))

    def guarded(self, ask: Callable[[], Found | None]) -> Found | None:
        """Return what ``ask`` finds, or None after a failure, which is kept as :attr:`problem`."""
        if self.problem:
            return None
        try:
            return ask()
        except Exception as error:  # Whatever is wrong with the truth, the map is not.
            self.problem = str(error) or type(error).__name__
            return None
