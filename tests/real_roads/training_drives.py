"""Draw drives over the free road maps for training, each as the folder of a log of one's own.

Every drive has a car, cameras, light, ground and traffic of its own, like the training scenes of the demo world. Drives
that are there already are kept.
"""

from __future__ import annotations

import argparse
import sys
import time
import zlib
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import orjson
import shapely
from shapely import Polygon

from mapfusion.arrays import Float
from mapfusion.elements import GlobalMap
from mapfusion.geometry import inverse_pose
from predmapnet.datasets.ground_truth.whole_map import truth_map
from predmapnet.datasets.own_logs.calibration import CALIBRATION, write_rig
from predmapnet.datasets.own_logs.timed_poses import TimedPoses, write_timed_poses
from predmapnet.demo_world.catalogue import HILLY_SHARE, LOOK_SHARES, hilly
from predmapnet.demo_world.render.renderer import Renderer
from predmapnet.demo_world.render.response import draw_response
from predmapnet.demo_world.rig import LIDAR_TO_EGO
from predmapnet.demo_world.rigs import sample_rig
from predmapnet.demo_world.street.dressing import dress
from predmapnet.demo_world.street.looks import harder_light, light_of
from predmapnet.demo_world.training_drive import TEXEL
from predmapnet.demo_world.truth import truth_from_vector_map
from predmapnet.demo_world.world import Trajectory, VectorMap, World
from predmapnet.errors import UserError
from predmapnet.files import whole_folder
from predmapnet.scenes import STANDARD_REGION, Camera, Rig
from tests.benchmarks.real_roads import reference_folder
from tests.real_roads.dressed import image_path, repainted
from tests.real_roads.made_up_paint import read_bare_map
from tests.real_roads.road_maps import drives_along, read_road_map

IMAGE_WIDTH = 768
"""Pixels at most: twice of what ``lite`` sees."""
JPEG_QUALITY = 92
LEAST_FRAMES = 25
"""A shorter drive is not worth its ground."""
IN_SIGHT = 160.0
"""Metres from a drive; what lies further off costs time and is not seen."""


@dataclass(frozen=True)
class RoadDrive:
    """One drive to be drawn.

    Attributes:
        name: of its folder.
        seed: of the car and of all that the map does not tell.
        painted: the map as it is drawn.
        true_map: the map as it counts.
        trajectory: of the point below the rear axle.
    """

    name: str
    seed: int
    painted: VectorMap
    true_map: VectorMap
    trajectory: Trajectory


def road_drives(path: Path, count: int, seed: int) -> Iterator[RoadDrive]:
    """Choose drives over one map, with paint made up if it has none.

    Args:
        path: of the map.
        count: how many drives at most.
        seed: of paint, cars and surroundings.

    Raises:
        UserError: the file is no road map.
    """
    map_seed = zlib.crc32(f"{path.stem} {seed}".encode())
    try:
        has_paint = bool(orjson.loads(path.read_bytes())["dividers"])
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise UserError(f"{path} is no road map: {error!r}") from error
    painted, _, true_map = read_road_map(path) if has_paint else (read_bare_map(path, map_seed), None, None)
    road = shapely.union_all(painted.road_segments).buffer(0.2)
    number = 0
    for trajectory in drives_along(list(painted.lane_paths), painted, count + 1):
        positions = trajectory.ego_to_global[:, :2, 3]
        is_long = len(positions) >= LEAST_FRAMES
        if number == count or not is_long or not road.contains(shapely.LineString(positions)):
            continue
        number += 1
        here = repainted(painted, number) if has_paint else painted
        near = shapely.LineString(positions).buffer(IN_SIGHT)
        name = drive_names(path, count, seed)[number - 1]
        yield RoadDrive(
            name=name,
            seed=zlib.crc32(name.encode()),
            painted=map_near(here, near),
            true_map=map_near(true_map or here, near),
            trajectory=trajectory,
        )


def drive_names(path: Path, count: int, seed: int) -> list[str]:
    """Return the names of the folders of a map's drives."""
    return [f"{path.stem}-{seed}-{number}" for number in range(1, count + 1)]


def map_near(vector_map: VectorMap, area: Polygon) -> VectorMap:
    """Return what of a map meets an area; roads are cut off at its bounds."""
    segments = [segment.intersection(area.envelope) for segment in vector_map.road_segments]
    return replace(
        vector_map,
        road_segments=tuple(part for part in shapely.get_parts(segments) if isinstance(part, Polygon)),
        lanes=tuple(lane for lane in vector_map.lanes if area.intersects(lane)),
        crossings=tuple(crossing for crossing in vector_map.crossings if area.intersects(crossing.polygon)),
        dividers=tuple(line for line in vector_map.dividers if area.intersects(shapely.LineString(line.points))),
        markings=tuple(line for line in vector_map.markings if area.intersects(shapely.LineString(line.points))),
        parking=tuple(bay for bay in vector_map.parking if area.intersects(bay)),
        stop_lines=tuple(line for line in vector_map.stop_lines if area.intersects(line)),
        lane_paths=tuple(path for path in vector_map.lane_paths if area.intersects(shapely.LineString(path))),
    )


def write_drive(drive: RoadDrive, folder: Path) -> None:
    """Draw a drive and write its log.

    The ego axes are those of the car; the origin lies at the lidar's x and y and at the height of the car's own origin,
    as in the demo world's own training scenes.

    Raises:
        UserError: it cannot be written, or the folder exists.
    """
    world, rig = world_of(drive), tuple(_small(camera) for camera in sample_rig(drive.seed))
    lift, to_lidar = np.eye(4), np.eye(4)
    lift[2, 3] = -rig[0].ground_height
    to_lidar[:2, 3] = LIDAR_TO_EGO[:2, 3]
    poses = world.trajectory.ego_to_global @ lift
    renderer = Renderer(
        replace(world, trajectory=replace(world.trajectory, ego_to_global=poses)),
        response=draw_response(drive.seed),
        light=harder_light(light_of(world.look, world.seed), drive.seed),
        texel=TEXEL,
    )
    stamps = world.trajectory.timestamps
    true = true_lines(drive.true_map, stamps.tolist(), world.trajectory.ego_to_global @ LIDAR_TO_EGO)
    elements = [{"kind": element.kind.label, "points": element.points.tolist()} for element in true]
    with whole_folder(folder) as draft:
        centred = (replace(camera, camera_to_ego=inverse_pose(to_lidar) @ camera.camera_to_ego) for camera in rig)
        write_timed_poses(draft / "poses.csv", TimedPoses(stamps, poses @ to_lidar))
        (draft / "truth.json").write_bytes(orjson.dumps({"elements": elements}))
        _draw_images(renderer, rig, stamps.tolist(), draft)
        # Last: without it no folder is a log, also one that a killed process leaves behind.
        write_rig(draft / CALIBRATION, tuple(centred))


def true_lines(true_map: VectorMap, stamps: list[int], lidar_to_global: Float) -> GlobalMap:
    """Return what a drive passes, by the rules of nuScenes."""
    truth = truth_from_vector_map(true_map)
    return truth_map(truth, list(zip(stamps, lidar_to_global, strict=True)), STANDARD_REGION)


def world_of(drive: RoadDrive) -> World:
    """The surroundings, with looks and hills as frequent as among the training scenes."""
    random = np.random.default_rng([0x726F616473, drive.seed])
    look = list(LOOK_SHARES)[int(random.choice(len(LOOK_SHARES), p=list(LOOK_SHARES.values())))]
    world = dress(drive.painted, drive.trajectory, look, drive.seed, drive.name, cluttered=True)
    return hilly(world) if random.random() < HILLY_SHARE else world


def _small(camera: Camera) -> Camera:
    width = min(camera.width, IMAGE_WIDTH)
    height = round(camera.height * width / camera.width)
    scale = np.diag([width / camera.width, height / camera.height, 1.0])
    return replace(camera, width=width, height=height, intrinsics=scale @ camera.intrinsics)


def _draw_images(renderer: Renderer, rig: Rig, stamps: list[int], folder: Path) -> None:
    for frame, stamp in enumerate(stamps):
        for name, drawn in renderer.render_frame(rig, frame).items():
            path = image_path(folder, name, stamp)
            path.parent.mkdir(parents=True, exist_ok=True)
            quality = [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY]
            path.write_bytes(cv2.imencode(".jpg", drawn.image[:, :, ::-1], quality)[1].tobytes())


def draw_all(maps: Path, folder: Path, count: int, seed: int) -> None:
    """Draw what is missing of the drives over all maps, and print a line for each of them.

    Raises:
        UserError: there are no maps, one is none, or a drive cannot be written.
    """
    paths = sorted(maps.glob("*.json"))
    if not paths:
        raise UserError(f"There are no road maps (*.json) in {maps}. PREDMAPNET_REFERENCE names the folder above.")
    for number, path in enumerate(paths, start=1):
        names = drive_names(path, count, seed)
        if all((folder / "train" / name).exists() for name in names):
            print(f"{number}/{len(paths)} {path.stem}: there already", flush=True)
            continue
        drawn = 0
        for drive in road_drives(path, count, seed):
            began, target = time.perf_counter(), folder / "train" / drive.name
            if not target.exists():
                write_drive(drive, target)
            drawn += 1
            print(f"{number}/{len(paths)} {drive.name}: {time.perf_counter() - began:.0f} s", flush=True)
        if drawn < count:
            print(f"{number}/{len(paths)} {path.stem}: only {drawn} of {count} drives are long enough", flush=True)


def main(arguments: list[str] | None = None) -> int:
    """Draw drives into a folder; returns 2 after an error that the user can mend."""
    summary = (__doc__ or "").splitlines()[0]
    parser = argparse.ArgumentParser(prog="python -m tests.real_roads.training_drives", description=summary)
    parser.add_argument("folder", type=Path, metavar="FOLDER", help="drives are written into its folder train")
    parser.add_argument("--drives", type=int, default=2, help="over each map (default: 2)")
    parser.add_argument("--seed", type=int, default=0, help="of paint, cars and surroundings (default: 0)")
    options = parser.parse_args(arguments)
    if options.drives < 1 or options.seed < 0:
        parser.error("--drives must be 1 or more, and --seed 0 or more")
    try:
        draw_all(reference_folder() / "road_geometry" / "train", options.folder, options.drives, options.seed)
    except UserError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("Stopped; the same command goes on.", file=sys.stderr)
        return 130
    return 0


if __name__ == "__main__":
    sys.exit(main())
