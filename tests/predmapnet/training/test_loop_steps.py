"""What the loop makes of losses: AdamW's steps at the rates of the schedule, their average, and the best one kept."""

from dataclasses import replace
from itertools import islice

import pytest
import torch

from predmapnet.network.predmapnet import PredMapNet
from predmapnet.training.data.batches import StreamSegment
from predmapnet.training.instants import StageTraining
from predmapnet.training.loop import BEST, Trainer
from predmapnet.training.optimiser import learning_rate
from predmapnet.training.settings import BEV_PARTS, LITE_STAGES, NUSCENES_STAGES
from predmapnet.training.stage_data import StageData
from predmapnet.weights.checkpoint import load_checkpoint
from tests.predmapnet.training.painted_scenes import painted_scenes, tiny_config
from tests.predmapnet.training.small_runs import OFTEN, Given, drawn, one_process, planned_for, quiet
from tests.predmapnet.training.tiny_clips import painted_clip, tiny_network, tiny_paper_config

pytestmark = pytest.mark.usefixtures("one_thread")
STEPS = 4


@pytest.fixture(scope="module")
def scenes(tmp_path_factory):
    return painted_scenes(tmp_path_factory.mktemp("scenes"), 5, tiny_config())


def stage_with(**changes):
    """Single frames, with a bound on the gradient that matters and a slower backbone."""
    settings = replace(LITE_STAGES[0].optimiser, clip_norm=0.5, rates={"image_backbone": 0.1}, warmup_steps=2)
    return replace(LITE_STAGES[0], optimiser=replace(settings, **changes))


def by_hand(network, stage, planned, segments):
    """Weights and their average after some steps of torch's AdamW."""
    training, settings = StageTraining(network.train(), stage, (0, 0)), stage.optimiser
    slow = [p for name, p in network.named_parameters() if name.startswith("image_backbone.")]
    others = [p for name, p in network.named_parameters() if not name.startswith("image_backbone.")]
    groups = [
        {"params": [p for p in part if (p.ndim < 2) == bare], "weight_decay": 0.0 if bare else 0.02, "rate": rate}
        for part, rate in ((slow, 0.1), (others, 1.0))
        for bare in (True, False)
    ]
    optimiser = torch.optim.AdamW(groups, betas=(0.9, 0.98))
    average = {name: value.clone() for name, value in network.state_dict().items()}
    for step, segment in enumerate(segments):
        network.zero_grad()
        torch.stack(list(training(segment, step).values())).sum().backward()
        torch.nn.utils.clip_grad_norm_(network.parameters(), 0.5)
        for group in optimiser.param_groups:
            group["lr"] = group["rate"] * learning_rate(step, (0, STEPS), planned.rate, settings)
        optimiser.step()
        decay = min(settings.average_decay, (1 + step) / (10 + step))
        for name, value in network.state_dict().items():
            moving = value.is_floating_point()
            average[name] = decay * average[name] + (1 - decay) * value if moving else value.clone()
    return network.state_dict(), average


@pytest.mark.parametrize("average", [0.15, 0.0])
def test_the_loop_takes_the_steps_of_adamw_and_measures_what_it_ships(scenes, tmp_path, average):
    stage, seen = stage_with(average_decay=average), []
    planned = planned_for(stage, STEPS, batch=2)
    torch.manual_seed(0)
    trainer = Trainer(one_process(), PredMapNet(tiny_config()), tmp_path, OFTEN, quiet)
    segments = list(islice(drawn(planned, trainer.network, scenes, tmp_path).segments(0), STEPS))

    def validate(network, _stage):
        seen.append(network is trainer.result and not network.training)
        return {}

    assert trainer.run(planned, Given(segments), validate)
    assert seen == [True] * STEPS
    torch.manual_seed(0)
    weights, moving = by_hand(PredMapNet(tiny_config()), stage, planned, segments)
    assert (trainer.result is trainer.network) == (average == 0.0)
    for found, wanted in ((trainer.network, weights), (trainer.result, moving if average else weights)):
        for name, value in found.state_dict().items():
            torch.testing.assert_close(
                value, wanted[name], rtol=1e-4, atol=2e-6, msg=lambda text, at=name: f"{at}: {text}"
            )


def test_the_best_of_the_validations_is_kept(scenes, tmp_path):
    figures = iter([0.2, 0.5, 0.3, 0.4])
    trainer = Trainer(one_process(), PredMapNet(tiny_config()), tmp_path, OFTEN, quiet)
    planned = planned_for(stage_with(), STEPS, batch=2)
    data = drawn(planned, trainer.network, scenes, tmp_path)
    assert trainer.run(planned, data, lambda *_: {"mAP": next(figures)})
    facts = load_checkpoint(tmp_path / BEST).facts
    assert (facts["step"], facts["mAP"], trainer.position.best) == (2, 0.5, {"single": 0.5})


def test_stages_draw_other_frames_than_each_other(scenes):
    one, other = (
        StageData(planned_for(replace(LITE_STAGES[0], name=name), STEPS, batch=2), scenes, 0) for name in ("a", "b")
    )
    assert [one.name(step) for step in range(4)] != [other.name(step) for step in range(4)]


def test_a_camera_without_an_image_learns_no_depth(tmp_path):
    """Whatever the lidar says of it; and frozen parts have no gradient."""
    config = tiny_paper_config()
    (instant,) = painted_clip(tmp_path, config, frames=1)
    instant.camera_valid[:, 2] = False
    found = []
    for told in (True, False):
        torch.manual_seed(0)
        network = tiny_network(config)
        if not told:
            instant = replace(instant, depth=instant.depth.index_fill(1, torch.tensor([2]), -1))
        terms = StageTraining(network, NUSCENES_STAGES[0])(StreamSegment([instant]), 0)
        found.append(float(terms["depth"].detach()))
    assert found[0] == pytest.approx(found[1], rel=1e-5) and found[0] > 0
    warmup = StageTraining(network, NUSCENES_STAGES[1])
    frozen = {name.split(".")[0] for name, p in warmup.network.named_parameters() if not p.requires_grad}
    assert frozen == set(BEV_PARTS)
