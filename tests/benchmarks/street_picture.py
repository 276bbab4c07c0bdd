"""A picture of a mapped log of photographs: ``python -m tests.benchmarks.street_picture [LOG] --out FILE.png``.

Above stand cameras of one instant with the tracks, below the map (broad) over the truth (thin, white). LOG is a folder
of an own log with its truth; by default the real street among the fixtures. Its photographs are not ours to hand on, so
the picture is made by those who have them and lies in no repository.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import cv2
import numpy as np
import shapely

from mapfusion.arrays import Float
from mapfusion.colours import BACKGROUND, KIND_COLOURS
from mapfusion.elements import FrameMap, GlobalMap
from predmapnet.datasets.images import read_camera_image
from predmapnet.errors import UserError
from predmapnet.evaluation.global_map import seen_area
from predmapnet.files import check_output, write_file
from predmapnet.mapper import Mapper
from predmapnet.mapping import map_scene
from predmapnet.recording.projection import project_line
from predmapnet.scenes import Camera, Image
from tests.benchmarks.real_roads import reference_folder
from tests.real_roads.street import open_street

CAMERA_WIDTH = 640
"""Pixels of each camera's picture; the map below is as wide as all of them."""
LOWEST_SCORE = 0.3
"""Tracks scored below it are not drawn."""
MARGIN = 5.0
"""Ground around the seen area, metres."""
WHITE = (255, 255, 255)


def camera_picture(stored: Path | Image, camera: Camera, found: FrameMap) -> Image:
    """Draw the tracks of an instant into an image of it; returns ``(h, CAMERA_WIDTH, 3)``."""
    image = read_camera_image(stored, camera).copy()
    for kind, line, score in zip(found.kinds, found.polylines, found.scores, strict=True):
        if score >= LOWEST_SCORE:
            for part in project_line(line, camera):
                draw(image, part, KIND_COLOURS[kind], 3)
    size = (CAMERA_WIDTH, round(camera.height * CAMERA_WIDTH / camera.width))
    return np.asarray(cv2.resize(image, size), np.uint8)


def map_picture(found: GlobalMap, truth: GlobalMap, seen: shapely.Geometry, heading: Float, width: int) -> Image:
    """Draw a map over the truth inside the seen area, the drive running to the right; returns ``(h, width, 3)``."""
    ahead = heading / np.linalg.norm(heading)
    turn = np.array([ahead, [-ahead[1], ahead[0]]])
    rim = shapely.get_coordinates(seen) @ turn.T
    low, high = rim.min(axis=0) - MARGIN, rim.max(axis=0) + MARGIN
    scale = width / (high - low)[0]
    picture = np.full((round((high - low)[1] * scale), width, 3), BACKGROUND, np.uint8)

    def drawn(points: Float) -> Float:
        return np.asarray((points @ turn.T - [low[0], high[1]]) * [scale, -scale])

    for element in found.elements:
        draw(picture, drawn(element.points), KIND_COLOURS[element.kind], 6)
    for element in truth.elements:
        for part in shapely.get_parts(shapely.LineString(element.points).intersection(seen)):
            draw(picture, drawn(shapely.get_coordinates(part)), WHITE, 1)
    return picture


def draw(picture: Image, line: Float, colour: tuple[int, ...], thickness: int) -> None:
    """Draw a line ``(n, 2)`` of pixels."""
    cv2.polylines(picture, [np.round(16 * line).astype(np.int32)], False, colour, thickness, cv2.LINE_AA, shift=4)


def street_picture(log: Path, frame: int | None, cameras: list[str]) -> Image:
    """Map a log and draw it. Raises UserError where it has no truth, or no such frame or camera."""
    scene, mapper = open_street(log), Mapper.from_checkpoint()
    truth = scene.truth_map()
    if truth is None:
        raise UserError(f"{log} has no truth to draw the map over.")
    index = len(scene) // 2 if frame is None else frame
    if not 0 <= index < len(scene):
        raise UserError(f"{log} has the frames 0 to {len(scene) - 1}, not {index}.")
    run = map_scene(scene, mapper, allow_missing_cameras=True)
    shown = run.frames[index]
    by_name = {camera.name: camera for camera in shown.rig if camera.name in shown.images}
    if unknown := set(cameras) - set(by_name):
        raise UserError(f"Frame {index} has images of {', '.join(by_name)}, not of {', '.join(sorted(unknown))}.")
    pictures = [
        camera_picture(shown.images[name], by_name[name], run.frame_maps[index])
        for name in cameras or list(by_name)[:3]
    ]
    height = min(len(picture) for picture in pictures)
    above = np.hstack([picture[:height] for picture in pictures])
    seen = seen_area([frame.ego_to_global for frame in run.frames], mapper.roi)
    heading = shown.ego_to_global[:2, 0]
    return np.vstack([above, map_picture(run.global_map, truth, seen, heading, above.shape[1])])


def main(arguments: list[str] | None = None) -> int:
    """Write the picture."""
    parser = argparse.ArgumentParser(prog="python -m tests.benchmarks.street_picture", description=__doc__)
    parser.add_argument("log", type=Path, nargs="?", default=reference_folder() / "real_street", metavar="LOG")
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--frame", type=int, help="whose images are shown; by default the middle one")
    parser.add_argument("--cameras", nargs="+", default=[], help="to show; by default the first three")
    options = parser.parse_args(arguments)
    try:
        check_output(options.out, (".png", ".jpg"))
        picture = street_picture(options.log, options.frame, options.cameras)
        encoded = cv2.imencode(options.out.suffix, cv2.cvtColor(picture, cv2.COLOR_RGB2BGR))[1]
        with write_file(options.out) as draft:
            draft.write_bytes(encoded.tobytes())
    except UserError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
