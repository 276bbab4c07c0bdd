"""The numbers of the training: Sec. 3.6 and 4.1, and MapTracker's, on which the paper builds."""

import pytest
from torch import nn

from predmapnet.presets import PRESETS, preset
from predmapnet.training.optimiser import learning_rate, make_optimiser
from predmapnet.training.plan import PlanOptions, plan_stages
from predmapnet.training.settings import choose_stages

PAPER = choose_stages(preset("paper-nuscenes"))
STAGES = {stage.name: stage for stage in PAPER}


@pytest.mark.parametrize("name", STAGES)
def test_losses_and_noise(name):
    stage = STAGES[name]
    losses = stage.losses
    assert (losses.mask_dice, losses.mask_entropy) == (2.0, 1.0), "lambda_dice and lambda_bce of Sec. 3.6"
    assert losses.forecast == 1.0, "the total of Sec. 3.6 has no weight for it"
    assert losses.depth == 3.0, "MapTRv2"
    assert (losses.focal, losses.points / 2, losses.transformation) == (5.0, 50.0, 0.1), "MapTracker"
    assert (losses.segmentation, losses.segmentation_dice) == (100.0, 1.0), "MapTracker"
    assert (stage.frames, stage.span, stage.tracks.score) == (5, 10, 0.4), "MapTracker"
    assert (stage.angle_noise, stage.distance_noise) == (0.08, 0.25), "MapTracker"
    assert (stage.augmentation.grid_mask, stage.augmentation.mirror) == (0.7, 0.0), "MapTracker"


@pytest.mark.parametrize(
    ("presets", "epochs"),
    [(("paper-nuscenes", "maptracker-nuscenes"), (18, 6, 48)), (("paper-av2", "maptracker-av2"), (12, 3, 20))],
)
def test_epochs_of_the_three_stages(presets, epochs):
    for name in presets:
        stages = choose_stages(PRESETS[name])
        assert [stage.name for stage in stages] == ["bev", "warmup", "joint"]
        assert tuple(stage.epochs for stage in stages) == epochs


def test_clips_of_a_gpu_and_the_whole_batch_of_the_learning_rate():
    assert [(stage.per_device, stage.batch) for stage in PAPER] == [(1, 8), (6, 48), (2, 16)], "MapTracker's 8 GPUs"
    planned = plan_stages(PAPER, 27968, PlanOptions(devices=8))
    assert [each.rate for each in planned] == [5e-4] * 3
    assert [each.steps for each in planned] == [18 * 3496, 6 * 582, 48 * 1748], "MapTracker's length of an epoch"


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
    assert (stage.vectors, stage.images, stage.memory_from_step) == (vectors, images, memory_from)
    assert stage.optimiser.final_fraction == final
    assert dict(stage.optimiser.rates) == rates
    frozen = {"image_backbone", "bev_encoder", "segmentation_head", "depth_head"} if name == "warmup" else set()
    assert set(stage.frozen) == frozen


@pytest.mark.parametrize("name", STAGES)
def test_the_learning_rate_warms_up_from_a_third_and_falls_along_a_cosine(name):
    settings = STAGES[name].optimiser
    final, fall = settings.final_fraction, (0, 20_000)
    assert learning_rate(0, None, 5e-4, settings) == pytest.approx(5e-4 / 3, rel=1e-2)
    assert learning_rate(249, None, 5e-4, settings) == pytest.approx(5e-4 * 2 / 3)
    assert learning_rate(499, None, 5e-4, settings) == pytest.approx(5e-4)
    assert learning_rate(10_000, fall, 5e-4, settings) == pytest.approx(5e-4 * (1 + final) / 2)
    assert learning_rate(20_000, fall, 5e-4, settings) == pytest.approx(5e-4 * final)


def test_adamw_decays_everything_and_gradients_are_clipped():
    settings = STAGES["joint"].optimiser
    assert settings.learning_rate == 5e-4
    network = nn.Sequential(nn.Linear(3, 4), nn.LayerNorm(4))
    groups = [group for group in make_optimiser(network, settings).param_groups if group["params"]]
    assert sum(len(group["params"]) for group in groups) == 4
    assert {(group["weight_decay"], group["betas"]) for group in groups} == {(0.01, (0.9, 0.999))}
    assert settings.clip_norm == 35.0
    assert settings.average_decay == 0.0, "MapTracker averages no weights"


def test_norms_and_biases_of_the_lighter_network_are_not_decayed():
    network = nn.Sequential(nn.Linear(3, 4), nn.LayerNorm(4))
    groups = make_optimiser(network, choose_stages(preset("lite"))[0].optimiser).param_groups
    assert sorted((group["weight_decay"], len(group["params"])) for group in groups) == [(0.0, 3), (0.02, 1)]
