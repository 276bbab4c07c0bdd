"""Walk through a scene frame by frame: read ahead, map, integrate, and let observers watch."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from threading import Lock
from time import perf_counter
from typing import TYPE_CHECKING, Protocol

import shapely

from mapfusion.elements import FrameMap, GlobalMap, RegionOfInterest
from mapfusion.ground import seen_along
from mapfusion.integrate.config import IntegratorConfig
from mapfusion.integrate.integrator import MapIntegrator
from mapfusion.road_heights import RoadHeights
from predmapnet.errors import UserError
from predmapnet.machine import trim_memory
from predmapnet.scenes import Frame, Scene

if TYPE_CHECKING:  # What needs no network (runs.integrate) does not load torch.
    from predmapnet.mapper import CameraImages, Mapper, SeenFrame

NETWORK_ERRORS = IntegratorConfig(common_deviation=0.3)
"""Assumptions of the integrator about the networks of this package.

A network with a memory repeats its error from frame to frame, so that its detections agree better with each other
than with the truth. The common part was chosen on the validation towns of the demo world with the ``lite`` weights.
"""

FRAMES_BETWEEN_TRIMS = 100
"""So rarely that it costs nothing, and often enough that a long drive needs no more memory than a short one."""

FRAMES_AHEAD = 2
"""Frames that are seen while another is mapped, each by a thread of its own: to read and to see one costs more than the
rest of it, so a single thread would let cores wait."""

MapSnapshot = Callable[[], GlobalMap]
"""Returns the global map as it is now; its cost grows with the map, so it is for every few frames."""


@dataclass(frozen=True)
class Step:
    """One frame, mapped.

    Attributes:
        frame: pose, calibration and images.
        frame_map: its map, rasters included.
        milliseconds: by stage: ``images`` (waiting for them, or for what is computed of them ahead), ``network``,
            ``integration``.
        fused: whether the integrator accepted the frame.
    """

    frame: Frame
    frame_map: FrameMap
    milliseconds: Mapping[str, float]
    fused: bool


class Observer(Protocol):
    """Watches a run and changes nothing: a recording, a progress bar."""

    def begin(self, scene: Scene, roi: RegionOfInterest) -> None:
        """Called once before the first frame."""

    def observe(self, step: Step, snapshot: MapSnapshot) -> None:
        """Called after each frame."""

    def end(self, global_map: GlobalMap) -> None:
        """Called once after the last frame."""


@dataclass(frozen=True)
class SceneRun:
    """A mapped scene.

    Attributes:
        global_map: the map of the whole drive, without provenance, with heights where the poses tell them.
        frames: the frames that were mapped.
        frame_maps: one per frame, without rasters.
        seconds: wall time from the first image to the last frame.
        milliseconds: mean per frame, by stage.
        rejections: of the integrator, counted by reason.
        observed: ground that the cameras saw in the fused frames, global frame, metres.
    """

    global_map: GlobalMap
    frames: tuple[Frame, ...]
    frame_maps: tuple[FrameMap, ...]
    seconds: float
    milliseconds: Mapping[str, float]
    rejections: Mapping[str, int]
    observed: shapely.Geometry

    @property
    def frames_per_second(self) -> float:
        """Frames mapped per second of wall time."""
        return len(self.frames) / self.seconds


def map_scene(
    scene: Scene, mapper: Mapper, observers: Sequence[Observer] = (), allow_missing_cameras: bool = False
) -> SceneRun:
    """Map a scene from its first frame to its last.

    Args:
        scene: an opened driving log.
        mapper: the network; its state begins anew.
        observers: called at the beginning, after each frame and at the end.
        allow_missing_cameras: go on where a camera has no image; otherwise that is an error.

    Raises:
        UserError: there are no frames, most of them cannot be used, an image is damaged or missing, or a pose is
            broken; the message says which.
    """
    if len(scene) == 0:
        raise UserError(f"{scene.info.name} has no frames: there is nothing to map.")
    integrator = MapIntegrator(NETWORK_ERRORS)
    for observer in observers:
        observer.begin(scene, mapper.roi)
    start = perf_counter()
    frames, frame_maps, fused, timings = [], [], [], []
    for step in stream(scene, mapper, integrator, allow_missing_cameras):
        frames.append(step.frame)
        frame_maps.append(replace(step.frame_map, segmentation=None, history_masks=None))
        timings.append(step.milliseconds)
        if step.fused:
            fused.append(frame_maps[-1])
        for observer in observers:
            observer.observe(step, integrator.map)
    check_left_out(len(frames), len(fused), integrator.rejections)
    global_map = RoadHeights.along(fused).lifted_map(integrator.map())
    seconds = perf_counter() - start
    for observer in observers:
        observer.end(global_map)
    means = {stage: sum(timing[stage] for timing in timings) / len(timings) for stage in timings[0]}
    rejections = dict(integrator.rejections)
    return SceneRun(
        global_map, tuple(frames), tuple(frame_maps), seconds, means, rejections, observed=seen_along(fused)
    )


def check_left_out(frames: int, fused: int, rejections: Mapping[str, int]) -> None:
    """Raise UserError if the integrator left out most frames: a map of the rest would pass for one of all."""
    if 2 * fused < frames:
        reasons = ", ".join(f"{count} x {reason}" for reason, count in rejections.items())
        raise UserError(
            f"{frames - fused} of {frames} frames cannot be used, so there is no map: {reasons}. Are the times in "
            "nanoseconds (microseconds in nuScenes' tables), and the poses in metres?"
        )


def stream(
    scene: Scene, mapper: Mapper, integrator: MapIntegrator, allow_missing_cameras: bool = False
) -> Iterator[Step]:
    """Map frame after frame, adding each to the integrator; the next ones are read, or even seen, meanwhile."""
    state, one_at_a_time = None, Lock()
    threads = FRAMES_AHEAD if mapper.ahead else 1
    with ThreadPoolExecutor(threads, thread_name_prefix="images") as reader:

        def read(index: int) -> tuple[Frame, CameraImages | SeenFrame]:
            with one_at_a_time:  # A scene may keep a file open.
                frame = scene.frame(index)
            images = mapper.read_images(frame, allow_missing_cameras=allow_missing_cameras)
            return frame, mapper.see(frame, images) if mapper.ahead else images

        upcoming = deque(reader.submit(read, index) for index in range(min(threads, len(scene))))
        for index in range(len(scene)):
            if index and index % FRAMES_BETWEEN_TRIMS == 0:
                trim_memory()
            asked = perf_counter()
            frame, images = upcoming.popleft().result()
            images_ready = perf_counter()
            if index + threads < len(scene):
                upcoming.append(reader.submit(read, index + threads))
            frame_map, state = mapper.step(frame, state, images=images)
            mapped = perf_counter()
            before = integrator.frames
            integrator.add(frame_map, log=frame.scene)
            done = perf_counter()
            yield Step(
                frame,
                frame_map,
                {
                    "images": 1e3 * (images_ready - asked),
                    "network": 1e3 * (mapped - images_ready),
                    "integration": 1e3 * (done - mapped),
                },
                fused=integrator.frames > before,
            )
