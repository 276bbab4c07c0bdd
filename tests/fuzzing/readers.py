"""Readers of files that users bring, each with small examples of what it reads."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np
import torch

from mapfusion import MapIntegrator, RegionOfInterest
from mapfusion.formats.by_suffix import SUFFIXES, read_map, read_maps, write_map
from mapfusion.formats.seal import edited_since_written
from predmapnet.datasets.argoverse2 import Argoverse2Source
from predmapnet.datasets.ground_truth.cache import cached_truths
from predmapnet.datasets.images import read_image
from predmapnet.datasets.lidar import read_argoverse2_sweep, read_nuscenes_sweep
from predmapnet.datasets.nuscenes import NuScenesSource
from predmapnet.datasets.own_logs.log_check import check_log
from predmapnet.datasets.own_logs.pose_files import read_timed_poses
from predmapnet.datasets.own_logs.source import LogSource
from predmapnet.errors import value_errors_told
from predmapnet.evaluation.comparison import compare_evaluations
from predmapnet.evaluation.frames import EvaluationFrame
from predmapnet.export.onnx_files import ABOUT, read_graph_folder
from predmapnet.frame_cache.scene_cache import CachedScene
from predmapnet.frame_files.parquet import StoredFrame, read_frames, stored_scenes, write_frames
from predmapnet.frame_files.pose_file import read_poses
from predmapnet.frame_files.submission import read_submission
from predmapnet.network.calibration import calibrate
from predmapnet.network.predmapnet import PredMapNet
from predmapnet.presets import load_config, preset
from predmapnet.runs.batch_records import outcomes_in, write_summary
from predmapnet.runs.fleet_report import folder_report
from predmapnet.runs.integrate import integrate_file
from predmapnet.runs.output_folder import OutputFolder
from predmapnet.runs.scene_choice import read_manifest
from predmapnet.scenes import FrameTruth, SceneSource
from predmapnet.training import run_checkpoint
from predmapnet.training.optimiser import make_optimiser
from predmapnet.training.settings import OptimiserSettings
from predmapnet.weights.checkpoint import load_checkpoint, save_checkpoint
from predmapnet.weights.fit import load_weights
from predmapnet.weights.imagenet_import import is_imagenet_backbone
from predmapnet.weights.inspection import inspect_file
from predmapnet.weights.maptracker_import import import_maptracker, read_official_checkpoint
from tests.fuzzing import examples
from tests.fuzzing.recordings import RECORDINGS
from tests.predmapnet.small_networks import Sections, small_config
from tests.predmapnet.training.painted_scenes import painted_scene, tiny_config

ROI = RegionOfInterest()
BESIDE = frozenset({"map_projector_info.yaml"})
"""What lies beside a Lanelet2 map."""


@dataclass(frozen=True)
class Reader:
    """Reader of one kind of files.

    Attributes:
        name: as the command knows it.
        write: writes examples into an empty folder, and returns the files to be changed.
        read: reads all that a command would read of a folder in which one file was changed.
        outputs: names of files that the reader writes.
    """

    name: str
    write: Callable[[Path], list[Path]]
    read: Callable[[Path, Path], object]
    outputs: frozenset[str] = field(default_factory=frozenset)

    def written(self, folder: Path) -> set[Path]:
        """Return the files that the reader may have written."""
        return {folder / name for name in self.outputs}


def _read_source(source: SceneSource) -> None:
    """Ask a source for all that mapping and measuring ask for."""
    for info in source.scenes():
        scene = source.open(info.name)
        assert info.frames >= 0 and len(scene) >= 0
        for index in range(len(scene)):
            frame = scene.frame(index)
            assert np.isfinite(frame.ego_to_global).all() and abs(frame.timestamp) < 2**63
            assert calibrate(frame.rig, preset("lite")).ego_to_image.isfinite().all()
            truth = scene.truth(index, ROI)
            if truth is not None:
                assert all(np.isfinite(line).all() for line in truth.polylines)
            if scene.georeference is not None:
                with value_errors_told():
                    assert np.isfinite(scene.georeference.to_wgs84(frame.ego_to_global[None, :2, 3])).all()
        scene.truth_map(ROI)
        source.scenes_of(["scene-0001-0", "log_1500000000000000000"])


def _read_own_log(folder: Path, changed: Path) -> None:
    check_log(folder / "logs" / "log", 2.0)
    source = LogSource(folder / "logs")
    source.open("log")
    _read_source(source)


def _read_poses(folder: Path, changed: Path) -> None:
    if changed.parent == folder:
        poses = read_poses(changed)
        assert all(np.isfinite(pose.ego_to_global).all() and abs(pose.timestamp) < 2**63 for pose in poses.values())
        return
    drive = read_timed_poses(changed.parent)
    assert np.isfinite(drive.at(int(drive.timestamps[0]) + 10)).all() and (np.diff(drive.timestamps) > 0).all()


def _write_images(folder: Path) -> list[Path]:
    image = np.random.default_rng(0).integers(0, 255, (24, 40, 3), dtype=np.uint8)
    names = ["a.jpg", "b.png", "progressive.jpg"]
    for name in names:
        cv2.imwrite(str(folder / name), image, [cv2.IMWRITE_JPEG_PROGRESSIVE, int(name.startswith("pro"))])
    return [folder / name for name in names]


def _read_image(folder: Path, changed: Path) -> None:
    image = read_image(changed)
    assert image.ndim == 3 and image.shape[2] == 3 and image.dtype == np.uint8


def _integrated(frames: Path, poses: Path | None) -> None:
    """Fuse frames as ``predmapnet integrate`` does, and write the map."""
    done = integrate_file(frames, poses)
    with value_errors_told():
        write_map(done.map, frames.parent / "map.geojson", examples.PLANE, done.provenance)


def _write_frames(folder: Path) -> list[Path]:
    frames = [StoredFrame("a", index, f"t{index}", found) for index, found in enumerate(examples.frame_maps())]
    write_frames(folder / "frames.parquet", frames, {"dataset": "demo", "synthetic": True})
    return [folder / "frames.parquet"]


def _read_frames(folder: Path, changed: Path) -> None:
    nothing = FrameTruth(np.zeros(0, np.int64), (), np.zeros(0, np.int64))
    for scene in stored_scenes(changed):
        for frame in read_frames(changed, scene).frames:
            EvaluationFrame(scene, frame.index, frame.frame_map, nothing)
    _integrated(changed, None)


def _read_results(folder: Path, changed: Path) -> None:
    if changed.name in ("streammapnet.json", "maptracker.json", "positions.json"):
        read_submission(changed)
    _integrated(changed, folder / "poses.json")


def _write_weights(folder: Path) -> list[Path]:
    off: Sections = {"enabled": False}
    config = small_config(
        "lite",
        bev={"backbone": {"stem": (4, 4), "widths": (4, 4, 4), "channels": 4}, "widths": (4, 4, 4), "memory": off},
        decoder={"width": 8, "heads": 2, "layers": 1, "point_width": 4, "queries": 4},
        semantic_queries=off,
        history_map={"memory": False, "guidance": False},
        future=off,
        revival=off,
    )
    save_checkpoint(folder / "weights.safetensors", PredMapNet(config), {"frames": 3})
    return [folder / "weights.safetensors"]


def _read_weights(folder: Path, changed: Path) -> None:
    inspect_file(changed).modules  # noqa: B018  it parses the configuration
    found = load_checkpoint(changed)
    assert all(value.isfinite().all() for value in found.network.state_dict().values())


def _write_foreign(folder: Path) -> list[Path]:
    torch.manual_seed(0)
    kernels = {"layer1.0.conv1.weight": torch.zeros(64, 64, 1, 1), "fc.bias": torch.zeros(3)}
    mmcv = {"meta": {"epoch": 3}, "state_dict": {"head.roi_size": torch.tensor([60.0, 30.0]), **kernels}}
    torch.save(kernels, folder / "resnet.pth")
    torch.save(mmcv, folder / "mmcv.pth")
    torch.save(mmcv, folder / "old.pth", _use_new_zipfile_serialization=False)
    return [folder / name for name in ("resnet.pth", "mmcv.pth", "old.pth")]


def _read_foreign(folder: Path, changed: Path) -> None:
    official = read_official_checkpoint(changed)
    if not is_imagenet_backbone(official):
        import_maptracker(official, small_config())


def _layers() -> torch.nn.Module:
    """Return layers in place of the network, of which checkpoints of a run know the tensors alone."""
    return torch.nn.Sequential(torch.nn.Linear(3, 2), torch.nn.BatchNorm1d(2))


def _write_run(folder: Path) -> list[Path]:
    position = run_checkpoint.Position("single", 3, [5, 9], 12, best={"single": 0.4}, finished=["single"])
    partial = run_checkpoint.partial_folder(folder, position)
    partial.mkdir()
    network = _layers()
    optimiser = make_optimiser(network, OptimiserSettings())
    for parameter in network.parameters():
        parameter.grad = torch.zeros_like(parameter)
    optimiser.step()
    tensors = run_checkpoint.with_prefix("network", network.state_dict())
    tensors |= run_checkpoint.with_prefix("optimiser", run_checkpoint.optimiser_tensors(optimiser))
    run_checkpoint.write_tensors(partial / "network.safetensors", tensors)
    run_checkpoint.write_tensors(partial / "rank-0.safetensors", run_checkpoint.random_states(torch.device("cpu")))
    return sorted(run_checkpoint.publish(partial, position).iterdir())


def _read_run(folder: Path, changed: Path) -> None:
    newest = run_checkpoint.to_resume(folder)
    position = run_checkpoint.read_position(newest)
    assert position.step >= 0 and position.seconds >= 0 and "single" in [*position.finished, *position.best, "single"]
    tensors = run_checkpoint.read_tensors(newest, "network")
    network = _layers()
    load_weights(network, run_checkpoint.below_prefix("network", tensors), newest)
    optimiser = make_optimiser(network, OptimiserSettings())
    own = run_checkpoint.read_tensors(newest, "rank-0")
    with run_checkpoint.misfit_told(newest):
        run_checkpoint.restore_optimiser(optimiser, run_checkpoint.below_prefix("optimiser", tensors))
        run_checkpoint.restore_random_states(own, torch.device("cpu"))


def _write_configurations(folder: Path) -> list[Path]:
    for name in ("lite", "paper-nuscenes"):
        (folder / f"{name}.json").write_text(small_config(name).to_json())
    (folder / ABOUT).write_text(
        json.dumps(
            {
                "format": 1,
                "configuration": small_config("lite").model_dump(mode="json"),
                "rows": 3,
                "sha256": "0",
                "facts": {},
            }
        )
    )
    return [folder / "lite.json", folder / "paper-nuscenes.json", folder / ABOUT]


def _read_configuration(folder: Path, changed: Path) -> None:
    if changed.name == ABOUT:
        read_graph_folder(folder)
        return
    with torch.device("meta"):
        PredMapNet(load_config(changed))


def _read_records(folder: Path, changed: Path) -> None:
    records = OutputFolder.named(str(folder))
    assert all(isinstance(outcome.scene, str) for outcome in outcomes_in(records))
    write_summary(records, {"a"})
    folder_report(records)


def _write_maps(suffix: str) -> Callable[[Path], list[Path]]:
    def write(folder: Path) -> list[Path]:
        path = folder / f"map{suffix}"
        write_map(examples.example_map(), path, examples.PLANE)
        return [path]

    return write


def _read_map(folder: Path, changed: Path) -> None:
    edited_since_written(changed)
    with value_errors_told():
        for found in (*read_maps([changed])[0], read_map(changed)):
            assert all(np.isfinite(element.points).all() for element in found)


def _write_caches(folder: Path) -> list[Path]:
    truth = FrameTruth(np.array([1]), (np.array(examples.LINE),), np.array([3]))
    cached_truths(folder, "key", lambda: [truth, truth])
    painted_scene(folder / "scene", 1, 0, tiny_config())
    integrator = MapIntegrator()
    for frame in examples.frame_maps():
        integrator.add(frame, log="a")
    integrator.save(folder / "state.npz")
    return sorted(folder.rglob("*.npz"))


def _read_caches(folder: Path, changed: Path) -> None:
    if changed.parent != folder:
        CachedScene(folder / "scene").frame(0)
    elif changed.name == "state.npz":
        with value_errors_told():
            MapIntegrator.load(changed)
    else:
        truth = FrameTruth(np.array([1]), (np.array(examples.LINE),), np.array([3]))
        cached_truths(folder, "key", lambda: [truth, truth])


def _sweep(folder: Path, changed: Path) -> None:
    points = read_argoverse2_sweep(changed) if changed.suffix == ".feather" else read_nuscenes_sweep(changed, np.eye(4))
    assert points.ndim == 2 and points.shape[1] == 3


READERS = {
    reader.name: reader
    for reader in (
        Reader("nuscenes", examples.write_nuscenes, lambda at, _: _read_source(NuScenesSource(at / "nuscenes"))),
        Reader("argoverse2", examples.write_argoverse2, lambda at, _: _read_source(Argoverse2Source(at / "logs"))),
        Reader("log", examples.write_log, _read_own_log),
        Reader("poses", examples.write_poses, _read_poses),
        Reader("sweeps", examples.write_sweeps, _sweep),
        Reader("images", _write_images, _read_image),
        Reader("frames", _write_frames, _read_frames, frozenset({"map.geojson"})),
        Reader("results", examples.write_results, _read_results, frozenset({"map.geojson"})),
        Reader("weights", _write_weights, _read_weights),
        Reader("foreign-weights", _write_foreign, _read_foreign),
        Reader("training-run", _write_run, _read_run),
        Reader("configuration", _write_configurations, _read_configuration),
        Reader("manifests", examples.write_manifests, lambda _, changed: [*map(str, read_manifest(changed))]),
        Reader("records", examples.write_records, _read_records, frozenset({"summary.json"})),
        Reader("evaluations", examples.write_evaluations,
               lambda at, _: compare_evaluations([at / "one.json", at / "two.json"])),
        Reader("caches", _write_caches, _read_caches),
        *(Reader(name, write, read) for name, (write, read) in RECORDINGS.items()),
        *(Reader(f"map{suffix}", _write_maps(suffix), _read_map, BESIDE) for suffix in SUFFIXES),
    )
}  # fmt: skip
