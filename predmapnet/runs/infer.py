"""Mapping one scene: source, Mapper, integrator, files and a report."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np
import rerun as rr
import torch

import predmapnet
from mapfusion.elements import ElementKind, GlobalMap, RegionOfInterest
from mapfusion.formats.by_suffix import write_map
from mapfusion.formats.local_plane import LocalPlane
from mapfusion.formats.reference_systems import FromDegrees
from mapfusion.georeference import LOCAL_FRAME, Georeference
from mapfusion.ground import observed_rings
from predmapnet.datasets.georeference import LocalFrame, local_frame
from predmapnet.demo_world.source import DEMO
from predmapnet.errors import UserError, value_errors_told
from predmapnet.evaluation.chamfer_ap import chamfer_average_precision, thresholds_for
from predmapnet.evaluation.frames import EvaluationFrame
from predmapnet.evaluation.global_map import THRESHOLDS, global_map_quality, seen_area
from predmapnet.frame_files.parquet import StoredFrame, write_frames
from predmapnet.machine import NetworkOptions
from predmapnet.mapper import Mapper
from predmapnet.mapping import MapSnapshot, Observer, SceneRun, Step, map_scene
from predmapnet.recording import APPLICATION, RecordingFile, SceneRecorder
from predmapnet.runs.gaps import with_gaps
from predmapnet.runs.guarded_truth import GuardedTruth
from predmapnet.runs.outputs import Outputs
from predmapnet.scenes import Progress, Scene, SceneSource
from predmapnet.sources import only_scene, open_source

FrameProgress = Callable[[int, int], None]
"""Called as ``progress(frames done, frames in all)``."""

SEED = 0
"""Of PyTorch's random numbers; the network draws none while it maps, so this only makes sure of it."""

SYNTHETIC_NOTE = (
    "This is a map of the synthetic demo world: its roads do not exist, and its coordinates lie where no real road is."
)

REAL_NOTE = (
    "The weights were trained on the synthetic demo world alone: on real photographs they show that everything runs, "
    "not how well PredMapNet maps."
)


UNTRAINED_NOTE = (
    "Parts of this network have not been trained yet ({parts}): until they are, its maps show that everything runs, "
    "and nothing else."
)


@dataclass(frozen=True)
class Accuracy:
    """Accuracy of a run against the ground truth: chamfer mAP of the frames, and figures of the global map.

    Precision and recall are length-weighted, at 1.0 m, inside the area that was seen.
    """

    mean_ap: float
    precision: float
    recall: float


@dataclass(frozen=True)
class SceneReport:
    """Report of a mapped scene, as shown in the table and written to summaries.

    Attributes:
        scene: its name.
        elements, metres: per kind, by label.
        frames: number of frames.
        seconds: wall time of mapping, without preparing.
        preparing_seconds: of opening the scene; the demo world renders its images then.
        frames_per_second: of mapping.
        milliseconds: mean per frame, by stage.
        rejections: of the integrator, counted by reason.
        accuracy: None without ground truth.
        written: the files.
        notes: for the user: a place that is not known, ground truth that cannot be used.
    """

    scene: str
    elements: Mapping[str, int]
    metres: Mapping[str, float]
    frames: int
    seconds: float
    preparing_seconds: float
    frames_per_second: float
    milliseconds: Mapping[str, float]
    rejections: Mapping[str, int]
    accuracy: Accuracy | None
    written: tuple[Path, ...] = field(default=())
    notes: tuple[str, ...] = ()


@dataclass(frozen=True)
class MappedScene:
    """Result of a pipeline: the run (map and frame maps without rasters) and the report of it."""

    run: SceneRun
    report: SceneReport


class MappingPipeline:
    """Maps scenes of one source with one network.

    Example:
        >>> pipeline = MappingPipeline.open()  # doctest: +SKIP
        >>> mapped = pipeline.run("scene-0103", Outputs(map=Path("map.geojson")))  # doctest: +SKIP
        >>> mapped.report.elements, len(mapped.run.global_map)  # doctest: +SKIP
        ({'ped_crossing': 12, 'divider': 31, 'boundary': 24}, 67)
    """

    def __init__(
        self,
        source: SceneSource,
        mapper: Mapper,
        sentence: str = "",
        allow_missing_cameras: bool = False,
        origin: LocalPlane | None = None,
    ) -> None:
        self.source = source
        self.mapper = mapper
        self.sentence = sentence
        self._allow_missing_cameras = allow_missing_cameras
        self._origin = origin

    @classmethod
    def open(
        cls,
        dataset: str | None = None,
        data_root: Path | None = None,
        network: NetworkOptions | None = None,
        allow_missing_cameras: bool = False,
        origin: LocalPlane | None = None,
        rate: float | None = None,
    ) -> MappingPipeline:
        """Choose the source and load the network; ``origin`` says where the logs' frame lies, if the user knows.

        ``rate``: see :func:`predmapnet.sources.open_source`.

        Raises:
            UserError: the data set or the weights are missing or broken.
        """
        source, sentence = open_source(dataset, data_root, rate=rate)
        return cls(source, Mapper.from_checkpoint(network), sentence, allow_missing_cameras, origin)

    def run(
        self,
        scene_name: str | None,
        outputs: Outputs,
        *,
        preparing: Progress | None = None,
        progress: FrameProgress | None = None,
        viewer: rr.RecordingStream | None = None,
        track: int | None = None,
    ) -> MappedScene:
        """Map one scene and write the outputs; each file appears whole or not at all.

        Args:
            scene_name: as the source calls it; None for the only scene that there is.
            outputs: files to write.
            preparing: called while the scene is prepared.
            progress: called after each frame.
            viewer: a Rerun stream to log into while mapping.
            track: id of the track whose memory recordings show; None picks a confident one.

        Raises:
            UserError: unknown scene, broken data, or a file that cannot be written.
        """
        outputs.check()
        scene_name = scene_name or only_scene(self.source)
        start = perf_counter()
        scene = GuardedTruth(self.source.open(scene_name, preparing))
        preparing_seconds = perf_counter() - start
        provenance = self.provenance(scene)
        torch.manual_seed(SEED)
        georeference, notes = self._place(scene)
        if outputs.crs is not None:
            _check_place(outputs.crs, georeference, scene)
        if isinstance(georeference, LocalFrame):
            provenance[LOCAL_FRAME] = georeference.frame
        with ExitStack() as files:
            recorders: list[SceneRecorder] = []
            place = None if self.source.synthetic or LOCAL_FRAME in provenance else georeference
            if viewer is not None:
                recorders.append(SceneRecorder(viewer, describe(provenance), True, place, track))
            if outputs.recording is not None:
                recording = rr.RecordingStream(APPLICATION, recording_id=f"{self.source.name}-{scene_name}")
                files.enter_context(RecordingFile(recording, outputs.recording))
                recorders.append(SceneRecorder(recording, describe(provenance), False, place, track))
            observers: list[Observer] = [*recorders]
            if progress is not None:
                observers.append(_ProgressObserver(progress))
            run = map_scene(scene, self.mapper, observers, self._allow_missing_cameras)
            provenance, gaps = with_gaps(provenance, run)
            for recorder in recorders if gaps else ():
                recorder.describe(describe(provenance))
            if outputs.map is not None:
                observed = observed_rings(run.observed, georeference)
                with value_errors_told():
                    told = {**provenance, "observed": observed}
                    write_map(run.global_map, outputs.map, georeference, told, outputs.crs)
            if outputs.frames is not None:
                pairs = zip(run.frames, run.frame_maps, strict=True)
                stored = (StoredFrame(frame.scene, frame.index, frame.token, mapped) for frame, mapped in pairs)
                write_frames(outputs.frames, stored, provenance)
        notes += gaps
        accuracy = scene.guarded(lambda: measure(scene, run, self.mapper.roi))
        if scene.problem:
            accuracy = None
            notes += (f"the map could not be compared with the ground truth: {scene.problem}",)
        return MappedScene(run, _report(scene, run, accuracy, preparing_seconds, outputs, notes))

    def _place(self, scene: Scene) -> tuple[Georeference, tuple[str, ...]]:
        """Return where a scene's frame lies, and a note if nobody knows. Raises UserError for a place that cannot be.

        A frame whose place is not known becomes a local one.
        """
        position = scene.instant(0).ego_to_global[:2, 3]
        georeference = self._origin or scene.georeference
        notes: tuple[str, ...] = ()
        if georeference is None:
            where = scene.info.location
            georeference = local_frame(where if where not in ("", "unknown") else scene.info.name, position)
            notes = (
                f"the place of {scene.info.name} on Earth is not known (location '{where}'): the map is in metres "
                "about longitude 0 and latitude 0. --origin latitude,longitude says where the frame of the poses lies",
            )
        with value_errors_told():
            georeference.to_wgs84(position[None])
        return georeference, notes

    def provenance(self, scene: Scene) -> dict[str, Any]:
        """Return the provenance of a scene's map, as written into it. It names no path of this machine."""
        provenance: dict[str, Any] = {
            "generator": "predmapnet",
            "version": predmapnet.__version__,
            "dataset": self.source.name,
            "scene": scene.info.name,
            "location": scene.info.location,
            "synthetic": self.source.synthetic,
            "configuration": self.mapper.config.model_dump(mode="json"),
            "weights_sha256": self.mapper.weights_sha256,
            "precision": self.mapper.precision.value,
            "compiled": self.mapper.compiled,
            "engine": str(self.mapper.engine.kind),
            "seed": SEED,
        }
        if self.note:
            provenance["note"] = self.note
        return provenance

    @property
    def note(self) -> str:
        """Caveats for readers of the map; empty if there are none."""
        return " ".join([SYNTHETIC_NOTE, self.warning] if self.source.synthetic else [self.warning]).strip()

    @property
    def warning(self) -> str:
        """Caveats about the weights, for the user of the command; empty if there are none."""
        warnings = []
        if not self.source.synthetic and self.mapper.facts.get("data") == DEMO:
            warnings.append(REAL_NOTE)
        if untrained := self.mapper.facts.get("untrained"):
            warnings.append(UNTRAINED_NOTE.format(parts=", ".join(untrained)))
        return " ".join(warnings)


class _ProgressObserver:
    """Observer that counts frames for a progress bar."""

    def __init__(self, progress: FrameProgress) -> None:
        self._progress = progress
        self._total = 0

    def begin(self, scene: Scene, roi: RegionOfInterest) -> None:
        self._total = len(scene)
        self._progress(0, self._total)

    def observe(self, step: Step, snapshot: MapSnapshot) -> None:
        self._progress(step.frame.index + 1, self._total)

    def end(self, global_map: GlobalMap) -> None:
        pass


def _check_place(crs: str, georeference: Georeference, scene: Scene) -> None:
    """Check before the work begins that a scene lies where a reference system holds. Raises UserError."""
    if isinstance(georeference, LocalFrame):
        raise UserError(f"--crs {crs}: the place of {scene.info.name} on Earth is not known; say it with --origin")
    with value_errors_told():
        FromDegrees(crs).positions(georeference.to_wgs84(scene.instant(0).ego_to_global[None, :2, 3]))


def measure(scene: Scene, run: SceneRun, roi: RegionOfInterest) -> Accuracy | None:
    """Compare a run with the ground truth of its scene; None where there is none."""
    truth_map = scene.truth_map(roi)
    if truth_map is None:
        return None
    frames = []
    for frame, frame_map in zip(run.frames, run.frame_maps, strict=True):
        truth = scene.truth(frame.index, roi)
        if truth is not None:
            frames.append(EvaluationFrame(frame.scene, frame.index, frame_map, truth))
    seen = seen_area([frame.ego_to_global for frame in run.frames], roi)
    quality = global_map_quality(run.global_map, truth_map, seen).overall
    at_one_metre = THRESHOLDS.index(1.0)
    # An empty map has no precision; it is reported as 0, since nothing in it is right.
    precision, recall = np.nan_to_num([quality.precision[at_one_metre], quality.recall[at_one_metre]])
    mean_precision = chamfer_average_precision(frames, thresholds_for(roi)).mean
    return Accuracy(mean_precision, float(precision), float(recall))


def describe(provenance: Mapping[str, Any]) -> str:
    """Return a description of a recording in Markdown, for whoever finds the file."""
    note = f"\n\n**Note.** {provenance['note']}" if "note" in provenance else ""
    return f"""# {provenance["scene"]} ({provenance["dataset"]}){note}

PredMapNet {provenance["version"]} looks through the cameras at one instant after the other and draws
pedestrian crossings (blue), lane dividers (orange) and road boundaries (green).

- bright: tracks of this instant; point at one for its id, score and age
- dashed: what was forecast for this instant one frame ago
- dark: the map as it grows; in *The whole map* the finished one, the darker the less confident
- grey: ground truth, in a tab beside *The whole map*; elsewhere switched on at `world/ground_truth` (panel at the left)

Weights {provenance["weights_sha256"][:12]}
"""


def _report(
    scene: Scene,
    run: SceneRun,
    accuracy: Accuracy | None,
    preparing_seconds: float,
    outputs: Outputs,
    notes: tuple[str, ...],
) -> SceneReport:
    return SceneReport(
        scene=scene.info.name,
        elements={kind.label: len(run.global_map.of_kind(kind)) for kind in ElementKind},
        metres={kind.label: run.global_map.length(kind) for kind in ElementKind},
        frames=len(run.frames),
        seconds=run.seconds,
        preparing_seconds=preparing_seconds,
        frames_per_second=run.frames_per_second,
        milliseconds=run.milliseconds,
        rejections=run.rejections,
        accuracy=accuracy,
        written=outputs.paths,
        notes=notes,
    )
