"""Reads a folder of metric fixtures: predictions, truths and poses as evaluation frames, and the official figures."""

import json
import os
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from mapfusion.elements import FrameMap, RegionOfInterest
from predmapnet.evaluation.frames import EvaluationFrame
from predmapnet.scenes import FrameTruth

PROJECT = Path(__file__).parents[3]
BUNDLED = PROJECT / "tests" / "data" / "metrics"
REFERENCE = Path(os.environ.get("PREDMAPNET_REFERENCE", PROJECT.parent / "shared" / "reference" / "public")) / "metrics"


@dataclass(frozen=True)
class MetricCase:
    """All frames of one folder, and which row of the fixture each element of a frame came from."""

    folder: Path
    frames: list[EvaluationFrame]
    predicted_rows: list[np.ndarray]
    truth_rows: list[np.ndarray]
    inputs: dict[str, Any]
    expected: dict[str, Any]
    intermediates: dict[str, Any]

    def subset(self, name: str) -> list[int]:
        return [row for row, frame in enumerate(self.frames) if name in ("all", frame.scene)]

    def with_ids(self, ids: np.ndarray) -> list[EvaluationFrame]:
        """The frames with other track ids, one per row of the fixture's predictions."""
        return [
            replace(frame, predicted=replace(frame.predicted, track_ids=ids[rows].astype(np.int64)))
            for frame, rows in zip(self.frames, self.predicted_rows, strict=True)
        ]


def load_metric_case(folder: Path) -> MetricCase:
    inputs = dict(np.load(folder / "inputs.npz", allow_pickle=False))
    predictions = np.split(inputs["pred_points"], inputs["pred_offsets"][1:-1])
    truths = np.split(inputs["gt_raw_points"], inputs["gt_raw_offsets"][1:-1])
    frames, predicted_rows, truth_rows = [], [], []
    for index, scene in enumerate(inputs["frame_scene"]):
        pred = np.flatnonzero(inputs["pred_frame"] == index)
        gt = np.flatnonzero(inputs["gt_frame"] == index)
        pose = np.eye(4)
        pose[:3, :3] = inputs["ego2global_rotation"][index]
        pose[:3, 3] = inputs["ego2global_translation"][index]
        predicted = FrameMap(
            timestamp=index * 500_000_000,
            ego_to_global=pose,
            roi=RegionOfInterest(60.0, 30.0),
            kinds=inputs["pred_label"][pred].astype(np.int64),
            scores=inputs["pred_score"][pred],
            track_ids=inputs["pred_own_id"][pred].astype(np.int64),
            polylines=tuple(predictions[row] for row in pred),
        )
        truth = FrameTruth(
            kinds=inputs["gt_label"][gt].astype(np.int64),
            polylines=tuple(truths[row] for row in gt),
            element_ids=inputs["gt_world_id"][gt].astype(np.int64),
        )
        name = str(inputs["scene_names"][scene])
        frames.append(EvaluationFrame(name, int(inputs["frame_local_idx"][index]), predicted, truth))
        predicted_rows.append(pred)
        truth_rows.append(gt)
    return MetricCase(
        folder,
        frames,
        predicted_rows,
        truth_rows,
        inputs,
        json.loads((folder / "expected.json").read_text()),
        dict(np.load(folder / "expected_intermediates.npz", allow_pickle=False)),
    )
