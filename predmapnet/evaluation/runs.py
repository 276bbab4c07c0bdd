"""Where the results of a scene come from: mapped now, or read from what an earlier run or another method wrote."""

from __future__ import annotations

import multiprocessing
import signal
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from mapfusion.elements import FrameMap, GlobalMap, RegionOfInterest
from mapfusion.integrator import MapIntegrator
from predmapnet.datasets.selection import open_source
from predmapnet.datasets.source import Frame, Progress, Scene, SceneSource
from predmapnet.errors import UserError
from predmapnet.evaluation.frames import EvaluationFrame
from predmapnet.evaluation.frames_io import read_frames, stored_scenes
from predmapnet.evaluation.measurement import SceneMeasurement, measure_scene
from predmapnet.evaluation.submission import SubmittedFrame, read_submission
from predmapnet.threads import use_threads

if TYPE_CHECKING:
    from predmapnet.mapper import Mapper

Float = NDArray[np.float64]


@dataclass(frozen=True)
class EvaluationSettings:
    """What is measured; the same for all scenes, and sent to the processes.

    Attributes:
        dataset, data_root: where frames, poses and ground truth come from.
        results: a run folder, a Parquet file or a submission in JSON; None maps the scenes now.
        weights, device: of the network that maps.
        roi: region of a submission, which does not say it itself.
        threads: CPU threads of each process.
    """

    dataset: str | None = None
    data_root: Path | None = None
    results: Path | None = None
    weights: Path | None = None
    device: str = "auto"
    roi: RegionOfInterest = field(default_factory=RegionOfInterest)
    threads: int = 1


def scenes_to_measure(settings: EvaluationSettings, source: SceneSource, split: str | None) -> list[str]:
    """List the scenes: those of the split, or else those that the results hold, by name.

    Raises:
        UserError: there is none, or the results lack scenes of the split.
    """
    wanted = sorted(scene.name for scene in source.scenes(split))
    if not wanted:
        raise UserError(f"{source.name} holds no scene{f' of the split {split}' if split else ''}.")
    if settings.results is None:
        return wanted
    held = _scenes_in(settings.results, source, wanted)
    if split is None:
        unknown = sorted(held - set(wanted))
        if unknown:
            raise UserError(f"{settings.results} holds {unknown[0]}, which is no scene of {source.name}.")
        return sorted(held)
    missing = [scene for scene in wanted if scene not in held]
    if missing:
        named = ", ".join(missing[:5]) + (" ..." if len(missing) > 5 else "")
        raise UserError(
            f"{settings.results} lacks {len(missing)} of {len(wanted)} scenes of the split {split}: {named}"
        )
    return wanted


def measure_scenes(
    settings: EvaluationSettings, scenes: Sequence[str], jobs: int = 1, preparing: Progress | None = None
) -> Iterator[SceneMeasurement]:
    """Measure scenes one after the other or in several processes; they come in the order of ``scenes``.

    Args:
        settings: what to measure.
        scenes: names.
        jobs: number of processes.
        preparing: called while a scene is made ready (with one process only).

    Raises:
        UserError: data or results are broken; the message says which.
    """
    if jobs == 1:
        for scene in scenes:
            yield _measure(settings, scene, preparing)
        return
    context = multiprocessing.get_context("spawn")
    pool = ProcessPoolExecutor(jobs, mp_context=context, initializer=_begin_worker, initargs=(settings.threads,))
    try:
        futures = [pool.submit(_measure, settings, scene) for scene in scenes]
        for future in futures:
            yield future.result()
    except BaseException:
        workers = list((getattr(pool, "_processes", None) or {}).values())
        pool.shutdown(wait=False, cancel_futures=True)
        for worker in workers:
            worker.terminate()
        raise
    pool.shutdown()


def _begin_worker(threads: int) -> None:
    # Ctrl-C is the parent's business; it ends its workers itself.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    use_threads(threads)


def _measure(settings: EvaluationSettings, name: str, preparing: Progress | None = None) -> SceneMeasurement:
    scene = _source(settings).open(name, preparing)
    if settings.results is None:
        from predmapnet.streaming import map_scene

        run = map_scene(scene, _mapper(settings))
        return measure_scene(_with_truth(scene, run.frame_maps), run.global_map, scene.truth_map(), run.seconds)
    frame_maps = _stored_maps(settings.results, settings.roi, scene)
    return measure_scene(_with_truth(scene, frame_maps), _integrated(name, frame_maps), scene.truth_map())


@lru_cache(maxsize=1)
def _source(settings: EvaluationSettings) -> SceneSource:
    return open_source(settings.dataset, settings.data_root)[0]


@lru_cache(maxsize=1)
def _mapper(settings: EvaluationSettings) -> Mapper:
    from predmapnet.mapper import Mapper

    return Mapper.from_checkpoint(settings.weights, device=settings.device)


@lru_cache(maxsize=1)
def _submission(path: Path) -> dict[str, SubmittedFrame]:
    return dict(read_submission(path))


def _scenes_in(results: Path, source: SceneSource, wanted: Sequence[str]) -> set[str]:
    """Names of the scenes that results hold; a submission names frames only, so scenes are looked through."""
    if results.is_dir():
        names = {path.stem for path in results.glob("*.parquet")}
        if not names:
            raise UserError(
                f"The folder {results} holds no per-frame results (*.parquet); "
                "make them with 'predmapnet batch --save-frames'."
            )
        return names
    if results.suffix == ".json":
        tokens = set(_submission(results))
        return {name for name in wanted if any(frame.token in tokens for frame in _frames(source.open(name)))}
    return set(stored_scenes(results))


def _stored_maps(results: Path, roi: RegionOfInterest, scene: Scene) -> list[FrameMap]:
    """What results say of each frame of a scene; a frame that they do not name holds no prediction."""
    if results.suffix == ".json":
        submission = _submission(results)
        nothing = SubmittedFrame(np.zeros(0, np.int64), np.zeros(0), np.zeros(0, np.int64), ())
        return [submission.get(frame.token, nothing).at(frame, roi) for frame in _frames(scene)]
    name = scene.info.name
    path = results / f"{name}.parquet" if results.is_dir() else results
    stored = {frame.index: frame.frame_map for frame in read_frames(path, name).frames}
    if not stored:
        raise UserError(f"{path} holds no frame of {name}.")
    roi = next(iter(stored.values())).roi
    return [_at(path, frame, stored.get(frame.index), roi) for frame in _frames(scene)]


def _at(path: Path, frame: Frame, stored: FrameMap | None, roi: RegionOfInterest) -> FrameMap:
    if stored is None:
        nothing = np.zeros(0, dtype=np.int64)
        return FrameMap(frame.timestamp, frame.ego_to_global, roi, nothing, np.zeros(0), nothing, ())
    if not np.allclose(stored.ego_to_global, frame.ego_to_global, atol=1e-3):
        raise UserError(
            f"{path}, {frame.scene}, frame {frame.index}: the pose is not the data set's; the results were made from "
            "other data."
        )
    return stored


def _frames(scene: Scene) -> Iterator[Frame]:
    return (scene.frame(index) for index in range(len(scene)))


def _integrated(name: str, frame_maps: Sequence[FrameMap]) -> GlobalMap | None:
    """Fuse what was read as mapping would have; None if nothing is tracked."""
    if not any((frame_map.track_ids >= 0).any() for frame_map in frame_maps):
        return None
    integrator = MapIntegrator()
    for frame_map in frame_maps:
        integrator.add(frame_map, log=name)
    return integrator.map()


def _with_truth(scene: Scene, frame_maps: Sequence[FrameMap]) -> list[EvaluationFrame]:
    frames = []
    for index, frame_map in enumerate(frame_maps):
        truth = scene.truth(index, frame_map.roi)
        if truth is None:
            raise UserError(f"{scene.info.name} has no ground truth, so nothing can be measured against it.")
        frames.append(EvaluationFrame(scene.info.name, index, frame_map, truth))
    return frames
