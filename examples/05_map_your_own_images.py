"""Map images that are in memory, of a car of your own: a camera, where the car was, and pixels.

    python examples/05_map_your_own_images.py map.geojson

What a driver or a video would deliver is drawn here: a straight road with a line to the left of the car.
"""

import sys
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np

import predmapnet as pmn
from mapfusion.formats.local_plane import LocalPlane

FRONT = pmn.Camera(
    name="front",
    width=800,
    height=450,
    intrinsics=np.array([[600.0, 0.0, 400.0], [0.0, 600.0, 225.0], [0.0, 0.0, 1.0]]),
    # 1.7 m ahead of the origin and 1.2 m above it; it looks ahead (its z) with x to the right and y down
    camera_to_ego=np.array([[0.0, 0, 1, 1.7], [-1, 0, 0, 0.0], [0, -1, 0, 1.2], [0, 0, 0, 1]]),
    ground_height=-0.3,  # the origin is 0.3 m above the road
)


def drive() -> Iterator[pmn.Frame]:
    for index in range(8):
        pose = np.eye(4)
        pose[0, 3] = 4.0 * index
        image = np.full((FRONT.height, FRONT.width, 3), 110, dtype=np.uint8)  # RGB
        ends = [(400 - round(600 * 1.8 / x), 225 + round(600 * 1.5 / x)) for x in (3.0, 60.0)]
        cv2.line(image, *ends, (255, 255, 255), 6)
        yield pmn.Frame("my-drive", index, "", index * 500_000_000, pose, (FRONT,), {"front": image})


def main(path: Path, weights: Path | None = None) -> None:
    mapper = pmn.Mapper.from_checkpoint(pmn.NetworkOptions(weights=weights))
    integrator, state = pmn.MapIntegrator(pmn.NETWORK_ERRORS), None
    for frame in drive():
        frame_map, state = mapper.step(frame, state)
        integrator.add(frame_map, log=frame.scene)
        print(f"frame {frame.index}: {len(frame_map.tracked)} tracks")
    origin = LocalPlane(longitude=8.41, latitude=49.01)  # where the poses begin; x is east, y is north
    pmn.write_map(integrator.map(), path, origin)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
