"""Metrics of a run: means over some steps, as JSON lines, for TensorBoard, and on the screen."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import orjson
import torch
from torch import Tensor

from predmapnet.training.run_checkpoint import Position
from predmapnet.training.settings import Report

if TYPE_CHECKING:
    from torch.utils.tensorboard import SummaryWriter

METRICS = "metrics.jsonl"


class Meter:
    """Means of the losses since the last line. They stay on their device until they are asked for."""

    def __init__(self) -> None:
        self._sums: Tensor | None = None
        self._names: list[str] = []
        self._count = 0
        self._since = time.monotonic()

    def add(self, terms: Mapping[str, Tensor], norm: Tensor) -> None:
        """Add the losses of a step, and the norm of its gradient."""
        self._names = [*terms, "norm"]
        values = torch.stack([value.detach() for value in (*terms.values(), norm)])
        self._sums = values if self._sums is None else self._sums + values
        self._count += 1

    def means(self, shared: Callable[[Tensor], Tensor]) -> dict[str, float]:
        """Return the means, averaged over all processes by ``shared``, and begin anew."""
        found: dict[str, float] = {}
        if self._sums is not None:
            values = (shared(self._sums) / self._count).tolist()
            found = {"loss": sum(values[:-1]), **dict(zip(self._names, values, strict=True))}
        seconds = (time.monotonic() - self._since) / max(self._count, 1)
        self.__init__()  # type: ignore[misc]
        return {**found, "seconds_per_step": seconds}


class MetricsLog:
    """Lines of metrics, and the same for TensorBoard where that is installed (``predmapnet[train]``)."""

    def __init__(self, folder: Path, leads: bool, report: Report) -> None:
        """Write to ``folder``, if this process leads."""
        self._path, self._leads, self._report = folder / METRICS, leads, report
        self._board: SummaryWriter | None = None
        self._board_missing = not leads

    @property
    def size(self) -> int:
        """Bytes of the lines so far."""
        return self._path.stat().st_size if self._path.exists() else 0

    def cut(self, size: int) -> None:
        """Forget the lines after a checkpoint: they are going to be written again."""
        if self._leads and self.size > size:
            with self._path.open("ab") as file:
                file.truncate(size)

    def write(self, values: Mapping[str, float], position: Position, progress: float) -> None:
        """Append one line of metrics and show it."""
        if not self._leads:
            return
        line = {
            "stage": position.stage,
            "step": position.step,
            "frames": position.frames,
            "seconds": round(position.total_seconds + position.seconds, 1),
            "cpu_seconds": round(position.cpu_seconds, 1),
            **{name: round(value, 5) for name, value in values.items()},
        }
        with self._path.open("ab") as file:
            file.write(orjson.dumps(line) + b"\n")
        self._draw(values, position)
        shown = "  ".join(f"{name} {value:.4g}" for name, value in values.items())
        self._report(f"{position.stage} {progress:6.1%}  step {position.step}  frames {position.frames}  {shown}")

    def _draw(self, values: Mapping[str, float], position: Position) -> None:
        """Tell TensorBoard, over frames; what an interrupted run said of later frames is forgotten."""
        if self._board is None and not self._board_missing:
            try:
                from torch.utils.tensorboard import SummaryWriter

                self._board = SummaryWriter(str(self._path.with_name("tensorboard")), purge_step=position.frames)
            except ImportError:
                self._board_missing = True
                self._report("No files for TensorBoard: they need pip install 'predmapnet[train]'.")
        if self._board is not None:
            for name, value in values.items():
                self._board.add_scalar(f"{position.stage}/{name}", value, position.frames)
            self._board.flush()
