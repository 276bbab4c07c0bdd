"""What a network that knows photographs sees in our renderings: ``python -m tests.benchmarks.photograph_judge``.

``road-segmentation-adas-0001`` of the Open Model Zoo (Apache-2.0) was trained on photographs alone and labels each
pixel as road, kerb, marking or other. Where it misreads a rendering whose truth is known, the rendering does not look
like a road. Prints its intersection over union by look, for the front and the back camera of validation towns. Kerbs
are measured with a tolerance, since the judge draws them as wide bands; pixels beyond ``FARTHEST`` count for nothing.

Needs ``pip install openvino`` and the network (.xml and .bin), by default beside the project.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import orjson
import shapely
from numpy.typing import NDArray

from predmapnet.demo_world.catalogue import build_world, scene_infos
from predmapnet.demo_world.render.paint import paint_quads
from predmapnet.demo_world.render.renderer import Renderer
from predmapnet.demo_world.rig import DEMO_RIG
from predmapnet.demo_world.world import Look, World
from predmapnet.errors import UserError
from predmapnet.files import check_output, write_file
from predmapnet.scenes import Camera

PROJECT = Path(__file__).resolve().parents[2]
JUDGE = PROJECT.parent / "shared" / "judges" / "road_segmentation" / "road-segmentation-adas-0001.xml"
WIDTH, HEIGHT = 896, 512
CLASSES = ("other", "road", "kerb", "marking")
CAMERAS = ("CAM_FRONT", "CAM_BACK")
FRAMES = (5, 15, 25, 35)
FARTHEST = 40.0
"""Metres along the ground; farther away a line is thinner than a pixel."""
ON_GROUND = 0.06
"""Metres that a pixel's point may lie beside the ground and still belong to it."""
KERB_WIDTH = 0.5
"""Metres on either side of the road's edge that belong to a kerb."""

Labels = NDArray[np.int64]
Judge = Callable[[NDArray[np.uint8]], Labels]


def load_judge(path: Path) -> Judge:
    """Return the judge: from an image ``(512, 896, 3)``, RGB, to labels ``(512, 896)``, indices of ``CLASSES``.

    Raises:
        UserError: the package or the network is missing.
    """
    try:
        import openvino
    except ImportError:
        raise UserError("The judge needs openvino: pip install openvino") from None
    if not path.is_file():
        raise UserError(f"There is no network {path}. Give --judge.")
    network = openvino.Core().compile_model(str(path), "CPU")

    def label(image: NDArray[np.uint8]) -> Labels:
        planes = image[:, :, ::-1].transpose(2, 0, 1)[None].astype(np.float32)
        labels: Labels = np.asarray(network(planes)[0])[0].argmax(0)
        return labels

    return label


def judged_camera(camera: Camera) -> Camera:
    """Return the camera with as many pixels as the judge takes, more above and below, the same field of view."""
    scale = WIDTH / camera.width
    intrinsics = np.diag([scale, scale, 1.0]) @ camera.intrinsics
    intrinsics[1, 2] += (HEIGHT - scale * camera.height) / 2
    return replace(camera, width=WIDTH, height=HEIGHT, intrinsics=intrinsics)


class TrueLabels:
    """Labels of a world's ground, exact but for what wears the paint."""

    def __init__(self, world: World) -> None:
        quads, _ = paint_quads(world.map, world.seed)
        self._paint = shapely.STRtree(shapely.polygons(quads[..., :2]))
        self._road = shapely.union_all(world.map.road_segments)
        self._edge = self._road.boundary
        shapely.prepare([self._road, self._edge])

    def of(self, points: NDArray[np.float64]) -> Labels:
        """Return labels ``(n,)`` of points ``(n, 2)`` on the ground."""
        spots = shapely.points(points)
        labels = np.where(shapely.contains(self._road, spots), CLASSES.index("road"), CLASSES.index("other"))
        labels[shapely.dwithin(self._edge, spots, KERB_WIDTH)] = CLASSES.index("kerb")
        labels[self._paint.query(spots, predicate="intersects")[0]] = CLASSES.index("marking")
        return np.asarray(labels, dtype=np.int64)


def judge_scene(name: str, look: Look, judge: Judge) -> NDArray[np.int64]:
    """Return the confusion ``(4, 4)`` of a town in one look, pixels: rows are true, columns judged."""
    world = replace(build_world(name), look=look)
    renderer, truth = Renderer(world), TrueLabels(world)
    confusion = np.zeros((len(CLASSES), len(CLASSES)), dtype=np.int64)
    for camera in [judged_camera(camera) for camera in DEMO_RIG if camera.name in CAMERAS]:
        columns, rows = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)
        rays = np.stack([columns, rows, np.ones_like(rows)], axis=-1) @ np.linalg.inv(camera.intrinsics).T
        for frame in FRAMES:
            drawn = renderer.render(camera, frame)
            pose = world.trajectory.ego_to_global[frame] @ camera.camera_to_ego
            depth = np.where(np.isfinite(drawn.depth), drawn.depth, 1e6).astype(np.float64)
            points = (rays * depth[..., None]) @ pose[:3, :3].T + pose[:3, 3]
            counted = (np.abs(points[..., 2]) < ON_GROUND) & (depth < FARTHEST)
            labels = truth.of(points[counted][:, :2])
            np.add.at(confusion, (labels, judge(drawn.image)[counted]), 1)
    return confusion


def intersection_over_union(confusion: NDArray[np.int64]) -> dict[str, float]:
    """Return the IoU by class, and the share of true road, paint included, that is judged road or paint."""
    both = np.diag(confusion)
    union = confusion.sum(0) + confusion.sum(1) - both
    figures = {name: float(both[row] / max(union[row], 1)) for row, name in enumerate(CLASSES) if name != "other"}
    surface = [CLASSES.index("road"), CLASSES.index("marking")]
    figures["road_found"] = float(confusion[np.ix_(surface, surface)].sum() / max(confusion[surface].sum(), 1))
    return figures


def judge_looks(names: list[str], judge: Judge) -> Iterator[tuple[str, dict[str, float]]]:
    """Yield each look with its figures."""
    for look in Look:
        confusion = np.sum([judge_scene(name, look, judge) for name in names], axis=0)
        yield str(look), intersection_over_union(confusion)


def main(arguments: list[str] | None = None) -> int:
    """Print the table; write it if asked for."""
    parser = argparse.ArgumentParser(
        prog="python -m tests.benchmarks.photograph_judge", description=__doc__.splitlines()[0]
    )
    parser.add_argument("--judge", type=Path, default=JUDGE, help="the network's .xml")
    parser.add_argument("--towns", type=int, default=3, help="how many validation towns, each in all looks")
    parser.add_argument("--json", type=Path, help="write the figures to this file, too")
    options = parser.parse_args(arguments)
    try:
        if options.json:
            check_output(options.json)
        judge = load_judge(options.judge)
        names = [info.name for info in scene_infos("val")][: options.towns]
        table: dict[str, Any] = {}
        print(f"{'IoU':10}{'road':>8}{'marking':>9}{'kerb':>7}   road found")
        for look, figures in judge_looks(names, judge):
            table[look] = figures
            print(
                f"{look:10}{figures['road']:8.2f}{figures['marking']:9.2f}{figures['kerb']:7.2f}"
                f"{figures['road_found']:13.2f}",
                flush=True,
            )
        if options.json:
            with write_file(options.json) as draft:
                draft.write_bytes(orjson.dumps({"towns": names, "looks": table}, option=orjson.OPT_INDENT_2))
    except UserError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
