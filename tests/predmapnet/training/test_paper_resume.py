"""A run with dropout and noise that dies and goes on gives the losses and weights of one that never stopped."""

from dataclasses import replace

import orjson
import pytest
import torch

from predmapnet.network.predmapnet import PredMapNet
from predmapnet.training.clips import ClipTraining
from predmapnet.training.data.batches import TrainingScenes
from predmapnet.training.loop import Trainer
from predmapnet.training.process_group import ProcessGroup
from predmapnet.training.settings import Budget, ClipSettings, plan_run
from tests.predmapnet.small_networks import PlainBackbone
from tests.predmapnet.training.painted_scenes import painted_scene
from tests.predmapnet.training.paper_clips import JOINT
from tests.predmapnet.training.tiny_clips import tiny_paper_config

CONFIG = tiny_paper_config()
SETTINGS = replace(
    plan_run(CONFIG, "joint", 1.0, 3), clips=ClipSettings(frames=2, span=3), log_steps=1, checkpoint_minutes=0.0
)


class PowerCutError(Exception):
    pass


pytestmark = pytest.mark.usefixtures("one_thread")


@pytest.fixture(scope="module")
def scenes(tmp_path_factory):
    return TrainingScenes([painted_scene(tmp_path_factory.mktemp("scenes") / "scene-0", 5, 0, CONFIG)], CONFIG)


def run(folder, scenes, resume=False, cut_at=None):
    torch.manual_seed(3)
    network = PredMapNet(CONFIG)
    network.image_backbone = PlainBackbone(CONFIG.bev.width)
    trainer = Trainer(network, SETTINGS, folder, ProcessGroup(), lambda _line: None)
    if resume:
        trainer.resume()
        torch.manual_seed(99)  # Another process has drawn other numbers so far.
    training = ClipTraining(JOINT, network, scenes, SETTINGS, ProcessGroup())
    whole = training.losses

    def losses(step, batch):
        if step == cut_at:
            raise PowerCutError
        return whole(step, batch)

    training.losses = losses
    trainer.run(training, Budget(steps=3), SETTINGS.clip_optimiser, lambda _network, _stage: {})
    return trainer


def metrics(folder):
    lines = [orjson.loads(line) for line in (folder / "metrics.jsonl").read_bytes().splitlines()]
    return [{name: value for name, value in line.items() if "seconds" not in name} for line in lines]


def test_a_run_with_dropout_that_died_goes_on_as_if_nothing_had_happened(tmp_path, scenes):
    assert CONFIG.decoder.dropout == CONFIG.bev.dropout == 0.1
    straight = run(tmp_path / "straight", scenes)
    with pytest.raises(PowerCutError):
        run(tmp_path / "cut", scenes, cut_at=2)
    resumed = run(tmp_path / "cut", scenes, resume=True)
    assert metrics(tmp_path / "cut") == metrics(tmp_path / "straight")
    for one, other in ((straight.network, resumed.network), (straight.average.network, resumed.average.network)):
        assert all(torch.equal(value, other.state_dict()[name]) for name, value in one.state_dict().items())


def test_dropout_draws_other_numbers_for_another_seed(tmp_path, scenes):
    """Otherwise the test above would prove nothing."""
    found = []
    for seed in (3, 4):
        torch.manual_seed(0)
        network = PredMapNet(CONFIG)
        network.image_backbone = PlainBackbone(CONFIG.bev.width)
        training = ClipTraining(JOINT, network, scenes, SETTINGS, ProcessGroup())
        batch = training.make_batch(0)
        torch.manual_seed(seed)
        found.append(float(training.losses(0, batch)["points"].detach()))
    assert found[0] != pytest.approx(found[1], rel=1e-6)
