"""Runs of single stages on data that is given: one process, or one of several."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import count
from pathlib import Path

import orjson
from lightning_fabric import Fabric

from predmapnet.frame_cache.scene_cache import TrainingScenes
from predmapnet.network.predmapnet import PredMapNet
from predmapnet.training.data.batches import StreamSegment
from predmapnet.training.features import fill_features
from predmapnet.training.loop import LoopSettings
from predmapnet.training.plan import PlannedStage, PlanOptions, plan_stages
from predmapnet.training.settings import Stage
from predmapnet.training.stage_data import StageData

OFTEN = LoopSettings(checkpoint_minutes=0.0, log_steps=1)


def quiet(_line: str) -> None:
    """Nothing is said."""


def nothing_measured(_network: PredMapNet, _stage: Stage) -> dict[str, float]:
    return {}


def planned_for(stage: Stage, steps: int, batch: int, devices: int = 1, parts: int = 1) -> PlannedStage:
    """A stage of some steps, warmed up from the beginning."""
    options = PlanOptions(devices=devices, batch=batch, parts=parts, steps=steps, learning_rate=1e-3)
    return plan_stages([stage], 100, options)[0]


class PowerCutError(Exception):
    pass


@dataclass
class Given:
    """Segments that are at hand, again and again; the power may fail before one of them."""

    given: Sequence[StreamSegment]
    cut_at: int | None = None

    def segments(self, first: int):
        for number in count(first):
            if number == self.cut_at:
                raise PowerCutError
            yield self.given[number % len(self.given)]

    def name(self, number: int) -> str:
        return f"frames {number}"


@dataclass
class Cut:
    """Data of a stage, until the power fails."""

    data: StageData
    at: int

    def segments(self, first: int):
        for number, segment in zip(count(first), self.data.segments(first), strict=False):
            if number == self.at:
                raise PowerCutError
            yield segment

    def name(self, number: int) -> str:
        return self.data.name(number)


def one_process() -> Fabric:
    return Fabric(accelerator="cpu", devices=1)


def drawn(
    planned: PlannedStage, network: PredMapNet, scenes: TrainingScenes, folder: Path, rank: int = 0, size: int = 1
) -> StageData:
    """What a run sees of some scenes."""
    store = None
    if planned.stage.data == "streams":
        store = fill_features(network, scenes, folder, rank, size, quiet)
    return StageData(planned, scenes, 0, rank, size, store=store)


def metrics(folder: Path) -> list[dict[str, float]]:
    """All lines, without times."""
    lines = [orjson.loads(line) for line in (folder / "metrics.jsonl").read_bytes().splitlines()]
    return [{name: value for name, value in line.items() if "seconds" not in name} for line in lines]


def short_clips(stage: Stage) -> Stage:
    """A stage whose clips have two frames."""
    return replace(stage, frames=2, span=3) if stage.data == "clips" else stage
