"""Accuracy on bad days, as a share of that on good ones: ``python -m tests.benchmarks.bad_days [--json FILE]``.

Maps the test towns of the demo world once as they are, and then with one fault at a time, in up to three severities:
images (exposure, low light, fog, rain, motion blur, noise, colour, dirt), cameras and images and frames that are lost,
calibration, poses and clocks that are off, and other frame rates. Prints for each fault mAP, C-mAP and F1 of the global
map at 1.0 m, and the share of the clean figures that remains.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import orjson

from predmapnet.datasets.nuscenes import NuScenesSource
from predmapnet.datasets.own_logs.timed_poses import TimedPoses
from predmapnet.demo_world.catalogue import WORLD_VERSION, build_world, default_cache
from predmapnet.demo_world.nuscenes.writer import write_scene
from predmapnet.demo_world.source import DemoSource
from predmapnet.demo_world.world import Trajectory
from predmapnet.errors import UserError
from predmapnet.evaluation.frames import EvaluationFrame
from predmapnet.evaluation.global_map import THRESHOLDS
from predmapnet.evaluation.measurement import SceneMeasurement, measure_scene, pool_scenes
from predmapnet.files import check_output, write_file
from predmapnet.machine import NetworkOptions
from predmapnet.mapper import Mapper
from predmapnet.mapping import map_scene
from predmapnet.scenes import Scene
from tests.real_roads.bad_scenes import (
    FaultyImages,
    LostCameras,
    LostImages,
    ShiftedPoses,
    jumping_poses,
    late_cameras,
    lost_frames,
    noisy_poses,
    off_calibration,
)
from tests.real_roads.image_faults import IMAGE_FAULTS
from tests.real_roads.scene_views import every

CLEAN = "clean"
SPLIT = "test"
SEED = 0


@dataclass(frozen=True)
class Condition:
    """One line of the table.

    Attributes:
        family: kind of fault; each counts the same in the means.
        name: as printed.
        severity: 0 for the clean scenes, then 1 to 3.
        apply: makes the bad scene from the clean one; a folder is given for images.
    """

    family: str
    name: str
    severity: int
    apply: Callable[[Scene, Path], Scene]


@dataclass(frozen=True)
class Remains:
    """Figures of one condition over all scenes."""

    mean_ap: float
    consistent_ap: float
    f1: float
    frames: int

    def shares(self, clean: Remains) -> tuple[float, float, float]:
        """Return what share of each clean figure remains."""
        mine, whole = (np.array([one.mean_ap, one.consistent_ap, one.f1]) for one in (self, clean))
        first, second, third = np.divide(mine, whole, out=np.full(3, np.nan), where=whole > 0).tolist()
        return first, second, third


def conditions(cameras: Sequence[str], cache: Path) -> Iterator[Condition]:
    """Yield all conditions for cars with these cameras, the clean one first."""
    yield Condition(CLEAN, CLEAN, 0, lambda scene, _: scene)
    for family, fault in IMAGE_FAULTS.items():
        for severity in (1, 2, 3):
            apply = partial(_faulty, fault=fault, severity=severity)
            yield Condition(family, f"{family} {severity}", severity, apply)
    for camera in cameras:
        yield Condition("camera lost", f"without {camera}", 1, partial(_told, change=LostCameras, value=(camera,)))
    graded: list[tuple[str, str, Callable[..., Scene], tuple[float, ...]]] = [
        ("images lost", "{:.0%} of the images lost", LostImages, (0.1, 0.3, 0.5)),
        ("frames lost", "{:.0%} of the frames lost", lost_frames, (0.1, 0.3, 0.5)),
        ("calibration off", "calibration off by {} degrees", off_calibration, (0.5, 1.0, 2.0)),
        ("poses off", "poses off by {} m", noisy_poses, (0.1, 0.3, 1.0)),
        ("poses jump", "poses jump by {} m", jumping_poses, (0.3, 1.0, 3.0)),
        ("cameras late", "cameras late by {} s", late_cameras, (0.05, 0.1)),
    ]
    for family, words, change, values in graded:
        for severity, value in enumerate(values, start=1):
            yield Condition(family, words.format(value), severity, partial(_told, change=change, value=value))
    yield Condition("frame rate", "1 Hz", 1, lambda scene, _: every(scene, 2))
    yield Condition("frame rate", "5 Hz", 1, lambda scene, _: at_five_hertz(scene.info.name, cache))


def _faulty(scene: Scene, folder: Path, fault: Any, severity: int) -> Scene:
    return FaultyImages(scene, fault, severity, folder, SEED)


def _told(scene: Scene, folder: Path, change: Callable[[Scene, Any], Scene], value: object) -> Scene:
    return change(scene, value)


def at_five_hertz(name: str, cache: Path) -> Scene:
    """Return a town's scene with 5 frames a second instead of 2, drawn into the cache when it is not there."""
    folder = cache / f"five-hertz-v{WORLD_VERSION}" / name
    if not folder.is_dir():
        world = build_world(name)
        stamps = world.trajectory.timestamps
        poses = TimedPoses(stamps, world.trajectory.ego_to_global)
        dense = np.arange(stamps[0], stamps[-1] + 1, 200_000_000, dtype=np.int64)
        trajectory = Trajectory(dense, np.array([poses.at(int(stamp)) for stamp in dense]))
        write_scene(replace(world, trajectory=trajectory), folder, WORLD_VERSION, progress=_tell)
    return NuScenesSource(folder).open(name)


def measured(scene: Scene, mapper: Mapper) -> SceneMeasurement:
    """Map a bad scene, and measure it against what is true: frames in their own ego frame, the map where it belongs."""
    run = map_scene(scene, mapper, allow_missing_cameras=True)
    true_poses = scene.scene if isinstance(scene, ShiftedPoses) else scene
    truths = scene.truths(mapper.roi)
    assert truths is not None, "towns have a truth"
    frames = [
        EvaluationFrame(
            scene.info.name, index, replace(found, ego_to_global=true_poses.instant(index).ego_to_global), truth
        )
        for index, (found, truth) in enumerate(zip(run.frame_maps, truths, strict=True))
    ]
    return measure_scene(frames, run.global_map, scene.truth_map(), run.seconds)


def remains(measurements: Sequence[SceneMeasurement]) -> Remains:
    """Return the figures of all scenes together."""
    pooled = pool_scenes(measurements)
    assert pooled.global_map is not None
    f1 = float(np.nan_to_num(pooled.global_map.overall.f1[THRESHOLDS.index(1.0)]))
    consistency = pooled.consistency if pooled.has_tracks else pooled.formed_consistency
    return Remains(pooled.chamfer.mean, consistency.mean, f1, len(pooled.frames))


def run(
    scenes: Sequence[Scene], chosen: Sequence[Condition], mapper: Mapper, say: Callable[[str], None]
) -> dict[str, Any]:
    """Measure condition after condition, say each line, and return everything for a file."""
    rows: list[tuple[Condition, Remains]] = []
    say(f"{'':34}{'mAP':>7}{'C-mAP':>7}{'F1':>7}   remains:{'mAP':>6}{'C-mAP':>7}{'F1':>7}{'frames':>8}")
    with tempfile.TemporaryDirectory() as folder:
        for condition in chosen:
            found = []
            for number, scene in enumerate(scenes, start=1):
                _tell(number, len(scenes), condition.name)
                found.append(measured(condition.apply(scene, Path(folder)), mapper))
            rows.append((condition, remains(found)))
            say(_line(*rows[-1], rows[0][1]))
    means = mean_shares(rows)
    for name, shares in means.items():
        say(f"{name:34}{'':33}" + "".join(f"{share:>7.2f}" for share in shares))
    return {
        "weights_sha256": mapper.weights_sha256,
        "world_version": WORLD_VERSION,
        "scenes": [scene.info.name for scene in scenes],
        "seed": SEED,
        "rows": [
            {"family": condition.family, "name": condition.name, "severity": condition.severity}
            | asdict(figures)
            | {"remains": dict(zip(("mean_ap", "consistent_ap", "f1"), figures.shares(rows[0][1]), strict=True))}
            for condition, figures in rows
        ],
        "means": means,
    }


def mean_shares(rows: Sequence[tuple[Condition, Remains]]) -> dict[str, tuple[float, ...]]:
    """Return the mean shares that remain, by name: first severity and all; each family of faults counts the same."""
    clean = rows[0][1]
    means = {}
    for name, severities in (("mean at the first severity", (1,)), ("mean over all", (1, 2, 3))):
        families: dict[str, list[tuple[float, float, float]]] = {}
        for condition, figures in rows[1:]:
            if condition.severity in severities:
                families.setdefault(condition.family, []).append(figures.shares(clean))
        if families:
            means[name] = tuple(np.mean([np.mean(shares, axis=0) for shares in families.values()], axis=0).tolist())
    return means


def _line(condition: Condition, figures: Remains, clean: Remains) -> str:
    own = f"{condition.name:34}{figures.mean_ap:7.3f}{figures.consistent_ap:7.3f}{figures.f1:7.3f}"
    return own + f"{'':9}" + "".join(f"{share:7.2f}" for share in figures.shares(clean)) + f"{figures.frames:8d}"


def _tell(done: int, total: int, what: str) -> None:
    print(f"\r{what}: {done} of {total}   ", end="\r", file=sys.stderr, flush=True)


def open_scenes(wanted: Sequence[str]) -> list[Scene]:
    """Open the first so many test towns, or those that are named. Raises UserError for a name that does not exist."""
    source = DemoSource()
    names = [info.name for info in source.scenes(SPLIT)]
    if len(wanted) == 1 and wanted[0].isdigit():
        names = names[: int(wanted[0])]
    elif wanted:
        names = list(wanted)
    return [source.open(name, _tell) for name in names]


def main(arguments: list[str] | None = None) -> int:
    """Print the table; write it if asked for."""
    parser = argparse.ArgumentParser(prog="python -m tests.benchmarks.bad_days", description=__doc__.splitlines()[0])
    parser.add_argument("--json", type=Path, help="write all figures to this file, too")
    parser.add_argument("--weights", type=Path, help="a .safetensors checkpoint; the shipped weights without it")
    parser.add_argument(
        "--scenes", nargs="+", default=[], metavar="N", help="the first N test towns, or names of towns"
    )
    parser.add_argument(
        "--only", nargs="+", default=[], metavar="NAME", help="only lines whose name holds one of these"
    )
    options = parser.parse_args(arguments)
    try:
        if options.json:
            check_output(options.json)
        scenes = open_scenes(options.scenes)
        if not scenes:
            raise UserError("There is no town to map: --scenes takes a number from 1, or names of towns.")
        found = list(conditions([camera.name for camera in scenes[0].rig], default_cache()))
        words = options.only
        chosen = found[:1] + [one for one in found[1:] if not words or any(word in one.name for word in words)]
        if len(chosen) == 1 and words and CLEAN not in words:
            names = "; ".join(condition.name for condition in found)
            raise UserError(f"No line's name holds {' or '.join(words)}. There are: {names}.")
        result = run(
            scenes,
            chosen,
            Mapper.from_checkpoint(NetworkOptions(weights=options.weights)),
            lambda line: print(line, flush=True),
        )
        if options.json:
            with write_file(options.json) as draft:
                draft.write_bytes(orjson.dumps(result, option=orjson.OPT_INDENT_2))
    except UserError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
