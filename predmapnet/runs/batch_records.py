"""Records of a batch: one file for each scene, done or failed, and the summary of a folder made of them."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from typing import Any, Literal

import orjson
from pydantic import BaseModel

from mapfusion import json_text
from predmapnet.files import file_name
from predmapnet.runs.output_folder import OutputFolder

DONE, FAILED = ".summary.json", ".failed.json"
"""Endings of the records of scenes."""


@dataclass(frozen=True)
class Outcome:
    """Outcome of one scene.

    Attributes:
        scene: its name.
        status: ``done``, ``done before`` or ``failed``.
        seconds: wall time, with reading and measuring; of the earlier run for ``done before``.
        report: as in :class:`predmapnet.runs.infer.SceneReport`, None if it failed.
        error: class of the error that it failed with.
        reason: what the error says.
        trace: where an unexpected error came from.
    """

    scene: str
    status: str
    seconds: float
    report: dict[str, Any] | None = None
    error: str | None = None
    reason: str | None = None
    trace: str | None = None


def write_done(folder: OutputFolder, scene: str, fingerprint: str, seconds: float, report: dict[str, Any]) -> None:
    """Write the record whose presence says that all files of a scene are there."""
    _write(
        folder,
        file_name(scene) + DONE,
        {"scene": scene, "settings": fingerprint, "seconds": seconds, "report": report},
    )


def write_failed(folder: OutputFolder, outcome: Outcome) -> None:
    """Write the record of a failure."""
    record = asdict(outcome) | {"time": datetime.now(UTC).isoformat(timespec="seconds")}
    _write(folder, file_name(outcome.scene) + FAILED, record)


def forget_records(folder: OutputFolder, scene: str, names: set[str]) -> None:
    """Remove the records of a scene that is mapped again: they must not speak for a run that may be interrupted."""
    for name in (file_name(scene) + DONE, file_name(scene) + FAILED):
        if name in names:
            folder.remove(name)


def done_before(
    folder: OutputFolder, wanted: dict[str, tuple[str, str, list[str]]], names: set[str]
) -> dict[str, Outcome]:
    """Return the outcomes of scenes that are done.

    Args:
        folder: of the batch.
        wanted: by the name of its record, each scene, the fingerprint that the record must have, and the scene's files.
        names: of the files in the folder.
    """
    found = {}
    for name, content in folder.read([name for name in wanted if name in names]):
        scene, fingerprint, files = wanted[name]
        record = _parsed(content)
        if record is not None and record.get("settings") == fingerprint and names.issuperset(files):
            found[scene] = _outcome(record)
    return found


def outcomes_in(folder: OutputFolder) -> Iterator[Outcome]:
    """Yield what is known of every scene of a folder, by name; a scene that is done has not failed."""
    names = folder.names()
    done = {name.removesuffix(DONE): name for name in names if name.endswith(DONE)}
    failed = {name.removesuffix(FAILED): name for name in names if name.endswith(FAILED)}
    for _, content in folder.read([name for _, name in sorted((failed | done).items())]):
        record = _parsed(content)
        if record is not None:
            yield _outcome(record)


def write_summary(folder: OutputFolder, mapped_now: set[str]) -> None:
    """Write ``summary.json``: every scene of the folder, whichever call of the command mapped it.

    Args:
        folder: of the batch.
        mapped_now: names of the scenes that this call mapped; the others were done before.
    """
    counts: Counter[str] = Counter()
    lines = []
    for outcome in outcomes_in(folder):
        status = "done" if outcome.status != "failed" and outcome.scene in mapped_now else outcome.status
        counts[status] += 1
        lines.append(orjson.dumps(asdict(outcome) | {"status": status}))
    with folder.write("summary.json") as temporary:
        temporary.write_bytes(
            b'{"counts": ' + orjson.dumps(counts) + b',\n"scenes": [\n' + b",\n".join(lines) + b"\n]}\n"
        )


def log_outcome(folder: OutputFolder, outcome: Outcome) -> None:
    """Append an outcome to ``log.jsonl``, whose earlier lines stay; an object store cannot be appended to."""
    if folder.path is not None:
        line = {"time": datetime.now(UTC).isoformat(timespec="seconds")} | asdict(outcome)
        with (folder.path / "log.jsonl").open("ab") as log:
            log.write(orjson.dumps(line) + b"\n")


def _write(folder: OutputFolder, name: str, record: dict[str, Any]) -> None:
    with folder.write(name) as temporary:
        temporary.write_bytes(orjson.dumps(record, option=orjson.OPT_INDENT_2))


class _Accuracy(BaseModel):
    mean_ap: float | None
    precision: float | None
    recall: float | None


class _Report(BaseModel):
    """Parts of a scene's report that are read again."""

    frames: int
    seconds: float
    frames_per_second: float
    elements: dict[str, int]
    metres: dict[str, float]
    rejections: dict[str, int]
    accuracy: _Accuracy | None = None
    notes: list[str] = []


class _Record(BaseModel):
    scene: str
    status: Literal["failed"] | None = None
    seconds: float | None = None
    report: _Report | None = None
    error: str | None = None
    reason: str | None = None
    trace: str | None = None


def _parsed(content: bytes) -> dict[str, Any] | None:
    """Return a record as it was written; None for what is none, since other programs write summaries, too."""
    try:
        record = json_text.parse(content)
        found = _Record.model_validate(record, strict=True)
    except ValueError:
        return None
    return record if found.report is not None or found.status is not None else None


def _outcome(record: dict[str, Any]) -> Outcome:
    if record.get("report") is None:
        fields = ("scene", "status", "seconds", "report", "error", "reason", "trace")
        return Outcome(**{name: record.get(name) for name in fields})  # type: ignore[arg-type]
    report = record["report"]
    return Outcome(record["scene"], "done before", record.get("seconds", report["seconds"]), report)
