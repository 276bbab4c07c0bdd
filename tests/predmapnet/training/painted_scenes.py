"""Scenes without a renderer: random polylines, painted into black images through the projection of a rig."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

from mapfusion.elements import RegionOfInterest
from mapfusion.geometry import clip_line, inverse_pose, resample, transform_points
from predmapnet.config import PredMapNetConfig
from predmapnet.demo_world.rig import DEMO_RIG
from predmapnet.frame_cache.depth_targets import depth_of_frame
from predmapnet.frame_cache.fill_cache import write_index
from predmapnet.frame_cache.scene_cache import CachedScene, TrainingScenes, frame_arrays, frame_path, write_arrays
from predmapnet.network.calibration import calibrate
from predmapnet.network.image_input import window_intrinsics
from predmapnet.scenes import FrameTruth, Rig
from tests.predmapnet.small_networks import small_config

COLOURS = ((255, 60, 60), (255, 255, 255), (60, 120, 255))


def tiny_config() -> PredMapNetConfig:
    """The lite network, made small enough for tests."""
    return small_config(
        "lite",
        image={"width": 128, "height": 48},
        bev={
            "rows": 24,
            "columns": 48,
            "backbone": {"stem": (8, 16), "widths": (16, 16, 24), "channels": 16},
            "memory": {"channels": 8, "capacity": 8},
        },
        decoder={"queries": 12, "points": 20},
    )


def painted_scene(folder: Path, frames: int, seed: int, config: PredMapNetConfig, rig: Rig = DEMO_RIG) -> CachedScene:
    """Write and open a scene of a straight drive past a few lines and a crossing."""
    generator = np.random.default_rng(seed)
    lines = [
        (kind, np.stack([np.linspace(-60, 100, 9), generator.uniform(-12, 12) + generator.normal(0, 0.5, 9)], 1))
        for kind in (1, 1, 2)
    ]
    corner = generator.uniform([0, -6], [20, 0])
    lines.append((0, corner + np.array([[0, 0], [4, 0], [4, 9], [0, 9], [0, 0]])))
    poses = np.repeat(np.eye(4)[None], frames, 0)
    poses[:, 0, 3] = np.arange(frames) * 3.0
    truths = [_truth(lines, pose, config.roi) for pose in poses]
    folder.mkdir(parents=True)
    for number, (pose, truth) in enumerate(zip(poses, truths, strict=True)):
        # Single bright pixels on black are no photograph: they are kept as they are.
        pixels = _paint(truth, config, rig).reshape(-1, config.image.width, 3)[:, :, ::-1]
        arrays = {"images": cv2.imencode(".png", pixels)[1], "camera_valid": np.ones(len(rig), np.bool_)}
        if config.depth.enabled:
            sweep = generator.uniform([-40, -20, 0], [40, 20, 3], (2000, 3))
            arrays["depth"] = depth_of_frame(sweep, rig, config)
        arrays |= frame_arrays(pose, calibrate(rig, config), truth)
        write_arrays(frame_path(folder, number), arrays)
    write_index(folder, range(frames), truths)
    return CachedScene(folder)


def painted_scenes(
    folder: Path, frames: int, config: PredMapNetConfig, rigs: Sequence[Rig] = (DEMO_RIG, DEMO_RIG)
) -> TrainingScenes:
    """Write and open a painted scene for each rig."""
    scenes = [painted_scene(folder / f"scene-{i}", frames, i, config, rig) for i, rig in enumerate(rigs)]
    return TrainingScenes(scenes, [1.0] * len(scenes), config)


def _truth(lines: list[tuple[int, np.ndarray]], pose: np.ndarray, roi: RegionOfInterest) -> FrameTruth:
    pieces = [
        (kind, part, number)
        for number, (kind, points) in enumerate(lines)
        for part in clip_line(transform_points(inverse_pose(pose), points), roi)
        if kind != 0 or len(part) == 5
    ]
    return FrameTruth(
        np.array([kind for kind, _, _ in pieces], dtype=np.int64),
        tuple(part for _, part, _ in pieces),
        np.array([number for _, _, number in pieces], dtype=np.int64),
    )


def _paint(truth: FrameTruth, config: PredMapNetConfig, rig: Rig) -> np.ndarray:
    images = []
    for camera in rig:
        image = np.zeros((config.image.height, config.image.width, 3), np.uint8)
        intrinsics = window_intrinsics(camera, config.image)
        ego_to_camera = inverse_pose(camera.camera_to_ego)
        for kind, line in zip(truth.kinds, truth.polylines, strict=True):
            dense = resample(line, 200)
            ego = np.concatenate([dense, np.zeros((200, 1)), np.ones((200, 1))], 1)
            seen = (ego @ ego_to_camera.T)[:, :3]
            pixels = seen[seen[:, 2] > 0.5] @ intrinsics.T
            for x, y in (pixels[:, :2] / pixels[:, 2:]).round().astype(int):
                if abs(x) < 10_000 and abs(y) < 10_000:
                    cv2.circle(image, (int(x), int(y)), 1, COLOURS[kind], -1)
        images.append(image)
    return np.stack(images)
