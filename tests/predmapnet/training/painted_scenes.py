"""Scenes without a renderer: random polylines, painted into black images through the projection of a rig."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from mapfusion.elements import RegionOfInterest
from mapfusion.geometry import clip_line, inverse_pose, resample, transform_points
from predmapnet.config import PredMapNetConfig
from predmapnet.demo_world.rig import DEMO_RIG
from predmapnet.network.image_input import window_intrinsics
from predmapnet.scenes import FrameTruth, Rig
from predmapnet.training.data.scene_cache import CachedScene, read_cached_scene, write_cached_scene
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
    truths, images = [], []
    for pose in poses:
        truth = _truth(lines, pose, config.roi)
        truths.append(truth)
        images.append(_paint(truth, config, rig))
    sweeps = [generator.uniform([-40, -20, 0], [40, 20, 3], (2000, 3)) for _ in poses] if config.depth.enabled else None
    write_cached_scene(folder, rig, np.stack(images), poses, truths, sweeps)
    return read_cached_scene(folder)


def _truth(lines: list, pose: np.ndarray, roi: RegionOfInterest) -> FrameTruth:
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
