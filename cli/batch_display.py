"""Progress and totals of a batch: a line for each scene, and at the end a table, the totals and what failed."""

from __future__ import annotations

from datetime import datetime
from time import monotonic
from typing import TYPE_CHECKING, Any

from rich.table import Table

from cli.console import ProgressDisplay, out, print_json, print_whole, printable, say_error

if TYPE_CHECKING:
    from predmapnet.runs.batch_records import Outcome

MOST_ROWS = 50
"""A batch of more scenes prints no table: its lines have been printed, and the report has the rest."""

MOST_FAILURES = 20
"""Failures beyond these are only counted; the report names them all."""


class BatchDisplay:
    """Display of a batch while it runs and of its totals at the end; what it keeps does not grow with the batch.

    Args:
        display: shows the progress.
        total: number of scenes.
        workers: what maps them, for people.
    """

    def __init__(self, display: ProgressDisplay, total: int, workers: str) -> None:
        self._display, self._total, self._workers = display, total, workers
        self._began = monotonic()
        self._mapped = self._frames = self._elements = 0
        self._metres = 0.0
        self.done = self.failed = 0
        self._rows: list[Outcome] = []
        self._failures: list[Outcome] = []

    def begun(self, before: int, todo: int) -> None:
        """Say what is to be done."""
        earlier = f", {before} of them done before" if before else ""
        how = f"; {todo} to map: {self._workers}" if todo else ""
        self._display.line(f"{self._total} scene{'s' if self._total != 1 else ''}{earlier}{how}")
        self._display.scenes(0, self._total)

    def add(self, outcome: Outcome) -> None:
        """Count one outcome and say how it ended."""
        if self._total <= MOST_ROWS:
            self._rows.append(outcome)
        if outcome.report is None:
            self.failed += 1
            self._failures.extend([outcome] if len(self._failures) < MOST_FAILURES else [])
        else:
            self.done += 1
            self._elements += sum(outcome.report["elements"].values())
            self._metres += sum(outcome.report["metres"].values())
            if outcome.status == "done":
                self._frames += outcome.report["frames"]
        ended = self.done + self.failed
        if outcome.status != "done before":
            self._mapped += 1
            self._display.line(f"{datetime.now():%H:%M:%S}  {ended} of {self._total}  {_line(outcome)}{self._left()}")
        self._display.scenes(ended, self._total)

    def _left(self) -> str:
        todo = self._total - self.done - self.failed
        return f", {_duration(todo * (monotonic() - self._began) / self._mapped)} left" if todo else ""

    def close(self, summary: str, report: str, as_json: bool) -> None:
        """Print the table of a small batch and the totals, or these as JSON, and what failed."""
        if self._rows and not as_json:
            print_whole(_table(sorted(self._rows, key=lambda outcome: outcome.scene)))
        for outcome in self._failures:
            say_error(f"{outcome.scene}: {_reason(outcome)}")
        if self.failed > len(self._failures):
            say_error(f"and {self.failed - len(self._failures)} more; {report} names them all")
        seconds = monotonic() - self._began
        if as_json:
            counts = {"scenes": self._total, "done": self.done, "failed": self.failed, "mapped_now": self._mapped}
            totals = {"elements": self._elements, "metres": self._metres, "frames": self._frames, "seconds": seconds}
            print_json(counts | totals | {"written": [summary, report]})
            return
        speed = f", {self._frames} frames at {self._frames / seconds:.1f}/s in all" if self._frames else ""
        out.print(
            f"{self.done} of {self._total} scenes are done: {self._elements} elements, {self._metres / 1000:.1f} km; "
            f"{_duration(seconds)}{speed}",
            markup=False,
        )
        out.print(f"written: {summary}\nwritten: {report}", markup=False)


def _line(outcome: Outcome) -> str:
    if outcome.report is None:
        return f"{outcome.scene}  FAILED: {_reason(outcome).splitlines()[0]}"
    elements, metres = sum(outcome.report["elements"].values()), sum(outcome.report["metres"].values())
    said = (
        f"{outcome.scene}  {elements} elements, {metres:.0f} m; {outcome.report['frames']} frames at "
        f"{outcome.report['frames_per_second']:.1f}/s, {_duration(outcome.seconds)}"
    )
    return " ".join([said, *(f"({printable(note)})" for note in outcome.report.get("notes", ()))])


def _reason(outcome: Outcome) -> str:
    """Return what failed in words; our own errors for users need no class before them."""
    ours = outcome.error in ("UserError", "TimeLimitError", "WorkerDiedError")
    return str(outcome.reason) if ours else f"{outcome.error}: {outcome.reason}"


def _duration(seconds: float) -> str:
    if seconds < 100:
        return f"{seconds:.0f} s"
    minutes = round(seconds / 60)
    return f"{minutes} min" if minutes < 100 else f"{minutes // 60} h {minutes % 60} min"


def _table(outcomes: list[Outcome]) -> Table:
    table = Table(show_edge=False, pad_edge=False, collapse_padding=True)
    for heading in ("scene", ""):
        table.add_column(heading, no_wrap=True)
    for heading in ("elements", "metres", "frames/s", "mAP", "precision", "recall"):
        table.add_column(heading, justify="right", no_wrap=True)
    for outcome in outcomes:
        table.add_row(outcome.scene, outcome.status, *([] if outcome.report is None else _figures(outcome.report)))
    return table


def _figures(report: dict[str, Any]) -> list[str]:
    accuracy = report["accuracy"]
    measured = [f"{accuracy[name]:.3f}" for name in ("mean_ap", "precision", "recall")] if accuracy else []
    elements, metres = sum(report["elements"].values()), sum(report["metres"].values())
    return [str(elements), f"{metres:.0f}", f"{report['frames_per_second']:.1f}", *measured]
