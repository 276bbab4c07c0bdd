"""Write a dressed Argoverse 2 log as a nuScenes data set: ``python -m tests.real_roads.nuscenes_folder LOG FOLDER``.

Then ``predmapnet evaluate --dataset nuscenes --data-root FOLDER`` measures it in one line, as does every other command
and every other method that reads nuScenes. The truth in it follows the rules of nuScenes, not the official ones of
Argoverse 2; for those there is ``python -m tests.benchmarks.real_roads``.
"""

from __future__ import annotations

import argparse
import sys
import zlib
from dataclasses import replace
from pathlib import Path

import numpy as np
import shapely

from mapfusion.arrays import Float
from predmapnet.datasets.ground_truth.whole_map import join_lines
from predmapnet.demo_world.catalogue import WORLD_VERSION
from predmapnet.demo_world.nuscenes.map_expansion import CANVAS_EDGE
from predmapnet.demo_world.nuscenes.writer import write_scene
from predmapnet.demo_world.street.dressing import dress
from predmapnet.demo_world.world import Divider, Look, Trajectory, VectorMap
from predmapnet.errors import UserError
from tests.real_roads.argoverse_logs import read_log


def shifted(vector_map: VectorMap, by: Float) -> VectorMap:
    """Return a map of roads, lanes, crossings and dividers moved by ``(2,)`` metres."""

    def move(points: Float) -> Float:
        return points + by

    return VectorMap(
        road_segments=tuple(shapely.transform(polygon, move) for polygon in vector_map.road_segments),
        lanes=tuple(shapely.transform(polygon, move) for polygon in vector_map.lanes),
        crossings=tuple(
            replace(crossing, polygon=shapely.transform(crossing.polygon, move)) for crossing in vector_map.crossings
        ),
        dividers=tuple(replace(divider, points=divider.points + by) for divider in vector_map.dividers),
    )


def with_joined_dividers(vector_map: VectorMap) -> VectorMap:
    """Return a map whose dividers run on over the borders of lane segments: nuScenes knows whole lines."""
    groups: dict[tuple[object, ...], list[Divider]] = {}
    for divider in vector_map.dividers:
        groups.setdefault((divider.style, divider.colour, divider.opposite), []).append(divider)
    joined = [
        replace(alike[0], points=line)
        for alike in groups.values()
        for line in join_lines([divider.points for divider in alike])
    ]
    return replace(vector_map, dividers=tuple(joined))


def write_log(log: Path, folder: Path, look: Look) -> None:
    """Draw a log with the demo rig and write it; the drive moves to the middle of the canvas of the schema.

    Raises:
        UserError: the log is broken, or the folder exists already or cannot be written.
    """
    if folder.exists():
        raise UserError(f"{folder} exists already; name a new folder.")
    logged = read_log(log)
    poses = logged.trajectory.ego_to_global.copy()
    middle = (poses[:, :2, 3].min(axis=0) + poses[:, :2, 3].max(axis=0)) / 2
    poses[:, :2, 3] += np.array(CANVAS_EDGE) / 2 - middle
    poses[:, 2, 3] = 0.0
    # The tables hold whole microseconds.
    trajectory = Trajectory(logged.trajectory.timestamps // 1000 * 1000, poses)
    vector_map = with_joined_dividers(shifted(logged.vector_map, np.array(CANVAS_EDGE) / 2 - middle))
    seed = zlib.crc32(log.name.encode())

    def tell(done: int, total: int, what: str) -> None:
        print(f"\r{what}: {done} of {total} ", end="", file=sys.stderr, flush=True)

    write_scene(dress(vector_map, trajectory, look, seed, log.name[:8]), folder, WORLD_VERSION, progress=tell)


def main() -> int:
    """Write one log."""
    parser = argparse.ArgumentParser(prog="python -m tests.real_roads.nuscenes_folder", description=main.__doc__)
    parser.add_argument("log", type=Path, help="folder of an Argoverse 2 log with a map")
    parser.add_argument("folder", type=Path, help="root of the new data set")
    parser.add_argument("--look", type=Look, choices=list(Look), default=Look.DAY)
    options = parser.parse_args()
    try:
        write_log(options.log, options.folder, options.look)
    except UserError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
