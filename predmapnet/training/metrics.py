"""Metrics of a run: means over some steps, as JSON lines, for TensorBoard, and on the screen."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import orjson
import torch
from torch import Tensor

from predmapnet.scenes import Report
from predmapnet.training.run_checkpoint import Position

if TYPE_CHECKING:
    from torch.utils.tensorboard import SummaryWriter


class Meter:
    """Means of the losses since it was made. They stay on their device until they are asked for."""

    def __init__(self) -> None:
        self._sums: dict[str, Tensor] = {}
        self._count, self._since = 0, time.monotonic()

    def add(self, terms: Mapping[str, Tensor], norm: float) -> None:
        """Add the losses of a step, and the norm of its gradient."""
        total = torch.stack(list(terms.values())).sum()
        for name, value in {"loss": total, **terms, "norm": torch.full_like(total, norm)}.items():
            self._sums[name] = self._sums.get(name, torch.zeros_like(value)) + value.detach()
        self._count += 1

    def means(self, shared: Callable[[Tensor], Tensor]) -> dict[str, float]:
        """Return the means, averaged over all processes by ``shared``."""
        values: list[float] = []
        if self._sums:
            values = (shared(torch.stack(list(self._sums.values()))) / self._count).tolist()
        seconds = (time.monotonic() - self._since) / max(self._count, 1)
        return {**dict(zip(self._sums, values, strict=True)), "seconds_per_step": seconds}


def shown(values: Mapping[str, float], position: Position, progress: float) -> str:
    """Return a line of metrics for the screen; all of them are in the file.

    Args:
        values: means over some steps, or figures of a validation (``val_...``).
        position: of the run.
        progress: share of the stage that is done.
    """
    where = f"{position.stage} {progress:4.0%}  step {position.step}"
    if "loss" not in values:
        figures = {name.removeprefix("val_"): value for name, value in values.items() if "@" not in name}
        return f"{where}  validated: " + "  ".join(f"{name} {value:.3f}" for name, value in figures.items())
    minutes = position.seconds * (1.0 - progress) / max(progress, 1e-9) / 60
    left = f"{minutes:.0f} min" if minutes < 120 else f"{minutes / 60:.0f} h"
    pace = f"{values['seconds_per_step']:.2g} s a step"
    return f"{where}  loss {values['loss']:.4g}  {pace}, {left} left of this stage"


class MetricsLog:
    """Lines of metrics, and the same for TensorBoard where that is installed (``predmapnet[train]``)."""

    def __init__(self, folder: Path, leads: bool, report: Report) -> None:
        """Write to ``folder``, if this process leads."""
        self._path, self._leads, self._report = folder / "metrics.jsonl", leads, report
        self._board: SummaryWriter | None = None
        self._board_missing = False

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
        """Append one line of metrics, and show what a person asks: how far, how good, how long it still takes."""
        if not self._leads:
            return
        line: dict[str, object] = {name: getattr(position, name) for name in ("stage", "step", "frames")}
        line |= {"seconds": round(position.total_seconds + position.seconds, 1)}
        line |= {"cpu_seconds": round(position.cpu_seconds, 1)}
        line |= {name: round(value, 5) for name, value in values.items()}
        with self._path.open("ab") as file:
            file.write(orjson.dumps(line) + b"\n")
        self._draw(values, position)
        self._report(shown(values, position, progress))

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
