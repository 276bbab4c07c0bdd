"""Scenes of different cars train together: every frame brings its own cameras."""

from dataclasses import replace
from itertools import islice

import numpy as np
import pytest
import torch
from painted_scenes import painted_scenes, tiny_config
from tiny_clips import tiny_paper_config

from predmapnet.augmentation.frames import AugmentationSettings
from predmapnet.augmentation.photography import PhotographySettings
from predmapnet.config import PredMapNetConfig
from predmapnet.demo_world.rig import DEMO_RIG
from predmapnet.frame_cache.scene_cache import TrainingScenes
from predmapnet.network.predmapnet import PredMapNet
from predmapnet.training.data.batches import Batch
from predmapnet.training.data.draws import Clips, step_loader
from predmapnet.training.loop import Trainer
from predmapnet.training.settings import choose_stages
from tests.predmapnet.training.small_runs import (
    OFTEN,
    drawn,
    metrics,
    nothing_measured,
    one_process,
    planned_for,
    quiet,
    short_clips,
)

UNCHANGED = AugmentationSettings(
    photography=PhotographySettings(**dict.fromkeys(PhotographySettings.__dataclass_fields__, 0.0)),
    camera_dropout=0.0,
    bumped=0.0,
)


def other_car():
    """Three cameras, higher, off the middle, with other focal lengths."""
    cameras = []
    for number, camera in enumerate(DEMO_RIG[1:4]):
        pose = camera.camera_to_ego.copy()
        pose[:3, 3] += [0.2, 0.3, 0.4 + 0.1 * number]
        cameras.append(replace(camera, camera_to_ego=pose, intrinsics=camera.intrinsics * [[0.8], [0.8], [1.0]]))
    return tuple(cameras)


def mixed_scenes(folder, config: PredMapNetConfig) -> TrainingScenes:
    return painted_scenes(folder, 6, config, (DEMO_RIG, other_car(), DEMO_RIG[:1]))


def share_painted(batch: Batch, config: PredMapNetConfig) -> list[float]:
    """Share of the true points, by frame, that the images show where the calibration projects them."""
    shares = []
    for number, images in enumerate(batch.images):
        points = batch.targets.points[batch.targets.frame == number].flatten(0, 1).double().numpy()
        metres = (points - 0.5) * config.roi.size
        ground = np.column_stack([metres, np.zeros(len(metres)), np.ones(len(metres))])
        hits = []
        for matrix, image in zip(batch.calibration.ego_to_image[number].numpy(), images.numpy(), strict=True):
            u, v, depth = matrix @ ground.T
            ahead = depth > 1.0
            column, row = (u[ahead] / depth[ahead]).astype(int), (v[ahead] / depth[ahead]).astype(int)
            rows, columns = image.shape[:2]
            inside = (column > 1) & (column < columns - 2) & (row > 1) & (row < rows - 2)
            lit = image.max(axis=2) > 0
            around = [lit[row[inside] + i, column[inside] + j] for i in (-1, 0, 1) for j in (-1, 0, 1)]
            hits.append(np.any(around, axis=0))
        shares.append(float(np.concatenate(hits).mean()))
    return shares


def test_each_frame_of_a_batch_shows_the_truth_where_its_own_cameras_see_it(tmp_path):
    config = tiny_config()
    scenes = mixed_scenes(tmp_path, config)
    cameras = set()
    for segment in islice(step_loader(Clips(scenes, UNCHANGED, (0,)), 8), 3):
        batch = segment.instants[0]
        assert batch.images.shape[1] == batch.camera_valid.shape[1] == batch.calibration.camera_code.shape[1]
        cameras |= set(batch.camera_valid.sum(dim=1).tolist())
        assert min(share_painted(batch, config)) > 0.85
    assert cameras == {1, 3, 6}


@pytest.mark.parametrize("name", ["single", "temporal", "bev", "joint"])
def test_every_stage_trains_on_cars_of_different_rigs(name, tmp_path):
    torch.manual_seed(0)
    config = tiny_config() if name in ("single", "temporal") else tiny_paper_config()
    scenes, network = mixed_scenes(tmp_path, config), PredMapNet(config)
    stage = replace(choose_stages(config, name)[0], growth_steps=1, longest=6)
    planned = planned_for(short_clips(stage), steps=2, batch=3)
    trainer = Trainer(one_process(), network, tmp_path / "run", OFTEN, quiet)
    assert trainer.run(planned, drawn(planned, network, scenes, tmp_path), nothing_measured)
    assert all(torch.isfinite(value).all() for value in network.state_dict().values())
    assert all(line["norm"] > 0 for line in metrics(tmp_path / "run"))
