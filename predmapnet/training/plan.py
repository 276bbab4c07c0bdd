"""The plan of a run: how many steps of which size and at which rate each stage takes, and what they need."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from predmapnet.errors import UserError
from predmapnet.training.settings import Stage

DECAY = 0.3
"""Part of a budget of minutes in which the learning rate falls."""


@dataclass(frozen=True)
class PlannedStage:
    """One stage of a run.

    Attributes:
        stage: what it trains.
        batch: samples of one step, over all processes.
        parts: in how many parts a process takes its share, one after the other.
        devices: number of processes.
        rate: peak of the learning rate for this batch.
        steps: optimiser steps; None where minutes decide.
        minutes: budget; None where steps decide.
    """

    stage: Stage
    batch: int
    parts: int
    devices: int
    rate: float
    steps: int | None = None
    minutes: float | None = None

    @property
    def share(self) -> int:
        """Samples that a process takes at once."""
        return self.batch // (self.devices * self.parts)

    def fall(self, step: int, seconds: float) -> list[int]:
        """Return the steps at which the learning rate begins and ends to fall, empty while that is open.

        With a budget of minutes the rate stays at its peak until seven tenths of them are over; then the steps that fit
        into the rest, at the speed so far, are planned. Steps are the clock in both cases.
        """
        if self.steps is not None:
            return [0, self.steps]
        assert self.minutes is not None
        budget = 60 * self.minutes
        if seconds < (1 - DECAY) * budget:
            return []
        return [step, step + max(1, round((budget - seconds) * step / seconds))]


@dataclass(frozen=True)
class PlanOptions:
    """Parts of a plan that a user chooses.

    Attributes:
        devices: number of processes.
        batch: samples of one step over all processes, in every stage; None for those of the stage.
        parts: in how many parts a process takes its share of clips or frames, to save memory.
        learning_rate: peak, for exactly this batch; None for that of the stage, scaled.
        steps: of each stage; None for its epochs.
        minutes: of all stages together, instead of epochs.
    """

    devices: int = 1
    batch: int | None = None
    parts: int = 1
    learning_rate: float | None = None
    steps: int | None = None
    minutes: float | None = None


def plan_stages(stages: Sequence[Stage], frames: int, options: PlanOptions) -> tuple[PlannedStage, ...]:
    """Plan a run.

    The learning rate grows with the square root of the batch, as suits Adam (Malladi et al., *On the SDEs and Scaling
    Rules for Adaptive Gradient Algorithms*, 2022): a stage names a rate and the whole batch that it is for.

    ``frames`` are those of the training data. Raises UserError where a batch cannot be shared out, or a budget of
    minutes is given for a network that trains for days.
    """
    if options.minutes is not None and any(stage.data == "clips" for stage in stages):
        raise UserError(
            "--minutes is for lite, which learns in hours. This network learns by epochs; --steps shortens it."
        )
    planned = []
    for stage in stages:
        batch = options.batch or (stage.per_device * options.devices if stage.per_device else stage.batch)
        parts = 1 if stage.data == "streams" else min(options.parts, max(batch // options.devices, 1))
        if batch % (options.devices * parts):
            raise UserError(
                f"Stage {stage.name}: a batch of {batch} cannot be shared out to {options.devices} processes"
                f"{f' in {parts} parts' if parts > 1 else ''}. Choose --batch {options.devices * parts} times a number."
            )
        seen = batch * stage.frames if stage.data == "streams" else batch
        steps = options.steps or math.ceil(stage.epochs * max(frames // seen, 1))
        minutes = None
        if options.minutes is not None:
            minutes = options.minutes * stage.share / sum(each.share for each in stages)
        rate = options.learning_rate or stage.optimiser.learning_rate * math.sqrt(batch / stage.batch)
        planned.append(PlannedStage(stage, batch, parts, options.devices, rate, None if minutes else steps, minutes))
    return tuple(planned)
