"""Demo scenes for training: drawn straight at the network's size, in cars of all kinds."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from mapfusion.arrays import Float
from mapfusion.elements import RegionOfInterest
from mapfusion.geometry import inverse_pose
from predmapnet.demo_world.catalogue import SPLITS, build_world, scene_number
from predmapnet.demo_world.render.lidar import scan
from predmapnet.demo_world.render.renderer import Renderer
from predmapnet.demo_world.render.response import Response, draw_response
from predmapnet.demo_world.rig import DEMO_RIG, LIDAR_TO_EGO
from predmapnet.demo_world.rigs import sample_rig
from predmapnet.demo_world.street.looks import Light, harder_light, light_of
from predmapnet.demo_world.truth import truth_from_vector_map
from predmapnet.demo_world.world import World
from predmapnet.scenes import Camera, FrameTruth, Rig

EDGE_SAMPLES = 2
"""Samples per pixel and direction along the edges of solids."""
TEXEL = 0.05
"""Metres of the ground's texture, about a pixel of the network at 15 m."""
SCALING_BLUR = 1.0
"""Standard deviation by which scaling photographs down blurs them, pixels of an image 800 wide."""


@dataclass(frozen=True)
class TrainingDrive:
    """One scene, drawn.

    Attributes:
        rig: the cameras.
        images: one ``(N, h, w, 3) uint8`` a frame, RGB.
        ego_to_global: ``(n, 4, 4)``; ego axes, origin at the lidar's x and y, as the nuScenes reader has it.
        truths: one a frame.
        sweeps: lidar points ``(k, 3)`` of each frame, metres, ego frame; None where nobody asked for them.
    """

    rig: Rig
    images: tuple[NDArray[np.uint8], ...]
    ego_to_global: Float
    truths: tuple[FrameTruth, ...]
    sweeps: tuple[Float, ...] | None


def training_drive(
    name: str, window: Callable[[Camera], Camera], roi: RegionOfInterest, any_car: bool, with_lidar: bool
) -> TrainingDrive:
    """Draw a scene.

    Args:
        name: of the scene.
        window: gives the camera that takes exactly what the network sees of a camera.
        roi: of the truth.
        any_car: give training scenes a car of their own; validation and test scenes have the demo car anyway.
        with_lidar: sweep the lidar, too.
    """
    world = build_world(name)
    rig, response, light = _car_and_light(world, any_car)
    lift = np.eye(4)
    lift[2, 3] = -rig[0].ground_height
    poses = world.trajectory.ego_to_global @ lift
    world = replace(world, trajectory=replace(world.trajectory, ego_to_global=poses))
    lidar_to_ego = inverse_pose(lift) @ LIDAR_TO_EGO
    renderer = Renderer(world, supersampling=EDGE_SAMPLES, response=response, light=light, texel=TEXEL)
    cameras = tuple(window(camera) for camera in rig)
    images = tuple(
        np.stack([drawn.image for drawn in renderer.render_frame(cameras, frame).values()])
        for frame in range(len(poses))
    )
    truth = truth_from_vector_map(world.map)
    lidar_to_global = poses @ lidar_to_ego
    shifted, ego_to_shifted = poses.copy(), np.eye(4)
    shifted[:, :2, 3] = lidar_to_global[:, :2, 3]
    ego_to_shifted[:2, 3] = -lidar_to_ego[:2, 3]
    rig = tuple(replace(camera, camera_to_ego=ego_to_shifted @ camera.camera_to_ego) for camera in rig)
    turn, place = (ego_to_shifted @ lidar_to_ego)[:3, :3], (ego_to_shifted @ lidar_to_ego)[:3, 3]
    sweeps = (scan(renderer, frame, lidar_to_ego)[:, :3].astype(np.float64) for frame in range(len(poses)))
    return TrainingDrive(
        rig=rig,
        images=images,
        ego_to_global=shifted,
        truths=tuple(truth.frame(pose, roi) for pose in lidar_to_global),
        sweeps=tuple(sweep @ turn.T + place for sweep in sweeps) if with_lidar else None,
    )


def training_rig(name: str, any_car: bool) -> Rig:
    """Return the cameras of a scene: training scenes have a car of their own if ``any_car``, others the demo car."""
    number = scene_number(name)
    return sample_rig(number) if any_car and number in SPLITS["train"] else DEMO_RIG


def _car_and_light(world: World, any_car: bool) -> tuple[Rig, Response, Light]:
    """The cameras of a scene, how they expose, and the light of the scene."""
    number, light = scene_number(world.name), light_of(world.look, world.seed)
    rig, response = training_rig(world.name, any_car), Response()
    if number in SPLITS["train"]:
        response, light = draw_response(number), harder_light(light, number)
    return rig, replace(response, blur=float(np.hypot(response.blur, SCALING_BLUR))), light
