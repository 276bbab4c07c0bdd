"""The training loop: stages, steps, checkpoints, validation, metrics."""

from __future__ import annotations

import signal
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from pathlib import Path
from types import FrameType
from typing import Any, Protocol, TypeVar

import orjson
import torch
from torch import Tensor

from predmapnet.errors import UserError
from predmapnet.network.predmapnet import PredMapNet
from predmapnet.training import run_checkpoint
from predmapnet.training.optimiser import OptimiserSettings, WeightAverage, learning_rate, make_optimiser
from predmapnet.training.process_group import ProcessGroup
from predmapnet.training.settings import Budget, Report, TrainingSettings

Data = TypeVar("Data")
Validate = Callable[[PredMapNet, str], dict[str, float]]
"""Called with the averaged network and the stage's name; returns metrics by name, none where nothing is measured."""


class Stage(Protocol[Data]):
    """What the loop needs of a stage.

    Attributes:
        name: for example ``single`` or ``temporal``.
        frames_per_step: frames that this process sees in one step.
    """

    name: str
    frames_per_step: int

    def begin(self) -> None:
        """Get ready; the network has the weights that the stage starts from."""
        ...

    def batches(self, first: int) -> Iterator[Data]:
        """Yield the data of one step after the other."""
        ...

    def losses(self, step: int, batch: Data) -> dict[str, Tensor]:
        """Return the weighted losses, whose sum is minimised."""
        ...

    def state(self) -> dict[str, Tensor]:
        """Return what has to survive an interruption."""
        ...

    def restore(self, tensors: dict[str, Tensor]) -> None:
        """Continue from what :meth:`state` returned."""
        ...


@dataclass
class Position:
    """Progress of a run, as checkpoints keep it.

    Attributes:
        stage: name of the current stage.
        step: optimiser steps of this stage so far.
        frames: frames seen so far, in all stages and processes.
        seconds: wall time of this stage.
        total_seconds: wall time of the stages before.
        cpu_seconds: processor time of all processes and stages.
        finished: names of the stages that are complete.
    """

    stage: str
    step: int = 0
    frames: int = 0
    seconds: float = 0.0
    total_seconds: float = 0.0
    cpu_seconds: float = 0.0
    finished: list[str] = field(default_factory=list)


class Trainer:
    """One process of a run.

    Attributes:
        network: what is trained.
        average: its moving average, what is validated and shipped (kept up to date by process 0).
        position: where the run stands.
    """

    def __init__(
        self,
        network: PredMapNet,
        settings: TrainingSettings,
        folder: Path,
        processes: ProcessGroup,
        report: Report = print,
    ) -> None:
        self.network = network
        self.position = Position(stage="")
        self._settings = settings
        self._folder = folder
        self._processes = processes
        self._report = report
        self._interrupted = False
        self._stored: Path | None = None
        self.average = WeightAverage(network, settings.optimiser.average_decay)
        folder.mkdir(parents=True, exist_ok=True)

    def resume(self) -> None:
        """Continue from the newest checkpoint. Raises UserError if there is none."""
        self._stored = run_checkpoint.to_resume(self._folder)
        stored = run_checkpoint.read_json(self._stored / "position.json")
        self.average.updates = stored.pop("average_updates")
        self.position = Position(**stored)
        tensors = run_checkpoint.read(self._stored, "network")
        run_checkpoint.load_weights(self.network, run_checkpoint.below_prefix("network", tensors), self._stored)
        run_checkpoint.load_weights(self.average.network, run_checkpoint.below_prefix("average", tensors), self._stored)

    def run(
        self, stage: Stage[Data], budget: Budget, optimiser_settings: OptimiserSettings, validate: Validate
    ) -> bool:
        """Train one stage to the end of its budget.

        Args:
            stage: gives batches and losses.
            budget: when to end.
            optimiser_settings: of this stage.
            validate: measures the averaged network.

        Returns:
            False if a signal ended it early (a checkpoint was written).
        """
        if stage.name in self.position.finished:
            return True
        optimiser = self._enter(stage, optimiser_settings)
        self.network.train()
        position, processes = self.position, self._processes
        start, cpu_start = time.monotonic() - position.seconds, time.process_time()
        cpu_before = position.cpu_seconds
        last_saved = last_validated = position.seconds
        meter = _Meter()
        with self._signals():
            for step, batch in enumerate(stage.batches(position.step), position.step):
                terms = stage.losses(step, batch)
                loss = torch.stack(list(terms.values())).sum()
                optimiser.zero_grad(set_to_none=True)
                loss.backward()
                seconds = time.monotonic() - start
                shared = processes.average_gradients(
                    self.network,
                    [
                        budget.progress(step, seconds),
                        float(self._interrupted),
                        float(processes.leads and seconds - last_saved > 60 * self._settings.checkpoint_minutes),
                        float(processes.leads and seconds - last_validated > 60 * self._settings.validation_minutes),
                        time.process_time() - cpu_start,
                    ],
                )
                progress, interrupted, save_now, validate_now, cpu_seconds = shared
                rate = learning_rate(step, progress, optimiser_settings)
                for group in optimiser.param_groups:
                    group["lr"] = rate * group["rate"]
                norm = torch.nn.utils.clip_grad_norm_(self.network.parameters(), optimiser_settings.clip_norm)
                if not torch.isfinite(norm):
                    raise UserError(f"The loss of step {step} is not finite ({_readable(terms)}). Lower the rate.")
                optimiser.step()
                if processes.leads:
                    self.average.update(self.network)
                position.step = step + 1
                position.frames += stage.frames_per_step * processes.size
                position.seconds = seconds
                position.cpu_seconds = cpu_before + cpu_seconds * processes.size
                done = budget.progress(position.step, 0.0) >= 1 or progress >= 1
                meter.add(terms, float(norm))
                if processes.leads and (position.step % self._settings.log_steps == 0 or done):
                    self._log({"lr": rate, **meter.means()}, progress)
                    meter = _Meter()
                if validate_now or (done and not interrupted):
                    last_validated = seconds
                    if processes.leads:
                        figures = validate(self.average.network, stage.name)
                        if figures:
                            self._log({f"val_{name}": value for name, value in figures.items()}, progress)
                if done and not interrupted:
                    position.finished.append(stage.name)
                if save_now or interrupted or done:
                    last_saved = seconds
                    self._save(stage, optimiser)
                if interrupted or done:
                    return not interrupted
        raise AssertionError("the stream of steps never ends by itself")

    def _enter(self, stage: Stage[Data], settings: OptimiserSettings) -> torch.optim.Optimizer:
        """Restore a stage in its middle, or begin it from the averaged weights of the one before."""
        position = self.position
        if position.stage == stage.name and self._stored is not None:
            stage.begin()
            self.average.decay = settings.average_decay
            optimiser = make_optimiser(self.network, settings)
            tensors = run_checkpoint.read(self._stored, "network")
            run_checkpoint.restore_optimiser(optimiser, run_checkpoint.below_prefix("optimiser", tensors))
            torch.set_rng_state(tensors["random"])
            stage.restore(run_checkpoint.read(self._stored, f"stage-{self._processes.rank}"))
            self._report(f"Stage {stage.name}: goes on at step {position.step}, frame {position.frames}.")
            return optimiser
        self._share_average()
        self.average = WeightAverage(self.network, settings.average_decay)
        position.total_seconds += position.seconds
        position.stage, position.step, position.seconds = stage.name, 0, 0.0
        self.network.zero_grad(set_to_none=True)
        stage.begin()
        return make_optimiser(self.network, settings)

    def _share_average(self) -> None:
        """Give every process the averaged weights of process 0."""
        self.network.load_state_dict(self.average.network.state_dict())
        self._processes.spread(self.network)

    def _save(self, stage: Stage[Data], optimiser: torch.optim.Optimizer) -> None:
        """Write a checkpoint, all processes together."""
        order = len(self.position.finished) * 10_000_000 + self.position.step
        if self._processes.leads:
            run_checkpoint.prepare(self._folder, order)
        self._processes.wait()
        partial = run_checkpoint.partial_folder(self._folder, order)
        run_checkpoint.write_tensors(partial / f"stage-{self._processes.rank}.safetensors", stage.state())
        if self._processes.leads:
            tensors = {
                **run_checkpoint.with_prefix("network", self.network.state_dict()),
                **run_checkpoint.with_prefix("average", self.average.network.state_dict()),
                **run_checkpoint.with_prefix("optimiser", run_checkpoint.optimiser_tensors(optimiser)),
                "random": torch.get_rng_state(),
            }
            run_checkpoint.write_tensors(partial / "network.safetensors", tensors)
            stored = {**asdict(self.position), "average_updates": self.average.updates}
            run_checkpoint.write_json(partial / "position.json", stored)
        self._processes.wait()
        if self._processes.leads:
            self._stored = run_checkpoint.publish(partial)

    def _log(self, values: dict[str, float], progress: float) -> None:
        """Append one line of metrics and show it."""
        position = self.position
        seconds = position.total_seconds + position.seconds
        line: dict[str, Any] = {
            "stage": position.stage,
            "step": position.step,
            "frames": position.frames,
            "seconds": round(seconds, 1),
            "cpu_seconds": round(position.cpu_seconds, 1),
            **{name: round(value, 5) for name, value in values.items()},
        }
        with (self._folder / "metrics.jsonl").open("ab") as file:
            file.write(orjson.dumps(line) + b"\n")
        shown = "  ".join(f"{name} {value:.4g}" for name, value in values.items())
        self._report(f"{position.stage} {progress:6.1%}  step {position.step}  frames {position.frames}  {shown}")

    @contextmanager
    def _signals(self) -> Iterator[None]:
        """Let SIGINT and SIGTERM end the run after the current step, with a checkpoint."""

        def remember(_number: int, _frame: FrameType | None) -> None:
            self._interrupted = True

        previous = {number: signal.signal(number, remember) for number in (signal.SIGINT, signal.SIGTERM)}
        try:
            yield
        finally:
            for number, handler in previous.items():
                signal.signal(number, handler)


class _Meter:
    """Means of the losses since the last line."""

    def __init__(self) -> None:
        self._sums: dict[str, float] = {}
        self._count = 0
        self._since = time.monotonic()

    def add(self, terms: dict[str, Tensor], norm: float) -> None:
        values = {name: float(term.detach()) for name, term in terms.items()}
        for name, value in {"loss": sum(values.values()), **values, "norm": norm}.items():
            self._sums[name] = self._sums.get(name, 0.0) + value
        self._count += 1

    def means(self) -> dict[str, float]:
        means = {name: total / max(self._count, 1) for name, total in self._sums.items()}
        return {**means, "seconds_per_step": (time.monotonic() - self._since) / max(self._count, 1)}


def _readable(terms: dict[str, Tensor]) -> str:
    return ", ".join(f"{name} {float(term.detach()):.3g}" for name, term in terms.items())
