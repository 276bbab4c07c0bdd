"""The plan of a run: steps, batches, rates and budgets."""

from dataclasses import replace

import pytest

from predmapnet.errors import UserError
from predmapnet.presets import preset
from predmapnet.training.plan import PlanOptions, plan_stages
from predmapnet.training.settings import choose_stages

LITE, PAPER = choose_stages(preset("lite")), choose_stages(preset("paper-nuscenes"))


def test_steps_come_from_epochs_and_every_batch_sees_as_many_frames():
    single, temporal = plan_stages(LITE, 6400, PlanOptions(devices=2))
    assert (single.batch, single.share, single.steps) == (6, 3, 24 * (6400 // 6))
    assert (temporal.batch, temporal.share, temporal.steps) == (8, 4, 24 * (6400 // 16)), "a step takes two frames"
    halved = plan_stages(LITE, 6400, PlanOptions(devices=1, batch=3))[0]
    assert halved.steps == 24 * (6400 // 3)


def test_the_rate_grows_with_the_root_of_the_batch_unless_it_is_given():
    four, one = plan_stages(PAPER, 27968, PlanOptions(devices=4)), plan_stages(PAPER, 27968, PlanOptions(batch=1))
    assert [each.rate for each in four] == pytest.approx([5e-4 / 2**0.5] * 3)
    assert [each.rate for each in one] == pytest.approx([5e-4 / batch**0.5 for batch in (8, 48, 16)])
    assert plan_stages(PAPER, 27968, PlanOptions(batch=1, learning_rate=1e-4))[0].rate == 1e-4


def test_a_share_is_taken_in_parts_and_a_batch_that_cannot_be_shared_is_refused():
    bev, warmup, joint = plan_stages(PAPER, 27968, PlanOptions(devices=2, parts=2))
    assert [(each.batch, each.parts, each.share) for each in (bev, warmup, joint)] == [(2, 1, 1), (12, 2, 3), (4, 2, 1)]
    with pytest.raises(UserError, match="batch of 5 cannot be shared out to 2 processes"):
        plan_stages(LITE, 6400, PlanOptions(devices=2, batch=5))
    with pytest.raises(UserError, match=r"batch of 6 .* in 2 parts. Choose --batch 4 times"):
        plan_stages(LITE[:1], 6400, PlanOptions(devices=2, batch=6, parts=2))


def test_minutes_end_a_run_of_lite_in_good_order_and_are_not_for_networks_that_learn_for_days():
    single, temporal = plan_stages(LITE, 6400, PlanOptions(devices=2, minutes=60.0))
    assert (single.minutes, temporal.minutes) == (40.0, 20.0) and single.steps is None
    assert single.fall(1000, 27 * 60.0) == []
    begin, end = single.fall(1000, 28 * 60.0)
    assert (begin, end) == (1000, 1000 + round(12 / 28 * 1000)), "the rest of the steps, at the speed so far"
    assert replace(single, minutes=0.01).fall(1, 20.0) == [1, 2]
    with pytest.raises(UserError, match="--minutes is for lite"):
        plan_stages(PAPER, 6400, PlanOptions(minutes=60.0))


def test_steps_shorten_a_stage_and_so_its_schedule():
    (joint,) = plan_stages(PAPER[2:], 27968, PlanOptions(steps=7))
    assert joint.fall(0, 0.0) == [0, 7]


def test_a_stage_that_a_network_has_not_is_refused():
    for name, stage in (("paper-nuscenes", "single"), ("lite", "joint")):
        with pytest.raises(UserError, match=f"no stage '{stage}'"):
            choose_stages(preset(name), stage)
