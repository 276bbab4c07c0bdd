"""Messages, progress (bars in a terminal, plain lines elsewhere) and tables of the commands."""

from __future__ import annotations

import sys
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict
from time import monotonic
from typing import TYPE_CHECKING

from rich.console import Console
from rich.markup import escape
from rich.measure import Measurement
from rich.table import Table

if TYPE_CHECKING:
    from rich.progress import Progress, TaskID

    from predmapnet.runs.infer import MappingPipeline, SceneReport

out = Console(highlight=False, soft_wrap=True)
err = Console(stderr=True, highlight=False, soft_wrap=True)

SECONDS_BETWEEN_LINES = 5.0


def say_error(message: str) -> None:
    """Print an error that the user can put right."""
    err.print(f"[bold red]Error:[/] {escape(printable(message))}")


def printable(text: str) -> str:
    """Return a text with what data may bring to move a terminal's cursor or change its colours spelled out."""
    return "".join(each if each.isprintable() or each == "\n" else repr(each)[1:-1] for each in text)


def print_json(content: object) -> None:
    """Print JSON on stdout, for other programs; what JSON does not know (paths) becomes text."""
    import orjson

    options = orjson.OPT_INDENT_2 | orjson.OPT_NON_STR_KEYS | orjson.OPT_SERIALIZE_NUMPY
    sys.stdout.write(orjson.dumps(content, option=options, default=str).decode() + "\n")


def counted(count: int, noun: str) -> str:
    """Return a number with its noun: ``1 map``, ``2 maps``."""
    return f"{count:,} {noun}" + ("" if count == 1 else "s")


def say_warning(message: str) -> None:
    """Print a note for the user."""
    err.print(f"[bold yellow]Note:[/] {escape(printable(message))}")


class ProgressDisplay:
    """Progress of a run; the methods fit the callbacks of the pipeline."""

    def __init__(self, bars: Progress | None) -> None:
        self._bars = bars
        self._tasks: dict[str, TaskID] = {}
        self._began: dict[str, float] = {}
        self._spoke: dict[str, float] = {}

    def preparing(self, done: int, total: int, what: str) -> None:
        """Show the progress of a preparation."""
        self._show(what, done, total, "")

    def frames(self, done: int, total: int) -> None:
        """Show the number of frames mapped."""
        self._show("mapping", done, total, "frames/s")

    def scenes(self, done: int, total: int) -> None:
        """Show the number of scenes finished."""
        self._show("scenes", done, total, "")

    def line(self, text: str) -> None:
        """Print a line, above the bars where there are some."""
        err.print(text, markup=False)

    def _show(self, what: str, done: int, total: int, unit: str) -> None:
        now = monotonic()
        began = self._began.setdefault(what, now)
        rate = f"{done / (now - began):.1f} {unit}" if unit and now > began else ""
        if self._bars is not None:
            if what not in self._tasks:
                self._tasks[what] = self._bars.add_task(what, total=total, rate="")
            self._bars.update(self._tasks[what], completed=done, total=total, rate=rate)
        elif done == total or now - self._spoke.get(what, began) >= SECONDS_BETWEEN_LINES:
            self._spoke[what] = now
            err.print(f"{what}: {done} of {total}{'  ' + rate if rate else ''}")


@contextmanager
def progress_display() -> Iterator[ProgressDisplay]:
    """Show progress on stderr while the block runs."""
    if not err.is_terminal:
        yield ProgressDisplay(None)
        return
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn("{task.fields[rate]}"),
        TimeElapsedColumn(),
    )
    with Progress(*columns, console=err) as bars:
        yield ProgressDisplay(bars)


def elements_table(title: str, elements: Mapping[str, int], metres: Mapping[str, float]) -> Table:
    """Return the table of a map: elements and metres, both by label of the kind."""
    from mapfusion.elements import ElementKind

    table = Table(title=title or None, title_justify="left", title_style="bold", show_edge=False, pad_edge=False)
    table.add_column("")
    table.add_column("elements", justify="right")
    table.add_column("metres", justify="right")
    for kind in ElementKind:
        table.add_row(kind.nouns, f"{elements[kind.label]:,}", f"{metres[kind.label]:,.0f}")
    return table


def report_lines(report: SceneReport) -> list[str]:
    """Return the lines below the table: time, accuracy, files."""
    prepared = f", {report.preparing_seconds:.1f} s to prepare" if report.preparing_seconds >= 1.0 else ""
    speed = f"in {report.seconds:.1f} s ({report.frames_per_second:.1f} frames/s)"
    lines = [f"{counted(report.frames, 'frame')} {speed}{prepared}"]
    if report.accuracy is not None:
        accuracy = report.accuracy
        lines.append(
            f"against the ground truth: mAP {accuracy.mean_ap:.3f} of the frames; "
            f"precision {accuracy.precision:.3f} and recall {accuracy.recall:.3f} of the map at 1.0 m"
        )
    lines.extend(f"written: {path}" for path in report.written)
    return lines


def warn_of_weights(pipeline: MappingPipeline) -> None:
    """Print a note about weights that say little about the method."""
    if pipeline.warning:
        say_warning(pipeline.warning)


def say_report(report: SceneReport, as_json: bool = False) -> None:
    """Print the report of one scene, and what the integrator rejected."""
    if as_json:
        print_json(asdict(report))
    else:
        print_whole(elements_table(report.scene, report.elements, report.metres))
        for line in report_lines(report):
            out.print(line, markup=False)
    say_notes(report.notes, report.rejections)


def say_notes(notes: Iterable[str], rejections: Mapping[str, int]) -> None:
    """Print notes of a run, and what the integrator rejected."""
    for note in notes:
        say_warning(note)
    for reason, count in rejections.items():
        say_warning(f"the integrator rejected {count} x {reason}")


def print_whole(table: Table) -> None:
    """Print a table at its own width: a terminal that is too narrow breaks its lines, but no number is cut."""
    width = Measurement.get(out, out.options.update(max_width=1000), table).maximum
    out.print(table, width=max(width, out.width), crop=False)
