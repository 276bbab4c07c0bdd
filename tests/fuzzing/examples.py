"""Small examples of what users bring: data sets, logs, results, maps."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pyarrow as pa
from pyarrow import feather

from mapfusion import ElementKind, FrameMap, GlobalMap, MapElement, RegionOfInterest
from mapfusion.formats.local_plane import LocalPlane
from predmapnet.datasets.nuscenes import DEMO_MARKER
from predmapnet.evaluation.scene_figures import SCENE_FIGURES
from tests.cli.tiny_nuscenes import write_tiny_nuscenes
from tests.predmapnet.datasets.own_logs.drawn_log import START, bend, entry
from tests.predmapnet.datasets.own_logs.drawn_log import write_log as write_drawn_log
from tests.predmapnet.datasets.small_argoverse2 import write_log as write_argoverse2_log

PLANE = LocalPlane(8.4, 49.0)
LINE = [[-10.0, 1.0], [0.0, 1.0], [10.0, 1.0]]
RING = [[2.0, -5.0], [4.0, -5.0], [4.0, 5.0], [2.0, 5.0], [2.0, -5.0]]


def example_map() -> GlobalMap:
    """Return a map with all that an element may have."""
    elements = []
    for kind, points in (
        (ElementKind.DIVIDER, [[0, 0], [30, 0.5], [60, 0]]),
        (ElementKind.BOUNDARY, [[0, 20], [30, 20], [60, 20]]),
        (ElementKind.PED_CROSSING, [[20, 2], [24, 2], [24, 12], [20, 12], [20, 2]]),
    ):
        line = np.array(points, dtype=np.float64)
        sources, size = (("drive",), ((3,),)), len(line)
        elements.append(
            MapElement(kind, line, 0.97, 9, 5_000, 6_000, (3,), np.full(size, 0.1), *sources, np.full(size, 99.5))
        )
    observed = PLANE.to_wgs84(np.array([[-90.0, -90], [90, -90], [90, 90], [-90, -90]])).tolist()
    return GlobalMap(tuple(elements), {"scene": "scene-0103", "observed": [observed]})


def frame_maps(count: int = 3) -> list[FrameMap]:
    """Return the maps of the frames of a straight drive: a line and a crossing that are tracked."""
    lines = (np.array(LINE), np.array(RING))
    frames = []
    for index in range(count):
        pose = np.eye(4)
        pose[0, 3] = 2.0 * index
        arrays = np.array([1, 0]), np.array([0.9, 0.8]), np.array([4, 5])
        moved = tuple(line - [2.0 * index, 0.0] for line in lines)
        frames.append(
            FrameMap(START + 500_000_000 * index, pose, RegionOfInterest(), *arrays, moved, visible=(np.array(RING),))
        )
    return frames


def write_nuscenes(folder: Path) -> list[Path]:
    """Write a nuScenes data set of one scene, and the marker of a demo world beside it."""
    root = write_tiny_nuscenes(folder / "nuscenes", frames=2)
    (root / DEMO_MARKER).write_text(json.dumps({"town_seed": 7}))
    return [path for path in sorted(root.rglob("*.json")) if path.name != "map.json"]


def write_argoverse2(folder: Path) -> list[Path]:
    """Write an Argoverse 2 log."""
    root = write_argoverse2_log(folder / "logs" / "log", sweeps=5)
    for sweep in (root / "sensors" / "lidar").iterdir():
        sweep.unlink()
    times = [int(path.stem) - 20_000_000 for path in (root / "sensors" / "cameras" / "ring_front_center").iterdir()]
    (root / "lidar_timestamps_ns.json").write_text(json.dumps(sorted(times)))
    return [path for path in sorted(root.rglob("*")) if path.suffix in (".feather", ".json")]


def write_log(folder: Path) -> list[Path]:
    """Write a log of one's own with three kinds of lenses, its truth and its place."""
    cameras = {
        "front": entry(0.0, 64, 40, 40.0),
        "left": entry(90.0, 64, 40, 40.0, distortion=[-0.1, 0.01, 0.0, 0.0]),
        "fish": entry(180.0, 64, 40, 20.0, model="fisheye", distortion=[0.05, -0.01, 0.0, 0.0]),
    }
    root = write_drawn_log(folder / "logs" / "log", cameras, bend(3, period=0.5))
    (root / "georeference.json").write_text(json.dumps({"latitude": 49.0, "longitude": 8.4}))
    elements = [{"kind": "divider", "points": LINE}, {"kind": "ped_crossing", "points": RING}]
    (root / "truth.json").write_text(json.dumps({"elements": elements}))
    return [root / name for name in ("calibration.json", "georeference.json", "truth.json", "poses.csv")]


def write_poses(folder: Path) -> list[Path]:
    """Write poses of every layout, each in a folder of its own, and results to place by them."""
    rows = [(START + 500_000_000 * index, 2.0 * index) for index in range(4)]
    kitti = "\n".join(f"1 0 0 {x} 0 1 0 0 0 0 1 0" for _, x in rows)
    layouts = {
        "csv": {"poses.csv": "timestamp_ns,x,y,z,qw,qx,qy,qz\n" + "\n".join(f"{t},{x},0,0,1,0,0,0" for t, x in rows)},
        "yaw": {"poses.csv": "timestamp_s,x,y,yaw\n" + "\n".join(f"{t / 1e9:.3f},{x},0,0.0" for t, x in rows)},
        "tum": {"poses.txt": "# time\n" + "\n".join(f"{t / 1e9:.6f} {x} 0 0 0 0 0 1" for t, x in rows)},
        "kitti": {"poses.txt": kitti, "times.txt": "\n".join(f"{t / 1e9:.6f}" for t, _ in rows)},
    }
    for layout, files in layouts.items():
        (folder / layout).mkdir()
        for name, text in files.items():
            (folder / layout / name).write_text(text + "\n")
    quaternion = [{"token": f"t{i}", "timestamp": t, "translation": [x, 0, 0], "rotation": [1, 0, 0, 0]}
                  for i, (t, x) in enumerate(rows)]  # fmt: skip
    placed = [[[1, 0, 0, x], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]] for _, x in rows]
    matrix = {f"t{i}": {"timestamp_us": rows[i][0] // 1000, "scene": "a", "ego_to_global": placed[i]} for i in range(4)}
    (folder / "list.json").write_text(json.dumps(quaternion))
    (folder / "matrices.json").write_text(json.dumps(matrix))
    table = "token,timestamp,x,y,yaw,scene\n" + "\n".join(f"t{i},{t},{x},0,0,a" for i, (t, x) in enumerate(rows))
    (folder / "frames.csv").write_text(table + "\n")
    return [path for path in sorted(folder.rglob("*")) if path.is_file()]


def write_results(folder: Path) -> list[Path]:
    """Write results of every kind of detector, and the poses of their frames."""
    vectors = [{"pts": LINE, "pts_num": 3, "cls_name": "divider", "type": 0, "confidence_level": 0.9},
               {"pts": RING[:4], "pts_num": 4, "cls_name": "ped_crossing", "type": 1, "confidence_level": "0.8"},
               {"pts": LINE, "cls_name": "centerline", "type": 3, "confidence_level": 0.8}]  # fmt: skip
    lists = {"vectors": [LINE, RING], "scores": [0.9, 0.8], "labels": [1, 0]}
    tokens = [f"t{index}" for index in range(3)]
    contents = {
        "maptr.json": {"meta": {}, "results": [{"sample_token": token, "vectors": vectors} for token in tokens]},
        "superfusion.json": {"results": {token: vectors for token in tokens}},
        "streammapnet.json": {"meta": {}, "results": {token: lists for token in tokens}},
        "maptracker.json": {"results": {token: {**lists, "global_ids": [3, 4], "visible": [RING]} for token in tokens}},
        "positions.json": [{"scene_name": "a", "local_idx": i, **lists, "global_ids": [3, 4]} for i in range(3)],
    }
    for name, content in contents.items():
        (folder / name).write_text(json.dumps(content))
    poses = [
        {"token": token, "scene": "a", "timestamp": START + 500_000_000 * index, "translation": [2.0 * index, 0, 0],
         "rotation": [1, 0, 0, 0]} for index, token in enumerate(tokens)
    ]  # fmt: skip
    (folder / "poses.json").write_text(json.dumps(poses))
    return [folder / name for name in contents]


def write_evaluations(folder: Path) -> list[Path]:
    """Write two evaluations of the same scenes."""
    facts = {"version": "0.1.0", "dataset": "demo", "split": "test", "split_scheme": "old", "official_frames": False,
             "roi_m": [60.0, 30.0], "warnings": ["a note"]}  # fmt: skip
    scene = {"frames": 40, **dict.fromkeys(SCENE_FIGURES, 0.4)}
    content = {"evaluated": facts, "chamfer_ap": {"mAP": 0.5}, "stability": {"protocol": "a", "interval": 2},
               "consistency_ap": {"ids": "own"}, "per_scene": {f"scene-{row}": scene for row in range(3)}}  # fmt: skip
    for name in ("one.json", "two.json"):
        (folder / name).write_text(json.dumps(content))
    return [folder / "one.json", folder / "two.json"]


def write_records(folder: Path) -> list[Path]:
    """Write the records of a batch: a scene that was mapped, and one that failed."""
    report = {"scene": "a", "frames": 4, "seconds": 2.0, "frames_per_second": 2.0, "preparing_seconds": 0.0,
              "elements": {"divider": 1, "boundary": 0, "ped_crossing": 0},
              "metres": {"divider": 9.0, "boundary": 0.0, "ped_crossing": 0.0}, "notes": ["a note"],
              "rejections": {"a reason": 2}, "written": ["a.geojson"],
              "accuracy": {"mean_ap": 0.4, "precision": 0.5, "recall": 0.6}}  # fmt: skip
    done = {"scene": "a", "settings": "f", "seconds": 3.0, "report": report}
    failed = {"scene": "b", "status": "failed", "seconds": 1.0, "report": None, "error": "UserError", "reason": "no",
              "trace": None, "time": "2026-01-01"}  # fmt: skip
    (folder / "a.summary.json").write_text(json.dumps(done))
    (folder / "b.failed.json").write_text(json.dumps(failed))
    return [folder / "a.summary.json", folder / "b.failed.json"]


def write_manifests(folder: Path) -> list[Path]:
    """Write a manifest of a batch in both formats."""
    table = pa.table({"scene": ["a", "b"], "folder": ["monday", "tuesday"]})
    pa.parquet.write_table(table, folder / "scenes.parquet")
    (folder / "scenes.csv").write_text("scene,folder\na,monday\nb,tuesday\n")
    return [folder / "scenes.parquet", folder / "scenes.csv"]


def write_sweeps(folder: Path) -> list[Path]:
    """Write a lidar sweep of each data set."""
    points = np.arange(30, dtype=np.float32)
    feather.write_feather(pa.table({axis: points[:6].astype(np.float16) for axis in "xyz"}), folder / "sweep.feather")
    points.tofile(folder / "sweep.bin")
    return [folder / "sweep.feather", folder / "sweep.bin"]
