"""Two processes learn as one does from the same whole batch, and each of them goes on as it was."""

from dataclasses import replace

import pytest
import torch

from predmapnet.network.predmapnet import PredMapNet
from predmapnet.training.loop import Trainer
from predmapnet.training.processes import in_processes
from predmapnet.training.settings import LITE_STAGES
from tests.predmapnet.training.painted_scenes import painted_scenes, tiny_config
from tests.predmapnet.training.paper_clips import JOINT, PlainBackbone
from tests.predmapnet.training.small_runs import (
    OFTEN,
    Cut,
    PowerCutError,
    drawn,
    metrics,
    nothing_measured,
    one_process,
    planned_for,
    quiet,
    short_clips,
)
from tests.predmapnet.training.tiny_clips import tiny_paper_config

STEPS = 2
STAGES = {"single": LITE_STAGES[0], "joint": short_clips(JOINT)}


def calm_config():
    """Without dropout, whose draws belong to a process."""
    values = tiny_paper_config().model_dump()
    for section in ("bev", "decoder"):
        values[section]["dropout"] = 0.0
    return type(tiny_paper_config()).model_validate(values)


def train(fabric, name, config, scenes, folder, cut_at=None, resume=False):
    torch.manual_seed(0)
    network = PredMapNet(config)
    for norm in (module for module in network.modules() if isinstance(module, torch.nn.BatchNorm2d)):
        # A gradient jumps where a ReLU is at zero, and the networks are so small that one of them is half a per cent:
        # summing two frames in the other order does as much. So the ReLUs are kept away from there.
        torch.nn.init.constant_(norm.bias, 6.0)
    if name == "joint":
        network.image_backbone = PlainBackbone(config.bev.width)
        torch.nn.init.constant_(network.map_decoder.classify.bias, 0.0)
    trainer = Trainer(fabric, network, folder, replace(OFTEN, sync_norms=True), quiet)
    if resume:
        trainer.resume()
        torch.manual_seed(99)
    planned = planned_for(STAGES[name], STEPS, batch=2, devices=fabric.world_size)
    data = drawn(planned, network, scenes, folder, fabric.global_rank, fabric.world_size)
    trainer.run(planned, data if cut_at is None else Cut(data, cut_at), nothing_measured)
    return trainer.result.state_dict()


def in_each(fabric, scenes, folder):
    """Everything that two processes do here, since starting them takes long."""
    torch.set_num_threads(1)
    for name, config in (("single", tiny_config()), ("joint", calm_config())):
        train(fabric, name, config, scenes[name], folder / name)
    straight = train(fabric, "joint", tiny_paper_config(), scenes["joint"], folder / "straight")
    with pytest.raises(PowerCutError):
        train(fabric, "joint", tiny_paper_config(), scenes["joint"], folder / "cut", cut_at=1)
    resumed = train(fabric, "joint", tiny_paper_config(), scenes["joint"], folder / "cut", resume=True)
    drawn_next = torch.rand(3)
    assert all(torch.equal(value, resumed[name]) for name, value in straight.items())
    return fabric.all_reduce(drawn_next.clone(), reduce_op="sum") - 2 * drawn_next


@pytest.mark.usefixtures("one_thread")
def test_two_processes_give_the_curve_of_one_and_resume_exactly(tmp_path):
    scenes = {
        "single": painted_scenes(tmp_path / "lite", 5, tiny_config()),
        "joint": painted_scenes(tmp_path / "paper", 5, tiny_paper_config()),
    }
    difference = in_processes(2, "cpu", in_each, scenes, tmp_path)
    assert (difference != 0).all(), "processes have random states of their own"
    assert metrics(tmp_path / "cut") == metrics(tmp_path / "straight")
    for name, config in (("single", tiny_config()), ("joint", calm_config())):
        train(one_process(), name, config, scenes[name], tmp_path / f"{name}-alone")
        together, alone = metrics(tmp_path / name), metrics(tmp_path / f"{name}-alone")
        assert [line.pop("stage") for line in together] == [line.pop("stage") for line in alone] == [name] * STEPS
        for one, other in zip(together, alone, strict=True):
            assert one == pytest.approx(other, rel=1e-4)
        assert alone[0]["points"] != pytest.approx(alone[1]["points"], rel=1e-3), "there is something to tell apart"
