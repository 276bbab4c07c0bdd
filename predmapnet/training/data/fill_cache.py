"""Fill the training cache: demo towns, rendered straight at the network's size."""

from __future__ import annotations

import multiprocessing
import os
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import replace
from hashlib import sha256
from pathlib import Path

import cv2
import numpy as np

from predmapnet.config import ImageWindowConfig, PredMapNetConfig
from predmapnet.errors import UserError
from predmapnet.network.image_input import image_window, window_intrinsics
from predmapnet.scenes import Camera
from predmapnet.training.data.scene_cache import write_cached_scene
from predmapnet.training.settings import Report

DEMO = "demo"
OVERSAMPLING = 2
"""Demo images are rendered at this many times the network's size and averaged down, as preprocessing does."""


def cache_folder(root: Path, dataset: str, config: PredMapNetConfig) -> Path:
    """Name the cache of a data set; it depends on what the images and truth depend on.

    Args:
        root: folder of all training caches.
        dataset: its name.
        config: image size, ROI and whether depth is learned are looked at.
    """
    if dataset == DEMO:
        from predmapnet.demo_world.catalogue import WORLD_VERSION

        dataset = f"{DEMO}-v{WORLD_VERSION}"
    shape = f"{config.image.width}x{config.image.height}"
    seen = config.image.horizon if isinstance(config.image, ImageWindowConfig) else config.image.kind
    key = f"{seen} {config.roi_length} {config.roi_width}".encode()
    lidar = "-lidar" if config.depth.enabled else ""
    return root / f"{dataset}-{shape}-{sha256(key).hexdigest()[:8]}{lidar}"


def fill_demo_cache(
    folder: Path, names: Sequence[str], config: PredMapNetConfig, processes: int, report: Report = print
) -> None:
    """Render the demo scenes that are not in the cache yet.

    Args:
        folder: of :func:`cache_folder`.
        names: scenes.
        config: of the network that is going to be trained.
        processes: how many render side by side.
        report: gets a line per scene.
    """
    missing = [name for name in names if not (folder / name).exists()]
    if not missing:
        return
    folder.mkdir(parents=True, exist_ok=True)
    report(f"Rendering {len(missing)} of {len(names)} demo scenes for training into {folder}.")
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(processes, context, initializer=_one_thread) as pool:
        jobs = {pool.submit(cache_demo_scene, folder / name, config): name for name in missing}
        try:
            for done, job in enumerate(as_completed(jobs), start=1):
                job.result()
                report(f"{done}/{len(missing)} {jobs[job]}")
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            raise


def _one_thread() -> None:
    os.environ["OMP_NUM_THREADS"] = "1"
    cv2.setNumThreads(1)


def cache_demo_scene(folder: Path, config: PredMapNetConfig) -> None:
    """Render one demo scene at the network's size, without JPEGs between.

    Args:
        folder: where to; its name is the scene's.
        config: of the network.
    """
    from predmapnet.demo_world.catalogue import build_world
    from predmapnet.demo_world.render.lidar import scan
    from predmapnet.demo_world.render.renderer import Renderer
    from predmapnet.demo_world.rig import DEMO_RIG, LIDAR_TO_EGO
    from predmapnet.demo_world.truth import truth_from_vector_map

    world = build_world(folder.name)
    cameras = [window_camera(camera, config, OVERSAMPLING) for camera in DEMO_RIG]
    renderer = Renderer(world, supersampling=1)
    poses = world.trajectory.ego_to_global
    size = (config.image.width, config.image.height)
    images = np.empty((len(poses), len(cameras), config.image.height, config.image.width, 3), np.uint8)
    for frame in range(len(poses)):
        for index, camera in enumerate(cameras):
            picture = renderer.render(camera, frame).image
            images[frame, index] = cv2.resize(picture, size, interpolation=cv2.INTER_AREA)
    truth = truth_from_vector_map(world.map)
    lidar_to_global = poses @ LIDAR_TO_EGO
    truths = [truth.frame(pose, config.roi) for pose in lidar_to_global]
    # As the nuScenes reader has it: ego axes, origin at the lidar's x and y.
    shifted = poses.copy()
    shifted[:, :2, 3] = lidar_to_global[:, :2, 3]
    ego_to_shifted = np.eye(4)
    ego_to_shifted[:2, 3] = -LIDAR_TO_EGO[:2, 3]
    rig = tuple(replace(camera, camera_to_ego=ego_to_shifted @ camera.camera_to_ego) for camera in DEMO_RIG)
    lidar = None
    if config.depth.enabled:
        lidar_to_shifted = ego_to_shifted @ LIDAR_TO_EGO
        sweeps = (scan(renderer, frame)[:, :3].astype(np.float64) for frame in range(len(poses)))
        lidar = [sweep @ lidar_to_shifted[:3, :3].T + lidar_to_shifted[:3, 3] for sweep in sweeps]
    write_cached_scene(folder, rig, images, shifted, truths, lidar)


def window_camera(camera: Camera, config: PredMapNetConfig, factor: int) -> Camera:
    """Return the camera that takes exactly the network's window of ``camera``, ``factor`` times as fine.

    Raises:
        UserError: the window leaves the image, so that part of it would have to be black.
    """
    window = image_window(camera, config.image)
    if window.top + config.image.height > window.scaled_height:
        raise UserError(f"The window of {config.image.height} rows does not fit into {camera.name}.")
    return replace(
        camera,
        width=config.image.width * factor,
        height=config.image.height * factor,
        intrinsics=np.diag([factor, factor, 1.0]) @ window_intrinsics(camera, config.image),
    )
