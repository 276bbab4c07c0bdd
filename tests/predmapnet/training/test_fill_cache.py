"""Demo scenes in the training cache: what the stored rig and truth say is what the stored images show."""

from __future__ import annotations

import numpy as np
import pytest

from mapfusion.elements import ElementKind
from predmapnet.config import PredMapNetConfig
from predmapnet.demo_world.catalogue import SPLITS, look_of
from predmapnet.demo_world.rig import DEMO_RIG
from predmapnet.demo_world.rigs import sample_rig
from predmapnet.network.image_input import ego_to_image
from predmapnet.training.data.fill_cache import cache_demo_scene
from predmapnet.training.data.scene_cache import CachedScene, read_cached_scene


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
    return read_cached_scene(folder)


def _brightness(scene: CachedScene, frame: int, points: np.ndarray) -> np.ndarray:
    """Brightness at points of the road ``(n, 2)``, ego frame, of those near a camera; NaN where none sees them."""
    ground = np.column_stack([points, np.full(len(points), scene.rig[0].ground_height), np.ones(len(points))])
    found = np.full(len(points), np.nan)
    for camera, matrix in enumerate(ego_to_image(scene.rig, PredMapNetConfig().image)):
        u, v, depth = (ground @ matrix.T)[:, :3].T
        column, row = np.floor(u / np.maximum(depth, 0.1)), np.floor(v / np.maximum(depth, 0.1))
        height, width = scene.images.shape[2:4]
        seen = (depth > 3) & (depth < 14) & (column >= 0) & (column < width) & (row >= 0) & (row < height)
        image = scene.images[frame, camera].astype(float).mean(axis=2)
        found[seen] = image[row[seen].astype(int), column[seen].astype(int)]
    return found


def test_paint_is_where_rig_and_truth_say(scene: CachedScene) -> None:
    contrast = {0.0: [], 0.7: []}
    for frame, truth in enumerate(scene.truths):
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
    assert [camera.name for camera in scene.rig] == [camera.name for camera in rig]
    heights = [camera.camera_to_ego[2, 3] for camera in scene.rig]
    np.testing.assert_allclose(heights, [camera.camera_to_ego[2, 3] for camera in rig])
    np.testing.assert_allclose(scene.ego_to_global[:, 2, 3], -rig[0].ground_height, atol=0.02)
    assert scene.images.shape == (40, len(rig), 96, 256, 3)
    assert rig is not DEMO_RIG
