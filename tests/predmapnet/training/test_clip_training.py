"""The paper's network trains through its three stages in the training loop, from a baseline's weights if wanted."""

import json
from dataclasses import replace
from itertools import islice

import numpy as np
import pytest
import torch
from painted_scenes import painted_scenes
from tiny_clips import tiny_paper_config

from predmapnet.errors import UserError
from predmapnet.network.predmapnet import PredMapNet
from predmapnet.presets import preset
from predmapnet.training.clips import ClipTraining
from predmapnet.training.data.augmentation import AugmentationSettings
from predmapnet.training.data.depth_targets import UNKNOWN
from predmapnet.training.data.draws import Clips, step_loader
from predmapnet.training.loop import Trainer
from predmapnet.training.optimiser import make_optimiser
from predmapnet.training.process_group import ProcessGroup
from predmapnet.training.settings import BEV_PARTS, CLIP_STAGES, Budget, ClipSettings, plan_run

CONFIG = tiny_paper_config()
SETTINGS = replace(plan_run(CONFIG, "all", 1.0, 1), clips=ClipSettings(frames=2, span=3), log_steps=1)


@pytest.fixture(scope="module")
def scenes(tmp_path_factory):
    return painted_scenes(tmp_path_factory.mktemp("scenes"), 5, CONFIG)


def test_a_run_goes_through_all_stages_and_freezes_what_they_leave(scenes, tmp_path):
    torch.manual_seed(0)
    network = PredMapNet(CONFIG)
    trainer = Trainer(network, SETTINGS, tmp_path, ProcessGroup(), lambda _line: None)
    for stage, budget in SETTINGS.clip_stages:
        trainable = ClipTraining(stage, network, scenes, SETTINGS, ProcessGroup())
        frozen = [getattr(network, part) for part in stage.frozen]
        before = [{name: value.clone() for name, value in part.named_parameters()} for part in frozen]
        optimiser = replace(SETTINGS.clip_optimiser, rates=stage.rates, average_decay=0.0)
        assert trainer.run(trainable, budget, optimiser, lambda _network, _stage: {})
        for part, values in zip(frozen, before, strict=True):
            assert all(torch.equal(value, values[name]) for name, value in part.named_parameters())
    lines = [json.loads(line) for line in (tmp_path / "metrics.jsonl").read_text().splitlines()]
    assert trainer.position.finished == ["bev", "warmup", "joint"]
    assert {line["stage"] for line in lines} == {"bev", "warmup", "joint"}
    assert all("segmentation" in line for line in lines if "loss" in line)


def test_clips_end_with_their_frame_and_repeat_for_a_seed(scenes):
    clips = Clips(scenes, AugmentationSettings(), (5, 0), frames=3, span=4)
    (first, *others), again = ([*islice(step_loader(clips, 2, 7), 6)] for _ in range(2))
    assert len(first.instants) == 3
    for one, other in zip(first.instants, again[0].instants, strict=True):
        assert torch.equal(one.images, other.images)
    for segment in (first, *others):
        driven = np.stack([instant.ego_to_global[:, 0, 3].numpy() for instant in segment.instants])
        assert (np.diff(driven, axis=0) >= 0).all(), "in time order"
        assert (driven[-1] - driven[0] <= 4 * 3.0 + 1e-9).all(), "within the span; scenes are driven at 3 m per frame"
    assert first.instants[0].depth.shape == (2, 6, 8, 12)
    assert (first.instants[0].depth != UNKNOWN).any()


def test_a_plan_shares_out_the_time_and_refuses_stages_of_other_networks():
    shares = [budget for _, budget in plan_run(CONFIG, "all", 72.0, None).clip_stages]
    assert shares == [Budget(18.0), Budget(6.0), Budget(48.0)]
    assert [stage.name for stage, _ in plan_run(CONFIG, "joint", 70.0, 3).clip_stages] == ["joint"]
    lite = plan_run(preset("lite"), "all", 60.0, None)
    assert (lite.single, lite.temporal, lite.clip_stages) == (Budget(40.0), Budget(pytest.approx(20.0)), ())
    for config, stage in ((CONFIG, "single"), (preset("lite"), "joint")):
        with pytest.raises(UserError, match=f"no stage '{stage}'"):
            plan_run(config, stage, 1.0, None)


def test_parts_learn_at_their_own_rates():
    network = PredMapNet(CONFIG)
    for stage in CLIP_STAGES:
        settings = replace(SETTINGS.clip_optimiser, rates=stage.rates)
        groups = make_optimiser(network, settings).param_groups
        rates = {id(p): group["rate"] for group in groups for p in group["params"]}
        assert len(rates) == len(list(network.parameters()))
        joint = stage.name == "joint"
        assert rates[id(network.image_backbone.resnet.stages[0][0].reduce.convolution.weight)] == 0.1
        assert rates[id(network.bev_encoder.layers[0].norms[0].weight)] == (0.5 if joint else 1.0)
        assert rates[id(network.bev_encoder.queries)] == 1.0
        assert rates[id(network.map_decoder.classify.weight)] == 1.0
    assert all(hasattr(network, part) for part in BEV_PARTS)
