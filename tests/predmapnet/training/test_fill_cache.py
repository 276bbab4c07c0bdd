"""Demo scenes in the training cache: what the stored rig and truth say is what the stored images show."""

from __future__ import annotations

import numpy as np
import pytest

from mapfusion.elements import ElementKind
from predmapnet.config import PredMapNetConfig
from predmapnet.demo_world.catalogue import SPLITS, look_of
from predmapnet.demo_world.rig import DEMO_RIG
from predmapnet.demo_world.rigs import sample_rig
from predmapnet.frame_cache.fill_cache import cache_demo_scene
from predmapnet.frame_cache.scene_cache import CachedScene


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> CachedScene:
    """A training scene by day, of a small rig whose ego origin lies above the road."""
    number = next(
        number
        for number in SPLITS["train"]
        if look_of(f"scene-{number:04d}") == "day"
        and len(sample_rig(number)) <= 4
        and sample_rig(number)[0].ground_height < -0.2
    )
    folder = tmp_path_factory.mktemp("cache") / f"scene-{number:04d}"
    cache_demo_scene(folder, PredMapNetConfig())
    return CachedScene(folder)


def _brightness(scene: CachedScene, frame: int, points: np.ndarray) -> np.ndarray:
    """Brightness at points of the road ``(n, 2)``, ego frame, of those near a camera; NaN where none sees them."""
    stored = scene.frame(frame)
    height_of_road = float(stored.calibration.ground_height[0, 0])
    ground = np.column_stack([points, np.full(len(points), height_of_road), np.ones(len(points))])
    found = np.full(len(points), np.nan)
    for matrix, picture in zip(stored.calibration.ego_to_image[0].numpy(), stored.images, strict=True):
        u, v, depth = (ground @ matrix.T).T
        column, row = np.floor(u / np.maximum(depth, 0.1)), np.floor(v / np.maximum(depth, 0.1))
        height, width = picture.shape[:2]
        seen = (depth > 3) & (depth < 14) & (column >= 0) & (column < width) & (row >= 0) & (row < height)
        image = picture.astype(float).mean(axis=2)
        found[seen] = image[row[seen].astype(int), column[seen].astype(int)]
    return found


def test_paint_is_where_rig_and_truth_say(scene: CachedScene) -> None:
    contrast = {0.0: [], 0.7: []}
    for frame in range(len(scene)):
        truth = scene.frame(frame, images=False).truth
        for kind, line in zip(truth.kinds, truth.polylines, strict=True):
            if kind != ElementKind.DIVIDER or len(line) < 2:
                continue
            step = np.diff(line, axis=0)
            length = np.linalg.norm(step, axis=1, keepdims=True)
            middle, aside = (line[1:] + line[:-1]) / 2, np.stack([-step[:, 1], step[:, 0]], axis=1) / length
            for shift, values in contrast.items():
                here = _brightness(scene, frame, middle + shift * aside)
                around = [_brightness(scene, frame, middle + (shift + side) * aside) for side in (-0.7, 0.7)]
                values.append(here - np.mean(around, axis=0))
    on_paint, beside = (np.nanmean(np.concatenate(values)) for values in contrast.values())
    assert on_paint > 3.0
    assert on_paint > beside + 4.0


def test_training_scenes_keep_their_own_car_and_validation_scenes_the_demo_car(scene: CachedScene) -> None:
    rig = sample_rig(int(scene.name[-4:]))
    frames = [scene.frame(index) for index in range(len(scene))]
    heights = [
        np.linalg.solve(matrix[:, :3], -matrix[:, 3])[2] for matrix in frames[0].calibration.ego_to_image[0].numpy()
    ]
    np.testing.assert_allclose(heights, [camera.camera_to_ego[2, 3] for camera in rig])
    np.testing.assert_allclose([frame.ego_to_global[2, 3] for frame in frames], -rig[0].ground_height, atol=0.02)
    assert {frame.images.shape for frame in frames} == {(len(rig), 96, 256, 3)} and len(frames) == 40
    assert all(frame.camera_valid.all() for frame in frames)
    assert rig is not DEMO_RIG
