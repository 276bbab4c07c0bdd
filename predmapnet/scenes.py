"""Driving logs: cameras, frames, scenes and their sources."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Protocol

import numpy as np
import shapely
from numpy.typing import NDArray

from mapfusion.arrays import Float
from mapfusion.elements import GlobalMap, RegionOfInterest
from mapfusion.georeference import Georeference
from mapfusion.ground import CameraSector, ground_within, region, rings_around, visible_ground

if TYPE_CHECKING:
    from predmapnet.datasets.undistortion import Lens

Image = NDArray[np.uint8]
Report = Callable[[str], None]
"""Sink of lines for the user."""

Progress = Callable[[int, int, str], None]
"""Callback ``progress(done, total, what)`` of a long preparation."""

STANDARD_REGION = RegionOfInterest()
"""Region of most benchmarks, 60 m x 30 m."""

NARROW_GAP = 4.0
"""Gaps between neighbouring cameras narrower than this, metres, count as seen from either side."""

WHOLE = 0.99
"""Share of the region from which on all of it counts as seen."""


@dataclass(frozen=True)
class Camera:
    """A pinhole camera on the car (x right, y down, z forward in its own frame).

    Pixel ``(i, j)`` covers ``[i, i + 1) x [j, j + 1)``: the centre of the first pixel is at (0.5, 0.5), so that an
    image scaled by ``s`` has the intrinsics ``diag(s, s, 1) @ intrinsics``.

    Attributes:
        name: as the data set calls it, for example ``CAM_FRONT``.
        width, height: pixels of the images as they are stored, or as they are undistorted.
        intrinsics: ``(3, 3) float64`` for images of that size.
        camera_to_ego: ``(4, 4) float64``.
        ground_height: z of the road under the car in the ego frame, metres: zero where the ego origin lies on it.
        lens: of stored images that are distorted; all else then describes the pinhole that they are turned into.
    """

    name: str
    width: int
    height: int
    intrinsics: Float
    camera_to_ego: Float
    ground_height: float = 0.0
    lens: Lens | None = None

    @property
    def sector(self) -> CameraSector:
        """The horizontal sector of the ground that the camera covers, ego frame."""
        focal, centre = self.intrinsics[0, 0], self.intrinsics[0, 2]
        left, right = np.arctan2(centre, focal), np.arctan2(self.width - centre, focal)
        axis = self.camera_to_ego[:2, 2]
        heading = np.arctan2(axis[1], axis[0]) + (left - right) / 2
        return CameraSector(self.camera_to_ego[:2, 3], float(heading), float(left + right))


Rig = tuple[Camera, ...]


def ground_in_view(cameras: Iterable[Camera], roi: RegionOfInterest) -> tuple[Float, ...] | None:
    """Return the ground that cameras cover, as ``FrameMap.visible``: rings ``(n, 2)``, or None for all of the ROI."""
    ground = ground_within(visible_ground(roi, [camera.sector for camera in cameras]))
    closed = shapely.buffer(shapely.buffer(ground, NARROW_GAP / 2, quad_segs=2), -NARROW_GAP / 2, quad_segs=2)
    whole = region(roi)
    if shapely.intersection(closed, whole).area >= WHOLE * whole.area:
        return None
    return tuple(rings_around(closed))


@dataclass(frozen=True)
class Frame:
    """One instant of a log: pose, calibration and images.

    Attributes:
        scene: name of the scene.
        index: position in the scene, from 0.
        token: the data set's own unique name of the frame.
        timestamp: integer nanoseconds.
        ego_to_global: ``(4, 4) float64``; on nuScenes the ego origin lies at the lidar's x, y, as in the
            official vector-map data sets.
        rig: the cameras of the car, always all of them.
        images: by camera name, image files or pixels ``(height, width, 3) uint8``, RGB, as the camera took them. A
            camera without an image is absent.
        missing: why there is no image, by name of the camera.
    """

    scene: str
    index: int
    token: str
    timestamp: int
    ego_to_global: Float
    rig: Rig
    images: Mapping[str, Path | Image]
    missing: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class Instant:
    """Time and pose of a frame, known without calibration and images.

    Attributes:
        token: the data set's own unique name of the frame.
        timestamp: integer nanoseconds.
        ego_to_global: ``(4, 4) float64``, as in :class:`Frame`.
    """

    token: str
    timestamp: int
    ego_to_global: Float


@dataclass(frozen=True)
class FrameTruth:
    """Ground truth of one instant, clipped to the ROI.

    Attributes:
        kinds: ``(n,) int64`` of :class:`mapfusion.ElementKind`.
        polylines: ``n`` arrays ``(k_i, 2) float64``, metres, ego frame; crossings are closed rings.
        element_ids: ``(n,) int64``, which element of the source's map each piece came from (unique per kind);
            -1 where the source cannot tell.
    """

    kinds: NDArray[np.int64]
    polylines: tuple[Float, ...]
    element_ids: NDArray[np.int64]


@dataclass(frozen=True)
class SceneInfo:
    """One line of ``predmapnet scenes``.

    Attributes:
        name: as users type it.
        split: ``train``, ``val`` or ``test``.
        frames: number of key frames.
        location: town, city or map name.
        ready: False while a demo scene has not been rendered yet.
        description: a few words for a person.
    """

    name: str
    split: str
    frames: int
    location: str
    ready: bool = True
    description: str = ""


class Scene(Protocol):
    """One driving log, opened."""

    @property
    def info(self) -> SceneInfo:
        """The scene's line in the listing."""

    @property
    def rig(self) -> Rig:
        """The car's cameras. Raises UserError for a log whose cameras are not known."""

    @property
    def georeference(self) -> Georeference | None:
        """Georeference of the global frame, if it is known."""

    def __len__(self) -> int: ...

    def frame(self, index: int) -> Frame:
        """Return frame ``index``; images are named, not read. Raises UserError for a broken pose."""

    def instant(self, index: int) -> Instant:
        """Return token, time stamp and pose of frame ``index``. Raises UserError for a broken pose."""

    def lidar(self, index: int) -> Float | None:
        """Return the lidar sweep of frame ``index``, ``(n, 3)``, metres, ego frame; None where there is no file."""

    def truth(self, index: int, roi: RegionOfInterest) -> FrameTruth | None:
        """Return the ground truth of frame ``index``, or None where the source has no map."""

    def truths(self, roi: RegionOfInterest, cache: Path | None = None) -> list[FrameTruth] | None:
        """Return the ground truth of all frames, kept in the folder ``cache`` if one is given; None without a map."""

    def truth_map(self, roi: RegionOfInterest = STANDARD_REGION) -> GlobalMap | None:
        """Return the true map of what came into the region along the log, global frame; None without a map."""


class SceneSource(Protocol):
    """A data set on disk (or the demo world, which makes itself)."""

    @property
    def name(self) -> str:
        """``nuscenes``, ``argoverse2``, ``log`` or ``demo``."""

    @property
    def root(self) -> Path:
        """Folder of the data set."""

    @property
    def synthetic(self) -> bool:
        """Whether its images were rendered."""

    def scenes(self, split: str | None = None) -> tuple[SceneInfo, ...]:
        """List what is there, in the data set's order; ``split`` narrows it. Raises UserError."""

    def open(self, scene: str, progress: Progress | None = None) -> Scene:
        """Open one scene by name; a name that does not exist raises UserError with the nearest names."""

    def truth_map(self, scenes: Sequence[str], roi: RegionOfInterest) -> GlobalMap | None:
        """Return the true map of what came into the region along several scenes of one location, or None."""

    def scenes_of(self, tokens: Iterable[str]) -> dict[str, str]:
        """Look up which scenes frames belong to: names of scenes by frame token. Unknown tokens are absent."""
