"""Track ids of true elements against the ids that the official consistency metric formed."""

import os
from pathlib import Path

import numpy as np
import pytest

from mapfusion.elements import RegionOfInterest
from predmapnet.datasets.ground_truth.raster import mask_iou
from predmapnet.datasets.ground_truth.tracks import TrackFrame, official_track_ids

PROJECT = Path(__file__).resolve().parents[3]
METRICS = Path(os.environ.get("PREDMAPNET_REFERENCE", PROJECT.parent / "shared" / "reference" / "public")) / "metrics"
ROI = RegionOfInterest()


@pytest.mark.reference
def test_official_ids_of_every_scene():
    if not (METRICS / "inputs.npz").is_file():
        pytest.skip(f"no metric fixtures in {METRICS}: set PREDMAPNET_REFERENCE")
    inputs = np.load(METRICS / "inputs.npz")
    expected = np.load(METRICS / "expected_intermediates.npz")
    for scene in range(len(inputs["scene_names"])):
        frames, rows = [], []
        for frame in np.flatnonzero(inputs["frame_scene"] == scene):
            here = np.flatnonzero(inputs["gt_frame"] == frame)
            pose = np.eye(4)
            pose[:3, :3] = inputs["ego2global_rotation"][frame]
            pose[:3, 3] = inputs["ego2global_translation"][frame]
            kinds = inputs["gt_label"][here].astype(np.int64)
            frames.append(TrackFrame(kinds, expected["gt_match20_normalised"][here], pose))
            rows.append(here)
        ids = official_track_ids(frames, ROI)
        np.testing.assert_array_equal(np.concatenate(ids), expected["gt_track_id"][np.concatenate(rows)])


def line(y):
    """A straight divider along x at one y, normalised."""
    return np.stack([np.linspace(0.2, 0.8, 20), np.full(20, (y + 15) / 30)], axis=1)


def test_an_element_keeps_its_id_through_the_ego_motion_and_a_new_one_gets_the_next():
    moved = np.eye(4)
    moved[1, 3] = 2.0
    frames = [
        TrackFrame(np.array([1]), np.array([line(3.0)]), np.eye(4)),
        TrackFrame(np.array([1, 1]), np.array([line(8.0), line(1.0)]), moved),
        TrackFrame(np.array([2]), np.array([line(1.0)]), moved),
        TrackFrame(np.array([1]), np.array([line(1.0)]), moved),
    ]
    ids = [rows.tolist() for rows in official_track_ids(frames, ROI)]
    assert ids == [[0], [1, 0], [0], [2]]


def test_iou_counts_pixels():
    first = np.array([[1, 1, 0, 0], [0, 0, 0, 0]], dtype=np.uint8)
    second = np.array([[0, 1, 1, 0], [0, 0, 0, 0]], dtype=np.uint8)
    np.testing.assert_allclose(mask_iou(first, second), [[1 / 3, 0], [0, 0]])
