"""Fill the training cache: demo towns, rendered straight at the network's size."""

from __future__ import annotations

import multiprocessing
import os
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import replace
from hashlib import sha256
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np

from mapfusion.geometry import inverse_pose
from predmapnet.config import ImageWindowConfig, LookupBevConfig, PredMapNetConfig
from predmapnet.errors import UserError
from predmapnet.network.image_input import image_window, window_intrinsics
from predmapnet.scenes import Camera, Rig
from predmapnet.training.data.scene_cache import Images, write_cached_scene
from predmapnet.training.settings import Report

if TYPE_CHECKING:
    from predmapnet.demo_world.render.renderer import Renderer
    from predmapnet.demo_world.render.response import Response
    from predmapnet.demo_world.street.looks import Light
    from predmapnet.demo_world.world import World

DEMO = "demo"
EDGE_SAMPLES = 2
"""Samples per pixel and direction along the edges of solids."""
TEXEL = 0.07
"""Metres of the ground's texture, finer than a pixel of the network sees it beyond 10 m."""
SCALING_BLUR = 1.0
"""Standard deviation by which scaling photographs down blurs them, pixels of an image 800 wide."""


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

    Training scenes have a car of their own (:func:`~predmapnet.demo_world.rigs.sample_rig`) where the network takes
    any rig, and cameras that expose as they like; validation and test scenes have the demo car.

    Args:
        folder: where to; its name is the scene's.
        config: of the network.
    """
    from predmapnet.demo_world.catalogue import build_world
    from predmapnet.demo_world.render.lidar import scan
    from predmapnet.demo_world.render.renderer import Renderer
    from predmapnet.demo_world.rig import LIDAR_TO_EGO
    from predmapnet.demo_world.truth import truth_from_vector_map

    world = build_world(folder.name)
    rig, response, light = _car_and_light(world, config)
    lift = np.eye(4)
    lift[2, 3] = -rig[0].ground_height
    world = replace(world, trajectory=replace(world.trajectory, ego_to_global=world.trajectory.ego_to_global @ lift))
    poses = world.trajectory.ego_to_global
    lidar_to_ego = inverse_pose(lift) @ LIDAR_TO_EGO
    renderer = Renderer(world, supersampling=EDGE_SAMPLES, response=response, light=light, texel=TEXEL)
    images = _render(renderer, tuple(window_camera(camera, config) for camera in rig))
    truth = truth_from_vector_map(world.map)
    lidar_to_global = poses @ lidar_to_ego
    truths = [truth.frame(pose, config.roi) for pose in lidar_to_global]
    # As the nuScenes reader has it: ego axes, origin at the lidar's x and y.
    shifted = poses.copy()
    shifted[:, :2, 3] = lidar_to_global[:, :2, 3]
    ego_to_shifted = np.eye(4)
    ego_to_shifted[:2, 3] = -lidar_to_ego[:2, 3]
    rig = tuple(replace(camera, camera_to_ego=ego_to_shifted @ camera.camera_to_ego) for camera in rig)
    lidar = None
    if config.depth.enabled:
        lidar_to_shifted = ego_to_shifted @ lidar_to_ego
        sweeps = (scan(renderer, frame, lidar_to_ego)[:, :3].astype(np.float64) for frame in range(len(poses)))
        lidar = [sweep @ lidar_to_shifted[:3, :3].T + lidar_to_shifted[:3, 3] for sweep in sweeps]
    write_cached_scene(folder, rig, images, shifted, truths, lidar)


def _car_and_light(world: World, config: PredMapNetConfig) -> tuple[Rig, Response, Light]:
    """The cameras of a demo scene, how they expose, and the light of the scene."""
    from predmapnet.demo_world.catalogue import SPLITS, scene_number
    from predmapnet.demo_world.render.response import Response, draw_response
    from predmapnet.demo_world.rig import DEMO_RIG
    from predmapnet.demo_world.rigs import sample_rig
    from predmapnet.demo_world.street.looks import harder_light, light_of

    number, light = scene_number(world.name), light_of(world.look, world.seed)
    rig, response = DEMO_RIG, Response()
    if number in SPLITS["train"]:
        # MapTracker's view transform has learned where its six cameras sit.
        rig = sample_rig(number) if isinstance(config.bev, LookupBevConfig) else DEMO_RIG
        response, light = draw_response(number), harder_light(light, number)
    return rig, replace(response, blur=float(np.hypot(response.blur, SCALING_BLUR))), light


def _render(renderer: Renderer, cameras: Rig) -> Images:
    """Draw all frames, ``(n, N, h, w, 3)``."""
    count = len(renderer.world.trajectory.timestamps)
    images = np.empty((count, len(cameras), cameras[0].height, cameras[0].width, 3), np.uint8)
    for frame in range(count):
        images[frame] = np.stack([drawn.image for drawn in renderer.render_frame(cameras, frame).values()])
    return images


def window_camera(camera: Camera, config: PredMapNetConfig) -> Camera:
    """Return the camera that takes exactly the network's window of ``camera``, pixel for pixel.

    Raises:
        UserError: the window leaves the image, so that part of it would have to be black.
    """
    window = image_window(camera, config.image)
    if window.top + config.image.height > window.scaled_height:
        raise UserError(f"The window of {config.image.height} rows does not fit into {camera.name}.")
    return replace(
        camera,
        width=config.image.width,
        height=config.image.height,
        intrinsics=window_intrinsics(camera, config.image),
    )
