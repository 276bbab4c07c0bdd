"""Losses that are no numbers: the step is skipped and named, and a run of nothing else ends."""

from dataclasses import replace

import pytest
import torch

from predmapnet.errors import UserError
from predmapnet.network.image_input import normalise_images
from predmapnet.network.predmapnet import PredMapNet
from predmapnet.training.loop import BAD_STEPS, Trainer
from predmapnet.training.settings import LITE_STAGES
from tests.predmapnet.training.painted_scenes import painted_scenes, tiny_config
from tests.predmapnet.training.small_runs import (
    OFTEN,
    Given,
    drawn,
    metrics,
    nothing_measured,
    one_process,
    planned_for,
    quiet,
)

pytestmark = pytest.mark.usefixtures("one_thread")
STAGES = {"single": LITE_STAGES[0], "temporal": LITE_STAGES[1]}


@pytest.fixture(scope="module")
def scenes(tmp_path_factory):
    return painted_scenes(tmp_path_factory.mktemp("scenes"), 5, tiny_config())


def good_and_bad(name, scenes, network, folder):
    """A segment, and one in which one pose or one image is no number."""
    planned = planned_for(STAGES[name], 2, batch=2)
    good = next(drawn(planned, network, scenes, folder).segments(0))
    first = good.instants[0]
    if name == "single":
        broken = normalise_images(first.images, network.config.image).fill_(float("nan"))
        return good, replace(good, instants=[replace(first, images=broken)])
    broken = [level.clone().fill_(float("nan")) for level in good.features[0].levels]
    return good, replace(good, features=[replace(good.features[0], levels=broken), *good.features[1:]])


@pytest.mark.parametrize("name", STAGES)
def test_a_bad_step_is_skipped_and_named_and_leaves_nothing_behind(name, scenes, tmp_path):
    torch.manual_seed(0)
    network, said = PredMapNet(tiny_config()), []
    good, bad = good_and_bad(name, scenes, network, tmp_path)
    trainer = Trainer(one_process(), network, tmp_path / "run", OFTEN, said.append)
    assert trainer.run(planned_for(STAGES[name], 4, batch=2), Given([good, bad, good, good]), nothing_measured)
    (skipped,) = [line for line in said if line.startswith("Skipped")]
    assert "step 1 of stage" in skipped and skipped.endswith("It saw: frames 1.")
    assert [line["step"] for line in metrics(tmp_path / "run")] == [1, 2, 3, 4]
    assert ["loss" in line for line in metrics(tmp_path / "run")] == [True, False, True, True]
    for value in [*network.state_dict().values(), *trainer.result.state_dict().values()]:
        assert torch.isfinite(value).all()


def test_a_run_of_bad_steps_ends(scenes, tmp_path):
    network = PredMapNet(tiny_config())
    good, bad = good_and_bad("single", scenes, network, tmp_path)
    trainer = Trainer(one_process(), network, tmp_path / "run", OFTEN, quiet)
    planned = planned_for(STAGES["single"], 3 * BAD_STEPS, batch=2)
    with pytest.raises(UserError, match=f"{BAD_STEPS} steps in a row"):
        trainer.run(planned, Given([good, *[bad] * BAD_STEPS]), nothing_measured)
    assert trainer.position.step == BAD_STEPS
