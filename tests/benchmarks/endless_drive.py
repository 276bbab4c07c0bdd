"""Time and memory per frame over a drive that does not end.

    python -m tests.benchmarks.endless_drive --frames 2000

The frames of a demo scene are driven again and again, each lap from where the one before ended, so that the network
sees what it knows. Roads of such laps would cross each other everywhere, so the map gets each lap at a place of its
own, as a drive of its own. CPU seconds are those of all threads.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

from predmapnet.machine import use_threads

if __name__ == "__main__":  # Before torch is imported.
    arguments = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    arguments.add_argument("--frames", type=int, default=2000)
    arguments.add_argument("--every", type=int, default=200, help="frames per line that is printed")
    arguments.add_argument("--threads", type=int, default=0, help="0: all cores")
    options = arguments.parse_args()
    use_threads(options.threads)

import numpy as np

from mapfusion.geometry import inverse_pose
from mapfusion.integrate.integrator import MapIntegrator
from predmapnet.demo_world.source import DemoSource
from predmapnet.mapper import Mapper
from predmapnet.network.state import StreamState
from predmapnet.scenes import Frame, Scene

SCENE = "scene-0103"
METRES_BETWEEN_LAPS = 1000.0


@dataclass(frozen=True)
class Stretch:
    """Some frames in a row.

    Attributes:
        last_frame: number of the last of them.
        mapping, integrating: CPU seconds per frame.
        tracks: that are alive at the end.
        state_bytes: of the state that is handed from frame to frame.
        elements: of the map, lines and crossings.
        megabytes: of memory in use by the process.
    """

    last_frame: int
    mapping: float
    integrating: float
    tracks: int
    state_bytes: int
    elements: int
    megabytes: float


def endless_frames(scene: Scene) -> Iterator[Frame]:
    """Yield the frames of a scene lap after lap, with poses and times that go on."""
    frames = [scene.frame(index) for index in range(len(scene))]
    before, last = frames[-2], frames[-1]
    step = inverse_pose(before.ego_to_global) @ last.ego_to_global
    lap = last.ego_to_global @ step @ inverse_pose(frames[0].ego_to_global)
    duration = 2 * last.timestamp - before.timestamp - frames[0].timestamp
    while True:
        yield from frames
        frames = [
            replace(frame, ego_to_global=lap @ frame.ego_to_global, timestamp=frame.timestamp + duration)
            for frame in frames
        ]


def drive(mapper: Mapper, scene: Scene, frames: int, every: int) -> Iterator[Stretch]:
    """Map an endless drive, and tell what it costs every so many frames."""
    images = [mapper.read_images(scene.frame(index)) for index in range(len(scene))]
    integrator, state = MapIntegrator(), None
    mapping = integrating = 0.0
    for number, frame in zip(range(1, frames + 1), endless_frames(scene), strict=False):
        start = time.process_time()
        frame_map, state = mapper.step(frame, state, images=images[frame.index])
        mapping += time.process_time() - start
        lap, apart = (number - 1) // len(scene), np.eye(4)
        apart[0, 3] = METRES_BETWEEN_LAPS * lap
        place = apart @ scene.frame(frame.index).ego_to_global
        start = time.process_time()
        integrator.add(replace(frame_map, ego_to_global=place), log=f"lap {lap}")
        integrating += time.process_time() - start
        if number % every == 0:
            elements = len(integrator.state.lines) + len(integrator.state.rings)
            tracks = int(state.instances.valid.sum())
            bytes_ = state_bytes(state)
            yield Stretch(number, mapping / every, integrating / every, tracks, bytes_, elements, resident_megabytes())
            mapping = integrating = 0.0


def state_bytes(state: StreamState) -> int:
    """Return the size of everything that is handed to the next frame."""
    return sum(tensor.nbytes for tensor in state.tensors().values())


def resident_megabytes() -> float:
    """Return the memory in use by this process (Linux)."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * 4096 / 1e6


def table(frames: int, every: int) -> Iterator[str]:
    """Drive with the shipped weights and tell about it, line by line."""
    columns = ("frame", "mapping ms", "integrating ms", "tracks", "state kB", "elements", "memory MB")
    yield "".join(f"{column:>16s}" for column in columns)
    for part in drive(Mapper.from_checkpoint(), DemoSource().open(SCENE), frames, every):
        yield (
            f"{part.last_frame:16d}{1e3 * part.mapping:16.1f}{1e3 * part.integrating:16.2f}{part.tracks:16d}"
            f"{part.state_bytes / 1e3:16.0f}{part.elements:16d}{part.megabytes:16.0f}"
        )


if __name__ == "__main__":
    for line in table(options.frames, options.every):
        print(line, flush=True)
