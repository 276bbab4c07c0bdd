"""Map many scenes in workers, and resume where it stopped.

A scene is done when its files and its record are there and the record was made with the same settings. The record is
written last, so whatever stops a run (also SIGKILL) leaves scenes either done or untouched. Each scene is mapped by
itself and with the same number of threads, so the maps are equal to the bit whatever the order, the workers or the
interruptions.
"""

from __future__ import annotations

import hashlib
import traceback
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import lru_cache, partial
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING

import orjson

import predmapnet
from mapfusion.executors import Executor, Finished
from mapfusion.formats.local_plane import LocalPlane
from predmapnet.errors import UserError
from predmapnet.files import file_name
from predmapnet.machine import THREADS_PER_SCENE, NetworkOptions, use_threads
from predmapnet.runs.batch_records import (
    DONE,
    Outcome,
    done_before,
    forget_records,
    write_done,
    write_failed,
)
from predmapnet.runs.output_folder import OutputFolder
from predmapnet.runs.outputs import Outputs
from predmapnet.runs.scene_choice import ListedScene

if TYPE_CHECKING:
    from predmapnet.runs.infer import MappingPipeline


@dataclass(frozen=True)
class BatchSettings:
    """Settings of a batch, the same for all scenes and workers.

    Attributes:
        dataset, data_root: name and folder of the source; None where each scene says its folder, and it is recognised.
        network: as for a single scene.
        allow_missing_cameras: go on where a camera has no image.
        recordings, frames: whether these files are written, too.
        threads: CPU threads of each scene; the last digits of a map depend on them.
        origin: of the logs' frame, if the user says it.
        rate: frames a second of logs of one's own; None takes the usual one.
        force: replace maps that were changed by hand since they were written.
        map_suffix: ending of the maps, which is their format.
        crs: reference system of the maps, an EPSG code; None for the one of the format.
        weights_sha256: of the weights, which must be the same wherever a worker reads them.
        version: of PredMapNet, which must be the same on all machines.
    """

    dataset: str | None
    data_root: Path | None
    network: NetworkOptions = field(default_factory=NetworkOptions)
    allow_missing_cameras: bool = False
    recordings: bool = False
    frames: bool = False
    threads: int = THREADS_PER_SCENE
    origin: LocalPlane | None = None
    rate: float | None = None
    force: bool = False
    map_suffix: str = ".geojson"
    crs: str | None = None
    weights_sha256: str = ""
    version: str = predmapnet.__version__

    def outputs(self, scene: str, folder: Path) -> Outputs:
        """Name the files of one scene."""
        name = file_name(scene)
        return Outputs(
            map=folder / f"{name}{self.map_suffix}",
            recording=folder / f"{name}.rrd" if self.recordings else None,
            frames=folder / f"{name}.parquet" if self.frames else None,
            force=self.force,
            crs=self.crs,
        )

    def fingerprint(self, scene: ListedScene) -> str:
        """Return a hash of what the map of a scene depends on; a map made with other settings is made again."""
        deciding = [
            self.version,
            self.weights_sha256,
            self.dataset,
            str(scene.root or self.data_root),
            self.allow_missing_cameras,
            self.network.precision,
            self.network.compiled,
            None if self.origin is None else [self.origin.longitude, self.origin.latitude],
            self.threads,
            self.rate,
            self.crs,
        ]
        return hashlib.sha256(orjson.dumps(deciding)).hexdigest()[:16]


def map_scenes(
    scenes: Sequence[ListedScene],
    folder: OutputFolder,
    settings: BatchSettings,
    executor: Executor,
    begun: Callable[[int, int], None] = lambda before, todo: None,
) -> Iterator[Outcome]:
    """Map scenes and yield outcomes as they come: first those of an earlier run, then the new ones.

    Args:
        scenes: all of different names.
        folder: of the maps; it exists.
        settings: the same for all.
        executor: has the workers.
        begun: told once how many scenes were done before, and how many are to be mapped.

    Raises:
        UserError: no worker can begin: the data set or the weights are missing or broken.
    """
    folder.remove_unfinished()
    names = folder.names()
    wanted = {
        file_name(scene.name) + DONE: (
            scene.name,
            settings.fingerprint(scene),
            [path.name for path in settings.outputs(scene.name, Path()).paths],
        )
        for scene in scenes
    }
    before = done_before(folder, wanted, names)
    todo = [scene for scene in scenes if scene.name not in before]
    begun(len(before), len(todo))
    yield from before.values()
    for scene in todo:
        forget_records(folder, scene.name, names)
    try:
        for finished in executor.run(SceneWork(folder, settings), todo):
            outcome = finished.result if finished.error is None else _lost(finished)
            if outcome.status == "failed":
                write_failed(folder, outcome)
            yield outcome
    finally:
        folder.remove_unfinished()


def _lost(finished: Finished) -> Outcome:
    """Outcome of a scene that took its workers along."""
    error = finished.error
    return Outcome(finished.task.name, "failed", 0.0, error=type(error).__name__, reason=str(error))


@dataclass(frozen=True)
class SceneWork:
    """Work of a batch: called in a worker, it opens the network once and returns what maps one scene after the other.

    Raises:
        UserError: data or weights are missing here, or this machine has another version.
    """

    folder: OutputFolder
    settings: BatchSettings

    def __call__(self) -> Callable[[ListedScene], Outcome]:
        """Open the network, and the source if there is one for all."""
        settings = self.settings
        use_threads(settings.threads)
        from predmapnet.mapper import Mapper
        from predmapnet.runs.infer import MappingPipeline
        from predmapnet.sources import open_source

        # Workers share the cores by scenes: a second thread would only take turns with theirs.
        mapper = Mapper.from_checkpoint(replace(settings.network, ahead=False))
        here = (predmapnet.__version__, mapper.weights_sha256)
        if here != (settings.version, settings.weights_sha256):
            raise UserError(
                f"a worker has PredMapNet {here[0]} with the weights {here[1][:12]}, but the batch is of "
                f"{settings.version} with {settings.weights_sha256[:12]}; install the same on all machines"
            )

        @lru_cache(maxsize=2)
        def pipeline(root: Path | None) -> MappingPipeline:
            source, _ = open_source(settings.dataset, root, rate=settings.rate)
            return MappingPipeline(source, mapper, "", settings.allow_missing_cameras, settings.origin)

        if settings.data_root is not None:
            pipeline(settings.data_root)
        return partial(_map_scene, pipeline, self.folder, settings)


def _map_scene(
    pipeline: Callable[[Path | None], MappingPipeline],
    folder: OutputFolder,
    settings: BatchSettings,
    scene: ListedScene,
) -> Outcome:
    start = perf_counter()
    try:
        with folder.staged() as place:
            outputs = settings.outputs(scene.name, place)
            report = pipeline(scene.root or settings.data_root).run(scene.name, outputs).report
        seconds = perf_counter() - start
        content = asdict(report) | {"written": [path.name for path in report.written]}
        write_done(folder, scene.name, settings.fingerprint(scene), seconds, content)
        return Outcome(scene.name, "done", seconds, content)
    except Exception as error:
        # An error in one scene must not end the others; of one that is our fault, its record keeps the traceback.
        trace = None if isinstance(error, UserError) else traceback.format_exc()
        seconds, name = perf_counter() - start, type(error).__name__
        return Outcome(scene.name, "failed", seconds, error=name, reason=str(error), trace=trace)
