"""Map many scenes in several processes, and resume where it stopped.

A scene is done when its map and its summary are there and the summary was made with the same settings. The summary
is written last, so whatever stops a run (also SIGKILL) leaves scenes either done or untouched. Each scene is mapped
by itself, so the maps are the same whatever the order, the number of processes or the interruptions.
"""

from __future__ import annotations

import difflib
import hashlib
import multiprocessing
import traceback
from collections import Counter
from collections.abc import Generator, Iterable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from dataclasses import asdict, dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING, Any

import orjson

import predmapnet
from mapfusion.formats.local_plane import LocalPlane
from predmapnet.errors import UserError
from predmapnet.files import check_output, file_name, write_file
from predmapnet.machine import NetworkOptions, begin_worker, stop_workers
from predmapnet.runs.outputs import Outputs

if TYPE_CHECKING:
    from predmapnet.runs.infer import MappingPipeline
    from predmapnet.scenes import SceneSource


@dataclass(frozen=True)
class BatchSettings:
    """Settings of a batch, the same for all scenes and processes.

    Attributes:
        dataset, data_root: name and folder of the source that was opened.
        network: as for a single scene.
        allow_missing_cameras: go on where a camera has no image.
        recordings, frames: whether these files are written, too.
        threads: CPU threads of each process.
        origin: of the logs' frame, if the user says it.
        rate: frames a second of logs of one's own; None takes the usual one.
    """

    dataset: str
    data_root: Path
    network: NetworkOptions = field(default_factory=NetworkOptions)
    allow_missing_cameras: bool = False
    recordings: bool = False
    frames: bool = False
    threads: int = 1
    origin: LocalPlane | None = None
    rate: float | None = None

    def outputs(self, scene: str, folder: Path) -> Outputs:
        """Name the files of one scene."""
        name = file_name(scene)
        return Outputs(
            map=folder / f"{name}.geojson",
            recording=folder / f"{name}.rrd" if self.recordings else None,
            frames=folder / f"{name}.parquet" if self.frames else None,
        )


@dataclass(frozen=True)
class Outcome:
    """Outcome of one scene.

    Attributes:
        scene: its name.
        status: ``done``, ``done before`` or ``failed``.
        seconds: wall time; of the earlier run for ``done before``.
        report: as in :class:`predmapnet.runs.infer.SceneReport`, None if it failed.
        reason: of a failure.
    """

    scene: str
    status: str
    seconds: float
    report: dict[str, Any] | None = None
    reason: str | None = None


def choose_scenes(source: SceneSource, names: Sequence[str], split: str | None) -> list[str]:
    """Return the scenes to map: those named, or all of a split, or all.

    Raises:
        UserError: a name or split does not exist (with the nearest names), or there is nothing to map.
    """
    known = [scene.name for scene in source.scenes(split)]
    if not names:
        if not known:
            raise UserError(f"{source.name} holds no scene{f' of the split {split}' if split else ''} to map")
        return known
    for name in names:
        if name not in known:
            near = difflib.get_close_matches(name, known, n=3, cutoff=0.4)
            hint = f"; did you mean {', '.join(near)}?" if near else ""
            raise UserError(f"there is no scene '{name}' in {source.name}{f', split {split}' if split else ''}{hint}")
    return list(dict.fromkeys(names))


def prepare_folder(folder: Path) -> None:
    """Create the output folder if need be, and check that files can be written there. Raises UserError."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UserError(f"cannot make the folder {folder}: {(error.strerror or str(error)).lower()}") from error
    check_output(folder / "summary.json")


class BatchJournal:
    """Journal of a batch: one JSON line per outcome in ``log.jsonl`` at once, all in ``summary.json`` at the end."""

    def __init__(self, folder: Path) -> None:
        self.outcomes: list[Outcome] = []
        self._folder = folder

    def add(self, outcome: Outcome) -> None:
        """Note one outcome; earlier lines of the log stay."""
        self.outcomes.append(outcome)
        line = {"time": datetime.now(UTC).isoformat(timespec="seconds")} | asdict(outcome)
        with (self._folder / "log.jsonl").open("ab") as log:
            log.write(orjson.dumps(line) + b"\n")

    def close(self) -> None:
        """Write the summary, scenes in the order of their names."""
        ordered = sorted(self.outcomes, key=lambda outcome: outcome.scene)
        counts = Counter(outcome.status for outcome in ordered)
        summary = {"counts": dict(counts), "scenes": [asdict(outcome) for outcome in ordered]}
        with write_file(self._folder / "summary.json") as temporary:
            temporary.write_bytes(orjson.dumps(summary, option=orjson.OPT_INDENT_2))


def settings_hash(settings: BatchSettings, weights_sha256: str) -> str:
    """Return a hash of the settings that a map depends on; a scene made with others is mapped again."""
    deciding = [
        predmapnet.__version__,
        weights_sha256,
        settings.dataset,
        str(settings.data_root),
        settings.allow_missing_cameras,
        settings.network.precision,
        settings.network.compiled,
        None if settings.origin is None else [settings.origin.longitude, settings.origin.latitude],
        settings.rate,
    ]
    return hashlib.sha256(orjson.dumps(deciding)).hexdigest()[:16]


def summary_path(folder: Path, scene: str) -> Path:
    """Return the file whose presence marks a scene as done."""
    return folder / f"{file_name(scene)}.summary.json"


def finished_before(scene: str, folder: Path, settings: BatchSettings, fingerprint: str) -> Outcome | None:
    """Return the outcome of an earlier run, or None if the scene has to be mapped."""
    path = summary_path(folder, scene)
    if not path.is_file() or not all(file.is_file() for file in settings.outputs(scene, folder).paths):
        return None
    try:
        summary = orjson.loads(path.read_bytes())
    except orjson.JSONDecodeError:
        return None
    if not isinstance(summary, dict) or summary.get("settings") != fingerprint:
        return None
    return Outcome(scene, "done before", summary["report"]["seconds"], summary["report"])


def map_scenes(
    scenes: Sequence[str], folder: Path, settings: BatchSettings, jobs: int, weights_sha256: str
) -> Iterator[Outcome]:
    """Map scenes and yield outcomes as they come: first those of an earlier run, then the new ones.

    Args:
        scenes: names.
        folder: of the maps; it exists.
        settings: the same for all.
        jobs: number of processes.
        weights_sha256: of the weights that ``settings`` name.
    """
    remove_unfinished(folder)
    fingerprint = settings_hash(settings, weights_sha256)
    todo: list[str] = []
    for scene in scenes:
        before = finished_before(scene, folder, settings, fingerprint)
        if before is None:
            # An old summary must not vouch for a new, perhaps interrupted, run.
            summary_path(folder, scene).unlink(missing_ok=True)
            todo.append(scene)
        else:
            yield before
    broken = yield from _in_pool(todo, folder, settings, fingerprint, jobs)
    # A process died (memory, or killed from outside) and took its pool along. Whoever was at work then gets
    # one more try, alone, so that it is clear which scene it was.
    for scene in broken:
        again = yield from _in_pool([scene], folder, settings, fingerprint, 1)
        if again:
            reason = "its process was killed twice; too little memory? Try fewer --jobs"
            yield Outcome(scene, "failed", 0.0, reason=reason)


def _in_pool(
    scenes: Iterable[str], folder: Path, settings: BatchSettings, fingerprint: str, jobs: int
) -> Generator[Outcome, None, list[str]]:
    """Map scenes in a pool, at most ``jobs`` handed out at a time; return those that a dead process left."""
    waiting = list(reversed(list(scenes)))
    broken: list[str] = []
    while waiting:
        context = multiprocessing.get_context("spawn")
        pool = ProcessPoolExecutor(jobs, mp_context=context, initializer=begin_worker, initargs=(settings.threads,))
        running: dict[Future[Outcome], str] = {}
        try:
            while waiting or running:
                while waiting and len(running) < jobs:
                    scene = waiting.pop()
                    running[pool.submit(_map_one, scene, folder, settings, fingerprint)] = scene
                finished, _ = wait(running, return_when=FIRST_COMPLETED)
                for future in finished:
                    scene = running.pop(future)
                    if isinstance(future.exception(), BrokenProcessPool):
                        broken.append(scene)
                    else:
                        yield future.result()
                if broken:
                    broken.extend(running.values())
                    running.clear()
                    break
        finally:
            if running:
                stop_workers(pool)
                remove_unfinished(folder)
            else:
                pool.shutdown()
    return broken


def remove_unfinished(folder: Path) -> None:
    """Remove files that were being written when a process was killed."""
    for leftover in folder.glob(".*.part*"):
        leftover.unlink(missing_ok=True)


_pipeline: MappingPipeline | None = None
"""The source and the network of a worker process, opened once."""


def _map_one(scene: str, folder: Path, settings: BatchSettings, fingerprint: str) -> Outcome:
    start = perf_counter()
    try:
        report = _worker_pipeline(settings).run(scene, settings.outputs(scene, folder)).report
        content = asdict(report) | {"written": [path.name for path in report.written]}
        with write_file(summary_path(folder, scene)) as temporary:
            summary = {"scene": scene, "settings": fingerprint, "report": content}
            temporary.write_bytes(orjson.dumps(summary, option=orjson.OPT_INDENT_2))
        return Outcome(scene, "done", perf_counter() - start, content)
    except UserError as error:
        return Outcome(scene, "failed", perf_counter() - start, reason=str(error))
    except Exception as error:
        # An unexpected error in one scene must not end the others; the log keeps its traceback.
        trace = traceback.format_exc(limit=-3)
        return Outcome(scene, "failed", perf_counter() - start, reason=f"{type(error).__name__}: {error}\n{trace}")


def _worker_pipeline(settings: BatchSettings) -> MappingPipeline:
    global _pipeline
    if _pipeline is None:
        from predmapnet.runs.infer import MappingPipeline

        _pipeline = MappingPipeline.open(
            settings.dataset,
            settings.data_root,
            settings.network,
            settings.allow_missing_cameras,
            settings.origin,
            settings.rate,
        )
    return _pipeline
