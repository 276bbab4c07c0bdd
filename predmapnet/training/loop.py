"""The training loop: steps, checkpoints, validation, metrics. One for all stages, networks and devices."""

from __future__ import annotations

import math
import shutil
import signal
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from types import FrameType
from typing import Any
from zlib import crc32

import torch
import torch.distributed as distributed
from lightning_fabric import Fabric
from torch import Tensor

from predmapnet.errors import UserError
from predmapnet.network.kernels.low_precision import keep_places_exact
from predmapnet.network.kernels.synced_norm import share_statistics
from predmapnet.network.predmapnet import PredMapNet
from predmapnet.scenes import Report
from predmapnet.training import run_checkpoint
from predmapnet.training.data.batches import StreamSegment
from predmapnet.training.instants import StageTraining
from predmapnet.training.metrics import Meter, MetricsLog
from predmapnet.training.optimiser import WeightAverage, learning_rate, make_optimiser
from predmapnet.training.plan import PlannedStage
from predmapnet.training.processes import gathered
from predmapnet.training.run_checkpoint import Position, below_prefix, with_prefix
from predmapnet.training.settings import Stage
from predmapnet.training.stage_data import StageData
from predmapnet.weights.checkpoint import save_checkpoint
from predmapnet.weights.fit import load_weights

Validate = Callable[[PredMapNet, Stage], dict[str, float]]
"""Called in all processes; returns metrics by name, or none."""

BAD_STEPS = 10
"""So many steps in a row without a finite gradient end a run."""
VALIDATIONS = 10
"""Of each stage."""
BEST = "best.safetensors"


@dataclass(frozen=True)
class LoopSettings:
    """Settings that do not belong to a stage.

    Attributes:
        seed: of weights, order of the data, augmentation and dropout.
        low_precision: image backbone and BEV encoder compute in bfloat16.
        save_memory: their activations are computed again in the backward pass.
        sync_norms: batch norms see the frames of all processes; otherwise only their stored statistics are shared.
        checkpoint_minutes: interval.
        log_steps: steps between two lines of metrics.
    """

    seed: int = 0
    low_precision: bool = False
    save_memory: bool = False
    sync_norms: bool = False
    checkpoint_minutes: float = 5.0
    log_steps: int = 20


class Trainer:
    """One process of a run.

    Attributes:
        network: what is trained.
        average: the moving average of its weights, where the stage has one.
        position: where the run stands.
    """

    def __init__(
        self, fabric: Fabric, network: PredMapNet, folder: Path, settings: LoopSettings, report: Report = print
    ) -> None:
        self.network, self.position = network, Position()
        self.average: WeightAverage[PredMapNet] | None = None
        self._fabric, self._folder, self._settings, self._report = fabric, folder, settings, report
        self._interrupted = False
        self._stored: Path | None = None
        if settings.sync_norms and fabric.world_size > 1:
            share_statistics(network)
        if settings.low_precision:
            keep_places_exact(network)
        folder.mkdir(parents=True, exist_ok=True)
        self._log = MetricsLog(folder, fabric.is_global_zero, report)

    @property
    def result(self) -> PredMapNet:
        """The network that is validated and shipped: the average if there is one."""
        return self.network if self.average is None else self.average.network

    def resume(self) -> None:
        """Continue from the newest checkpoint. Raises UserError if there is none."""
        self._stored = run_checkpoint.to_resume(self._folder)
        self.position = run_checkpoint.read_position(self._stored)
        self._log.cut(self.position.metrics_bytes)
        tensors = run_checkpoint.read_tensors(self._stored, "network")
        load_weights(self.network, below_prefix("network", tensors), self._stored)
        if average := below_prefix("average", tensors):
            self.average = WeightAverage(self.network, 0.0)
            load_weights(self.average.network, average, self._stored)

    def run(self, planned: PlannedStage, data: StageData, validate: Validate) -> bool:
        """Train one stage to its end.

        Args:
            planned: the stage and its size.
            data: what this process sees.
            validate: measures :attr:`result`.

        Returns:
            False if a signal ended it early (a checkpoint was written).

        Raises:
            UserError: ten steps in a row had no finite gradient.
        """
        stage, position, settings = planned.stage, self.position, self._settings
        if stage.name in position.finished:
            return True
        training, optimiser = self._begin(stage)
        module = self._fabric.setup(training)
        meter, bad, last_saved = Meter(), 0, position.seconds
        cpu_before, cpu_start, start = position.cpu_seconds, time.process_time(), time.monotonic() - last_saved
        segments = data.segments(position.step * planned.parts)
        with self._signals():
            while parts := list(islice(segments, planned.parts)):
                seconds, interrupted, cpu = self._agreed(start, cpu_start)
                position.fall = position.fall or planned.fall(position.step, seconds)
                fall = (position.fall[0], position.fall[1]) if position.fall else None
                rate = learning_rate(position.step, fall, planned.rate, stage.optimiser)
                terms, norm = self._step(module, optimiser, parts, rate, stage)
                if math.isfinite(norm):
                    bad = 0
                    meter.add(terms, norm)
                else:
                    bad += 1
                    first = position.step * planned.parts
                    self._tell_of(training, terms, [data.name(first + i) for i in range(planned.parts)], bad)
                position.step += 1
                position.frames += planned.batch * stage.frames
                position.seconds, position.cpu_seconds = seconds, cpu_before + cpu
                done = fall is not None and position.step >= fall[1]
                progress = position.step / fall[1] if fall else seconds / (60 * (planned.minutes or 1))
                if position.step % settings.log_steps == 0 or done:
                    self._log.write({"lr": rate, **meter.means(self._mean)}, position, progress)
                    meter = Meter()
                if (done and not interrupted) or int(progress * VALIDATIONS) > position.validated:
                    position.validated = int(progress * VALIDATIONS)
                    self._validate(validate, stage, progress)
                if done and not interrupted:
                    position.finished.append(stage.name)
                if interrupted or done or seconds - last_saved > 60 * settings.checkpoint_minutes:
                    last_saved = seconds
                    self._save(training, optimiser)
                if interrupted or done:
                    return not interrupted
        raise AssertionError("the data never ends by itself")

    def _begin(self, stage: Stage) -> tuple[StageTraining, torch.optim.Optimizer]:
        """Restore a stage in its middle, or begin it from what the one before made."""
        position, device, settings = self.position, self._fabric.device, self._settings
        resumed = position.stage == stage.name and self._stored is not None
        self.network.to(device).train()
        if not resumed:
            self.network.load_state_dict(self.result.state_dict())
            self.average = WeightAverage(self.network, 0.0) if stage.optimiser.average_decay else None
            position.begin(stage.name)
        if self.average is not None:
            self.average.network.to(device)
            self.average.decay, self.average.updates = stage.optimiser.average_decay, position.average_updates
        seed, rank = (settings.seed, crc32(stage.name.encode())), self._fabric.global_rank
        training = StageTraining(self.network, stage, seed, rank).to(device)
        training.shared, training.processes = self._mean, self._fabric.world_size
        training.low_precision, training.save_memory = settings.low_precision, settings.save_memory
        optimiser = make_optimiser(self.network, stage.optimiser)
        torch.manual_seed(crc32(repr((seed, rank)).encode()))
        if resumed and self._stored is not None:
            tensors = run_checkpoint.read_tensors(self._stored, "network")
            own = run_checkpoint.read_tensors(self._stored, f"rank-{rank}")
            with run_checkpoint.misfit_told(self._stored):
                run_checkpoint.restore_optimiser(optimiser, below_prefix("optimiser", tensors))
                run_checkpoint.restore_random_states(own, device)
                training.restore(own)
            self._report(f"Stage {stage.name}: goes on at step {position.step}, frame {position.frames}.")
        return training, optimiser

    def _step(
        self, module: Any, optimiser: torch.optim.Optimizer, parts: Sequence[StreamSegment], rate: float, stage: Stage
    ) -> tuple[dict[str, Tensor], float]:
        """Take one step, unless the gradient is not finite; return the mean losses and the norm of the gradient."""
        statistics = [value for value in self.network.buffers() if value.is_floating_point()]
        before = [value.clone() for value in statistics]
        optimiser.zero_grad(set_to_none=True)
        means: dict[str, Tensor] = {}
        for number, part in enumerate(parts):
            with self._fabric.no_backward_sync(module, enabled=number + 1 < len(parts)):
                terms: dict[str, Tensor] = module(part, self.position.step, number)
                self._fabric.backward(torch.stack(list(terms.values())).sum() / len(parts))
            for name, term in terms.items():
                means[name] = means.get(name, torch.zeros_like(term)) + term.detach() / len(parts)
        norm = float(torch.nn.utils.clip_grad_norm_(self.network.parameters(), stage.optimiser.clip_norm))
        if not math.isfinite(norm):
            torch._foreach_copy_(statistics, before)
            return means, norm
        for group in optimiser.param_groups:
            group["lr"] = rate * group["rate"]
        optimiser.step()
        if statistics and self._fabric.world_size > 1 and not self._settings.sync_norms:
            shared = self._mean(torch.cat([value.flatten() for value in statistics]))
            for value, mean in zip(statistics, shared.split([v.numel() for v in statistics]), strict=True):
                value.copy_(mean.view_as(value))
        if self.average is not None:
            self.average.update(self.network)
            self.position.average_updates = self.average.updates
        return means, norm

    def _agreed(self, start: float, cpu_start: float) -> tuple[float, bool, float]:
        """Return seconds since ``start``, whether to stop, and processor seconds: the same in all processes."""
        own = [time.monotonic() - start, float(self._interrupted), time.process_time() - cpu_start]
        if (size := self._fabric.world_size) > 1:
            latest = torch.tensor(own, dtype=torch.float64, device=self._fabric.device)
            distributed.all_reduce(latest, distributed.ReduceOp.MAX)
            own = latest.tolist()
        return own[0], own[1] > 0, own[2] * size

    def _mean(self, values: Tensor) -> Tensor:
        """Average a tensor over all processes, in place."""
        if (size := self._fabric.world_size) > 1:
            distributed.all_reduce(values)
            values /= size
        return values

    def _tell_of(self, training: StageTraining, terms: dict[str, Tensor], names: list[str], bad: int) -> None:
        """Name the frames of a step that could not be taken. Raises UserError if it is one of many in a row."""
        training.carried = None  # What streams remember may be broken as well.
        seen = ", ".join(name for said in gathered(names) for name in said)
        losses = ", ".join(f"{name} {float(term):.3g}" for name, term in terms.items())
        where = f"step {self.position.step} of stage {self.position.stage}"
        self._report(f"Skipped {where}, whose gradient is not finite. Losses: {losses}. It saw: {seen}.")
        if bad >= BAD_STEPS:
            raise UserError(
                f"{bad} steps in a row, up to {where}, had no finite gradient. Go on with --resume and a lower "
                "--learning-rate; if it is always the same frames, look at them."
            )

    def _validate(self, validate: Validate, stage: Stage, progress: float) -> None:
        """Measure the network, and keep the best one so far."""
        network, position = self.result, self.position
        figures = validate(network.eval(), stage)
        self.network.train()
        if not figures:
            return
        self._log.write({f"val_{name}": value for name, value in figures.items()}, position, progress)
        if figures.get("mAP", 0.0) > position.best.get(position.stage, 0.0):
            position.best[position.stage] = figures["mAP"]
            if self._fabric.is_global_zero:
                facts = {"stage": position.stage, "step": position.step, "frames": position.frames, **figures}
                save_checkpoint(self._folder / BEST, network, facts)

    def _save(self, training: StageTraining, optimiser: torch.optim.Optimizer) -> None:
        """Write a checkpoint, all processes together."""
        fabric, position = self._fabric, self.position
        position.metrics_bytes = self._log.size
        partial = run_checkpoint.partial_folder(self._folder, position)
        if fabric.is_global_zero:
            shutil.rmtree(partial, ignore_errors=True)
            partial.mkdir(parents=True)
        fabric.barrier()
        own = run_checkpoint.random_states(fabric.device) | training.tensors()
        run_checkpoint.write_tensors(partial / f"rank-{fabric.global_rank}.safetensors", own)
        if fabric.is_global_zero:
            average = {} if self.average is None else self.average.network.state_dict()
            tensors = with_prefix("network", self.network.state_dict()) | with_prefix("average", average)
            tensors |= with_prefix("optimiser", run_checkpoint.optimiser_tensors(optimiser))
            run_checkpoint.write_tensors(partial / "network.safetensors", tensors)
        fabric.barrier()
        if fabric.is_global_zero:
            run_checkpoint.publish(partial, position)
        fabric.barrier()
        self._stored = run_checkpoint.latest(self._folder)

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
