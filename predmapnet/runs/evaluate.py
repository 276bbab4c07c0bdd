"""Evaluation of scenes: mapped now, or read from the files of an earlier run or another method."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from mapfusion.elements import FrameMap, GlobalMap, RegionOfInterest
from mapfusion.executors import results_in_order
from mapfusion.integrate.integrator import MapIntegrator
from predmapnet.errors import UserError
from predmapnet.evaluation.frames import EvaluationFrame
from predmapnet.evaluation.measurement import SceneMeasurement, measure_scene
from predmapnet.evaluation.recognition import check_region, frames_look_like, looks_foreign, region_of
from predmapnet.evaluation.stability_protocol import Protocol
from predmapnet.files import file_name
from predmapnet.frame_files.parquet import read_frames, refuse_pickle, stored_scenes
from predmapnet.frame_files.submission import NOTHING, SubmittedFrame, position_name, read_submission
from predmapnet.machine import NetworkOptions, use_threads
from predmapnet.mapping import NETWORK_ERRORS
from predmapnet.runs.integrate import with_own_ids
from predmapnet.runs.process_executor import ProcessExecutor
from predmapnet.scenes import Instant, Progress, Scene, SceneSource
from predmapnet.sources import open_source

if TYPE_CHECKING:
    from predmapnet.mapper import Mapper

Submitted = dict[str, SubmittedFrame]
"""Frames of a submission by name."""


@dataclass(frozen=True, kw_only=True)
class EvaluationSettings:
    """Settings of an evaluation, the same for all scenes and processes.

    Attributes:
        dataset, data_root: source of frames, poses and ground truth.
        split_scheme, official_frames, rate: see :func:`predmapnet.sources.open_source`.
        results: a run folder, a Parquet file or a submission in JSON; None maps the scenes now.
        network: of scenes that are mapped.
        roi: region of a submission, which does not state it; see :func:`submitted_region`.
        protocol: of the stability.
        threads: CPU threads of each process.
        cache: folder that keeps the ground truth; None computes it anew.
    """

    dataset: str | None = None
    data_root: Path | None = None
    split_scheme: str = "old"
    official_frames: bool = False
    rate: float | None = None
    results: Path | None = None
    network: NetworkOptions = field(default_factory=NetworkOptions)
    roi: RegionOfInterest = field(default_factory=RegionOfInterest)
    protocol: Protocol = Protocol.ANCHORED
    threads: int = 1
    cache: Path | None = None

    def open(self) -> tuple[SceneSource, str]:
        """Open the data set; returns what :func:`predmapnet.sources.open_source` does."""
        return open_source(self.dataset, self.data_root, self.split_scheme, self.official_frames, self.rate)


def scenes_to_measure(settings: EvaluationSettings, source: SceneSource, split: str | None) -> list[str]:
    """List the scenes: those of the split, or else those that the results hold, by name.

    Raises:
        UserError: there is none, the results lack scenes of the split, or hold frames that the data set does not.
    """
    wanted = sorted(scene.name for scene in source.scenes(split))
    if not wanted:
        raise UserError(f"{source.name} holds no scene{f' of the split {split}' if split else ''}.")
    if settings.results is None:
        return wanted
    held = _scenes_in(settings.results, source, split is None)
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


def submitted_region(results: Path, stated: RegionOfInterest | None) -> RegionOfInterest:
    """Recognise the region of a submission, or check the one that the user states.

    Raises:
        UserError: the submission is broken, mixes regions or has other axes, or contradicts what was stated.
    """
    frames = [
        [line for line in frame.polylines if np.isfinite(line).all()] for frame in _submission(results).frames.values()
    ]
    if stated is None:
        return region_of(results, frames)
    check_region(results, [line for lines in frames for line in lines], stated)
    return stated


def measure_scenes(
    settings: EvaluationSettings, scenes: Sequence[str], jobs: int = 1, preparing: Progress | None = None
) -> Iterator[SceneMeasurement]:
    """Measure scenes one after the other or in several processes; they come in the order of their names.

    ``preparing`` is called while a scene is made ready (with one process only).

    Raises:
        UserError: data or results are broken; the message says which.
    """
    submitted = _submitted_of(settings, scenes)
    if jobs == 1:
        for scene in scenes:
            yield _measure(settings, scene, submitted.get(scene), preparing)
        return
    tasks = [(scene, submitted.get(scene)) for scene in scenes]
    yield from results_in_order(ProcessExecutor(jobs), _MeasuringWork(settings), tasks)


@dataclass(frozen=True)
class _MeasuringWork:
    """Work of an evaluation in a worker."""

    settings: EvaluationSettings

    def __call__(self) -> Callable[[tuple[str, Submitted | None]], SceneMeasurement]:
        use_threads(self.settings.threads)
        return lambda task: _measure(self.settings, *task)


def _measure(
    settings: EvaluationSettings, name: str, submitted: Submitted | None, preparing: Progress | None = None
) -> SceneMeasurement:
    scene = _source(settings).open(name, preparing)
    if settings.results is None:
        from predmapnet.mapping import map_scene

        run = map_scene(scene, _mapper(settings))
        frames = _with_truth(scene, run.frame_maps, settings.cache)
        truth_map = scene.truth_map(frames[0].predicted.roi)
        measured = measure_scene(frames, run.global_map, truth_map, run.seconds, settings.protocol)
        maps = _pair(run.global_map, truth_map)
        return replace(measured, weights_sha256=_mapper(settings).weights_sha256, maps=maps)
    if submitted is not None:
        found = _Found(
            _submitted_maps(settings.results, submitted, settings.roi, scene), len(scene) - len(submitted), None
        )
    else:
        found = _stored_maps(settings.results, scene, _source(settings).name)
    frames = _with_truth(scene, found.maps, settings.cache)
    global_map, truth_map = _integrated(name, found.maps), scene.truth_map(frames[0].predicted.roi)
    measured = measure_scene(frames, global_map, truth_map, protocol=settings.protocol)
    maps = _pair(global_map, truth_map)
    return replace(measured, absent_frames=found.absent, weights_sha256=found.weights_sha256, maps=maps)


def _pair(global_map: GlobalMap, truth_map: GlobalMap | None) -> tuple[GlobalMap, GlobalMap] | None:
    return None if truth_map is None else (global_map, truth_map)


@dataclass(frozen=True)
class _Found:
    """Predictions for each frame of a scene, how many frames had none, and the weights that made them, if known."""

    maps: list[FrameMap]
    absent: int
    weights_sha256: str | None


@lru_cache(maxsize=1)
def _source(settings: EvaluationSettings) -> SceneSource:
    return settings.open()[0]


@lru_cache(maxsize=1)
def _mapper(settings: EvaluationSettings) -> Mapper:
    from predmapnet.mapper import Mapper

    return Mapper.from_checkpoint(settings.network)


@dataclass(frozen=True)
class _Submission:
    """Frames by name, and notes on what of them was left out."""

    frames: Submitted
    notes: tuple[str, ...]


def _submission(path: Path) -> _Submission:
    return _read_submission(path, path.stat().st_mtime_ns)


@lru_cache(maxsize=1)
def _read_submission(path: Path, changed: int) -> _Submission:
    """Read a submission once for as long as it does not change (``changed``: when it was written)."""
    notes: list[str] = []
    return _Submission(read_submission(path, notes), tuple(notes))


def notes_of(settings: EvaluationSettings, source: SceneSource) -> list[str]:
    """Return what of a submission is not measured: elements of other classes, and frames that the data set lacks."""
    if settings.results is None or settings.results.is_dir() or settings.results.suffix.lower() != ".json":
        return []
    submission = _submission(settings.results)
    lost = len(submission.frames) - len(_scene_by_name(submission.frames, source))
    unknown = f"{lost} of {len(submission.frames)} frames of the results are not in {source.name} and are left out"
    return [*submission.notes, *([unknown] if lost else [])]


def _submitted_of(settings: EvaluationSettings, scenes: Sequence[str]) -> dict[str, Submitted]:
    """Frames of a submission by scene: it is read once, each process gets its share. Empty for our own files."""
    if settings.results is None or settings.results.is_dir() or settings.results.suffix.lower() != ".json":
        return {}
    submission = _submission(settings.results).frames
    of_scene: dict[str, Submitted] = {scene: {} for scene in scenes}
    for name, scene in _scene_by_name(submission, _source(settings)).items():
        if scene in of_scene:
            of_scene[scene][name] = submission[name]
    return of_scene


def _scene_by_name(submission: Submitted, source: SceneSource) -> dict[str, str]:
    """Scene of each frame of a submission that the data set knows."""
    positions = {position_name(info.name, index): info.name for info in source.scenes() for index in range(info.frames)}
    return source.scenes_of(submission) | {name: positions[name] for name in submission if name in positions}


def _scenes_in(results: Path, source: SceneSource, every_frame: bool) -> set[str]:
    """Names of the scenes that results hold; ``every_frame``: all frames of a submission must be known."""
    if results.is_dir():
        files = {path.stem for path in results.glob("[!.]*.parquet")}  # A dot begins what is being written.
        scenes = {file_name(info.name): info.name for info in source.scenes()}
        names = {scenes.get(file, file) for file in files}
        if not names:
            raise UserError(
                f"The folder {results} holds no per-frame results (*.parquet); "
                "make them with 'predmapnet batch --save-frames'."
            )
        for name in sorted(names):
            others = [scene for scene in stored_scenes(results / f"{name}.parquet") if scene != name]
            if others:
                raise UserError(
                    f"{results / name}.parquet holds frames of {others[0]}, too; a file has one scene here."
                )
        return names
    if results.suffix.lower() == ".json":
        submission = _submission(results).frames
        scenes = _scene_by_name(submission, source)
        unknown = [name for name in submission if name not in scenes]
        foreign = any(looks_foreign(source.name, name) for name in unknown)
        if not scenes or (unknown and every_frame) or foreign:
            example = f", {unknown[0]} for one" if unknown else ""
            looks = frames_look_like(unknown)
            example += f"; by their names they are {looks}" if looks else ""
            hint = " Does it need --official-frames?" if source.name == "argoverse2" else ""
            raise UserError(
                f"{results}: {len(unknown)} of {len(submission)} frames are not in {source.name} in {source.root}"
                f"{example}. Name another data set, or a --split to measure only that.{hint}"
            )
        return set(scenes.values())
    if results.suffix.lower() != ".parquet":
        refuse_pickle(results)
        raise UserError(f"{results} holds no per-frame results: .parquet, .json or a folder is expected.")
    return set(stored_scenes(results))


def _submitted_maps(path: Path, submitted: Submitted, roi: RegionOfInterest, scene: Scene) -> list[FrameMap]:
    """Return a submission's predictions for each frame of a scene; a frame that it lacks has none."""
    maps = []
    for index in range(len(scene)):
        instant = scene.instant(index)
        names = {instant.token, str(instant.timestamp), position_name(scene.info.name, index)} & submitted.keys()
        if len(names) > 1:
            raise UserError(f"{path} holds frame {index} of {scene.info.name} as {' and as '.join(sorted(names))}.")
        found = submitted[names.pop()] if names else NOTHING
        maps.append(found.at(instant, roi))
    return maps


def _stored_maps(results: Path, scene: Scene, dataset: str) -> _Found:
    """Return the stored predictions for each frame of a scene; a frame that the file lacks has none."""
    name = scene.info.name
    path = results / f"{file_name(name)}.parquet" if results.is_dir() else results
    content = read_frames(path, name)
    stored = {frame.index: frame.frame_map for frame in content.frames}
    if len(stored) < len(content.frames):
        twice, _ = Counter(frame.index for frame in content.frames).most_common(1)[0]
        raise UserError(f"{path} holds frame {twice} of {name} twice.")
    if not stored:
        raise UserError(f"{path} holds no frame of {name}.")
    if max(stored) >= len(scene) or min(stored) < 0:
        raise UserError(f"{path} holds frame {max(stored)} of {name}, which has {len(scene)} frames in the data set.")
    made_of = content.provenance.get("dataset", dataset)
    if made_of != dataset:
        raise UserError(f"{path} was made of {made_of}, not of {dataset}; name that data set with --dataset.")
    regions = {frame_map.roi for frame_map in stored.values()}
    if len(regions) > 1:
        raise UserError(f"{path} mixes frames of {len(regions)} regions of interest; measure them apart.")
    roi = regions.pop()
    maps = [_at(path, name, index, scene.instant(index), stored.get(index), roi) for index in range(len(scene))]
    return _Found(maps, len(scene) - len(stored), content.provenance.get("weights_sha256"))


def _at(
    path: Path, scene: str, index: int, instant: Instant, stored: FrameMap | None, roi: RegionOfInterest
) -> FrameMap:
    if stored is None:
        return NOTHING.at(instant, roi)
    if not np.allclose(stored.ego_to_global, instant.ego_to_global, atol=1e-3):
        raise UserError(
            f"{path}, {scene}, frame {index}: the pose is not the data set's; the results were made from other data."
        )
    return stored


def _integrated(name: str, frame_maps: Sequence[FrameMap]) -> GlobalMap:
    """Fuse frames as mapping does, or as ``predmapnet integrate`` does where nothing is tracked."""
    if not any((frame_map.track_ids >= 0).any() for frame_map in frame_maps):
        frame_maps = with_own_ids(frame_maps)
    integrator = MapIntegrator(NETWORK_ERRORS)
    for frame_map in frame_maps:
        integrator.add(frame_map, log=name)
    return integrator.map()


def _with_truth(scene: Scene, frame_maps: Sequence[FrameMap], cache: Path | None) -> list[EvaluationFrame]:
    truths = scene.truths(frame_maps[0].roi, cache) if frame_maps else []
    if truths is None:
        raise UserError(
            f"{scene.info.name} has no ground truth, so nothing can be measured against it; it is looked for in "
            f"maps/expansion/{scene.info.location}.json of a nuScenes data set (the map expansion, unpacked there), "
            "in map/log_map_archive_*.json of an Argoverse 2 log, and in truth.json or truth.geojson of a log of "
            "one's own."
        )
    pairs = zip(frame_maps, truths, strict=True)
    return [EvaluationFrame(scene.info.name, index, found, truth) for index, (found, truth) in enumerate(pairs)]
