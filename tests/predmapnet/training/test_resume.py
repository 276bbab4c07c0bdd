"""A run that dies and goes on gives the same steps, losses and weights as one that never stopped."""

from dataclasses import replace

import pytest
import torch

from predmapnet.config import PredMapNetConfig
from predmapnet.demo_world.rig import DEMO_RIG
from predmapnet.errors import UserError
from predmapnet.frame_cache.prepare import DataOptions, DataSet
from predmapnet.network.predmapnet import PredMapNet
from predmapnet.runs.train import RunOptions, train_network
from predmapnet.training import run_checkpoint
from predmapnet.training.loop import Trainer
from predmapnet.training.plan import PlanOptions
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

pytestmark = pytest.mark.usefixtures("one_thread")
SINGLE, TEMPORAL = LITE_STAGES
STEPS = 4
STAGES = {
    "single": SINGLE,
    # Scores of an untrained network are low; tracks must exist for their state to matter.
    "temporal": replace(
        TEMPORAL,
        tracks=replace(TEMPORAL.tracks, score=0.03),
        growth_steps=1,
        longest=6,
    ),
    "joint": short_clips(JOINT),
}


@pytest.fixture(scope="module")
def scenes(tmp_path_factory):
    folder = tmp_path_factory.mktemp("scenes")
    lite = painted_scenes(folder / "lite", 6, tiny_config())
    return {"single": lite, "temporal": lite, "joint": painted_scenes(folder, 5, tiny_paper_config(), (DEMO_RIG,))}


def run(folder, scenes, name, resume=False, cut_at=None):
    torch.manual_seed(3)
    network = PredMapNet(scenes[name].config)
    if name == "joint":
        network.image_backbone = PlainBackbone(network.config.bev.width)
        torch.nn.init.constant_(network.map_decoder.classify.bias, 0.0)
    trainer = Trainer(one_process(), network, folder, OFTEN, quiet)
    if resume:
        trainer.resume()
        torch.manual_seed(99)  # Another process has drawn other numbers so far.
    planned = planned_for(STAGES[name], STEPS, batch=2)
    data = drawn(planned, trainer.result, scenes[name], folder)
    trainer.run(planned, data if cut_at is None else Cut(data, cut_at), nothing_measured)
    return trainer


@pytest.mark.parametrize("name", STAGES)
def test_a_run_that_died_goes_on_as_if_nothing_had_happened(tmp_path, scenes, name):
    config = scenes[name].config
    assert name != "joint" or config.decoder.dropout == config.bev.dropout == 0.1
    straight = run(tmp_path / "straight", scenes, name)
    with pytest.raises(PowerCutError):
        run(tmp_path / "cut", scenes, name, cut_at=2)
    with (tmp_path / "cut" / "metrics.jsonl").open("a") as file:
        file.write('{"stage": "a line of a step that no checkpoint knows"}\n')
    resumed = run(tmp_path / "cut", scenes, name, resume=True)
    assert metrics(tmp_path / "cut") == metrics(tmp_path / "straight")
    assert len(metrics(tmp_path / "cut")) == STEPS
    if name == "temporal":
        assert any(line["forecast"] > 0 for line in metrics(tmp_path / "cut")), "tracks were alive"
    for one, other in ((straight.network, resumed.network), (straight.result, resumed.result)):
        assert all(torch.equal(value, other.state_dict()[key]) for key, value in one.state_dict().items())


def test_dropout_draws_other_numbers_for_another_seed(tmp_path, scenes):
    """Otherwise the test above would prove nothing."""
    found = []
    for seed in (0, 1):
        torch.manual_seed(0)
        trainer = Trainer(one_process(), PredMapNet(scenes["joint"].config), tmp_path / f"{seed}", OFTEN, quiet)
        trainer.network.image_backbone = PlainBackbone(32)
        training, _ = trainer._begin(STAGES["joint"])
        planned = planned_for(STAGES["joint"], STEPS, batch=2)
        segment = next(drawn(planned, trainer.network, scenes["joint"], tmp_path).segments(0))
        if seed:
            torch.manual_seed(seed)
        found.append(float(training(segment, 0)["points"].detach()))
    assert found[0] != pytest.approx(found[1], rel=1e-6)


def test_the_last_three_checkpoints_stay_and_half_of_one_is_ignored(tmp_path, scenes):
    run(tmp_path, scenes, "single")
    assert [path.name for path in sorted(tmp_path.glob("frames-*"))] == [f"frames-{f:012d}" for f in (4, 6, 8)]
    (tmp_path / ".frames-000000000099.partial").mkdir()
    newest = run_checkpoint.latest(tmp_path)
    assert newest is not None
    assert run_checkpoint.read_position(newest).finished == ["single"]


def test_resuming_from_nothing_or_from_damage_is_the_users_to_mend(tmp_path, scenes):
    with pytest.raises(UserError, match="no checkpoint"):
        run(tmp_path / "empty", scenes, "single", resume=True)
    run(tmp_path / "damaged", scenes, "single")
    newest = run_checkpoint.latest(tmp_path / "damaged")
    assert newest is not None
    (newest / "network.safetensors").write_bytes(b"cut short")
    with pytest.raises(UserError, match="damaged"):
        run(tmp_path / "damaged", scenes, "single", resume=True)
    (newest / "position.json").write_text('{"stage": "single", "steps": 3}')
    with pytest.raises(UserError, match="another version"):
        run(tmp_path / "damaged", scenes, "single", resume=True)


def options(folder, **changes):
    towns = DataOptions((DataSet("demo"),), folder / "cache", towns=1, validation=1)
    return RunOptions(**({"config": tiny_config(), "data": towns, "folder": folder, "loop": OFTEN} | changes))


def test_gpus_that_are_not_there_are_refused_before_anything_is_made(tmp_path):
    missing = torch.cuda.device_count() + 1
    with pytest.raises(UserError, match=rf"GPUs here, not {missing}"):
        train_network(options(tmp_path / "run", device="cuda", plan=PlanOptions(devices=missing)))
    assert not list(tmp_path.iterdir())


def test_weights_that_do_not_fit_are_refused_before_anything_is_rendered(tmp_path, scenes):
    run(tmp_path / "run", scenes, "single")
    wider = PredMapNetConfig.model_validate(tiny_config().model_dump() | {"decoder": {"width": 64}})
    for config, folder, start, says in (
        (wider, "run", {"resume": True}, r"do not fit the network .*\(\d+ tensors: .* instead of"),
        (tiny_config(), "empty", {"resume": True}, "no checkpoint"),
        (tiny_config(), "new", {"initial": tmp_path / "absent.safetensors"}, "absent"),
        (tiny_config(), "new", {"stage": "temporal"}, "needs a network that sees"),
        (tiny_config(), "run", {}, "holds a run already"),
    ):
        with pytest.raises(UserError, match=says) as caught:
            train_network(options(tmp_path / folder, config=config, **start))
        assert "\n" not in str(caught.value)
    assert [path.name for path in tmp_path.iterdir()] == ["run"]
