"""The numbers of the training: Sec. 3.6 and 4.1, and MapTracker's, on which the paper builds."""

from dataclasses import replace

import pytest
from torch import nn

from predmapnet.presets import preset
from predmapnet.training.optimiser import learning_rate, make_optimiser
from predmapnet.training.settings import plan_run

PAPER = plan_run(preset("paper-nuscenes"), "all", 72.0, None)
STAGES = {stage.name: stage for stage, _ in PAPER.clip_stages}


def test_losses_and_noise():
    clips = PAPER.clips
    assert (clips.mask_dice, clips.mask_entropy) == (2.0, 1.0), "lambda_dice and lambda_bce of Sec. 3.6"
    assert clips.forecast == 1.0, "the total of Sec. 3.6 has no weight for it"
    assert clips.depth == 3.0, "MapTRv2"
    assert (clips.frames, clips.span, clips.track_score) == (5, 10, 0.4), "MapTracker"
    assert (clips.angle_noise, clips.distance_noise) == (0.08, 0.25), "MapTracker"


def test_epochs_of_the_three_stages_on_nuscenes():
    assert {name: stage.epochs for name, stage in STAGES.items()} == {"bev": 18, "warmup": 6, "joint": 48}


@pytest.mark.parametrize(
    ("name", "vectors", "images", "memory_from", "final", "rates"),
    [
        ("bev", False, "first and last", 0, 0.05, {"image_backbone.resnet": 0.1}),
        ("warmup", True, "none", 500, 0.95, {"image_backbone.resnet": 0.1}),
        (
            "joint",
            True,
            "last",
            0,
            0.003,
            {"image_backbone.resnet": 0.1, "image_backbone": 0.5, "bev_encoder": 0.5, "bev_encoder.queries": 1.0}
            | {"segmentation_head": 0.5},
        ),
    ],
)
def test_what_each_stage_trains_and_how_fast(name, vectors, images, memory_from, final, rates):
    stage = STAGES[name]
    assert (stage.vectors, stage.images, stage.memory_from_step, stage.final_rate) == (
        vectors,
        images,
        memory_from,
        final,
    )
    assert dict(stage.rates) == rates
    frozen = {"image_backbone", "bev_encoder", "segmentation_head", "depth_head"} if name == "warmup" else set()
    assert set(stage.frozen) == frozen


@pytest.mark.parametrize("name", STAGES)
def test_the_learning_rate_warms_up_from_a_third_and_falls_along_a_cosine(name):
    final = STAGES[name].final_rate
    settings = replace(PAPER.clip_optimiser, final_fraction=final)
    assert learning_rate(0, 0.0, settings) == pytest.approx(5e-4 / 3, rel=1e-2)
    assert learning_rate(249, 0.0, settings) == pytest.approx(5e-4 * 2 / 3)
    assert learning_rate(499, 0.0, settings) == pytest.approx(5e-4)
    assert learning_rate(10_000, 0.5, settings) == pytest.approx(5e-4 * (1 + final) / 2)
    assert learning_rate(20_000, 1.0, settings) == pytest.approx(5e-4 * final)


def test_adamw_decays_everything_and_gradients_are_clipped():
    settings = PAPER.clip_optimiser
    network = nn.Sequential(nn.Linear(3, 4), nn.LayerNorm(4))
    groups = [group for group in make_optimiser(network, settings).param_groups if group["params"]]
    assert sum(len(group["params"]) for group in groups) == 4
    assert {(group["weight_decay"], group["betas"]) for group in groups} == {(0.01, (0.9, 0.999))}
    assert settings.clip_norm == 35.0
    assert settings.average_decay == 0.0, "MapTracker averages no weights"


def test_norms_and_biases_of_the_lighter_network_are_not_decayed():
    network = nn.Sequential(nn.Linear(3, 4), nn.LayerNorm(4))
    groups = make_optimiser(network, plan_run(preset("lite"), "all", 60.0, None).optimiser).param_groups
    assert sorted((group["weight_decay"], len(group["params"])) for group in groups) == [(0.0, 3), (0.02, 1)]
