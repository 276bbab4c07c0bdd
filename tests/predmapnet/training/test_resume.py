"""A run that dies and goes on gives the same steps, losses and weights as one that never stopped."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import orjson
import pytest
import torch
from painted_scenes import painted_scenes, tiny_config

from predmapnet.config import PredMapNetConfig
from predmapnet.errors import UserError
from predmapnet.network.predmapnet import PredMapNet
from predmapnet.training import run_checkpoint
from predmapnet.training.data.draws import TrainingScenes
from predmapnet.training.data.prepare import DataOptions, DataSet
from predmapnet.training.loop import Trainer
from predmapnet.training.process_group import ProcessGroup
from predmapnet.training.run import RunOptions, train_network
from predmapnet.training.settings import Budget, StreamSettings, TrainingSettings
from predmapnet.training.single_frame import SingleFrameStage
from predmapnet.training.temporal import TemporalStage

SETTINGS = TrainingSettings(
    batch=2,
    single=Budget(steps=5),
    temporal=Budget(steps=6),
    checkpoint_minutes=0.0,
    log_steps=1,
    # Scores of an untrained network are low; tracks must exist for their state to matter.
    streams=StreamSettings(streams=2, score=0.03, growth_steps=1, longest=6),
)


@pytest.fixture(scope="module", autouse=True)
def one_thread() -> Iterator[None]:
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


@pytest.fixture(scope="module")
def scenes(tmp_path_factory: pytest.TempPathFactory) -> TrainingScenes:
    return painted_scenes(tmp_path_factory.mktemp("scenes"), 6, tiny_config())


def one_town(folder: Path) -> DataOptions:
    return DataOptions((DataSet("demo"),), folder / "cache", towns=1, validation=1)


class PowerCutError(Exception):
    pass


def run(folder: Path, scenes: TrainingScenes, resume: bool = False, cut_at: tuple[str, int] | None = None) -> Trainer:
    torch.manual_seed(3)
    network = PredMapNet(tiny_config())
    trainer = Trainer(network, SETTINGS, folder, ProcessGroup(), lambda _line: None)
    if resume:
        trainer.resume()
    single = SingleFrameStage(network, scenes, SETTINGS, ProcessGroup())
    temporal = TemporalStage(network, scenes, SETTINGS, folder, ProcessGroup(), lambda _line: None)
    for stage, budget in ((single, SETTINGS.single), (temporal, SETTINGS.temporal)):
        if cut_at is not None and stage.name == cut_at[0]:
            cut(stage, cut_at[1])
        assert budget is not None
        trainer.run(stage, budget, SETTINGS.optimiser, lambda _network, _stage: {"mAP": 0.0})
    return trainer


def cut(stage: Any, at_step: int) -> None:
    whole = stage.losses

    def losses(step: int, batch: Any) -> dict[str, torch.Tensor]:
        if step == at_step:
            raise PowerCutError
        return whole(step, batch)

    stage.losses = losses


def metrics(folder: Path) -> list[dict[str, Any]]:
    times = ("seconds", "cpu_seconds", "seconds_per_step")
    lines = [orjson.loads(line) for line in (folder / "metrics.jsonl").read_bytes().splitlines()]
    return [{name: value for name, value in line.items() if name not in times} for line in lines]


@pytest.mark.parametrize("cut_at", [("single", 3), ("temporal", 3)])
def test_a_run_that_died_goes_on_as_if_nothing_had_happened(
    tmp_path: Path, scenes: TrainingScenes, cut_at: tuple[str, int]
) -> None:
    straight = run(tmp_path / "straight", scenes)
    with pytest.raises(PowerCutError):
        run(tmp_path / "cut", scenes, cut_at=cut_at)
    resumed = run(tmp_path / "cut", scenes, resume=True)
    assert metrics(tmp_path / "cut") == metrics(tmp_path / "straight")
    assert any("forecast" in line and line["forecast"] > 0 for line in metrics(tmp_path / "cut")), "tracks were alive"
    for network in ("network", "average"):
        first = getattr(straight, network)
        second = getattr(resumed, network)
        for whole, again in zip(
            (first if network == "network" else first.network).state_dict().values(),
            (second if network == "network" else second.network).state_dict().values(),
            strict=True,
        ):
            assert torch.equal(whole, again)


def test_only_the_newest_checkpoint_stays_and_half_of_one_is_ignored(tmp_path: Path, scenes: TrainingScenes) -> None:
    run(tmp_path, scenes)
    assert len(list(tmp_path.glob("step-*"))) == 1
    (tmp_path / ".step-099999999.partial").mkdir()
    newest = run_checkpoint.latest(tmp_path)
    assert newest is not None
    assert run_checkpoint.read_json(newest / "position.json")["finished"] == ["single", "temporal"]


def test_resuming_from_nothing_or_from_damage_is_the_users_to_mend(tmp_path: Path, scenes: TrainingScenes) -> None:
    with pytest.raises(UserError, match="no checkpoint"):
        run(tmp_path / "empty", scenes, resume=True)
    run(tmp_path / "damaged", scenes)
    newest = run_checkpoint.latest(tmp_path / "damaged")
    assert newest is not None
    (newest / "network.safetensors").write_bytes(b"cut short")
    with pytest.raises(UserError, match="damaged"):
        run(tmp_path / "damaged", scenes, resume=True)


def test_streams_of_an_older_version_go_on_without_their_past(tmp_path: Path, scenes: TrainingScenes) -> None:
    network = PredMapNet(tiny_config())
    stage = TemporalStage(network, scenes, SETTINGS, tmp_path, ProcessGroup())
    whole = stage.state()
    older = {name.removeprefix("state."): value for name, value in whole.items() if name.startswith("state.instances.")}
    older |= {name: value for name, value in whole.items() if name.startswith("owners.")}
    older |= {"plan.frame": torch.ones(2).long(), "owners.kinds": torch.ones(2, 3).long()}
    stage.restore(older)
    assert stage.state()["owners.kinds"].shape == (2, 0)


def test_a_gpu_that_is_not_there_is_refused_before_anything_is_made(tmp_path: Path) -> None:
    if torch.cuda.is_available():
        pytest.skip("there is one")
    common = {"config": tiny_config(), "data": one_town(tmp_path), "folder": tmp_path / "run"}
    sizes = {"processes": 1, "threads": 1}
    with pytest.raises(UserError, match="no device cuda"):
        train_network(RunOptions(**common, **sizes, settings=SETTINGS, device="cuda"))
    assert not list(tmp_path.iterdir())


def test_weights_that_do_not_fit_are_refused_before_anything_is_rendered(
    tmp_path: Path, scenes: TrainingScenes
) -> None:
    run(tmp_path / "run", scenes)
    wider = PredMapNetConfig.model_validate(tiny_config().model_dump() | {"decoder": {"width": 64}})
    common = {"data": one_town(tmp_path), "settings": SETTINGS}
    sizes = {"processes": 1, "threads": 1}
    for config, folder, start, says in (
        (wider, "run", {"resume": True}, r"do not fit the network .*\(\d+ tensors: .* instead of"),
        (tiny_config(), "empty", {"resume": True}, "no checkpoint"),
        (tiny_config(), "new", {"initial": tmp_path / "absent.safetensors"}, "absent"),
    ):
        with pytest.raises(UserError, match=says) as caught:
            train_network(RunOptions(**common, **sizes, config=config, folder=tmp_path / folder, **start))
        assert "\n" not in str(caught.value)
    assert [path.name for path in tmp_path.iterdir()] == ["run"]
