"""One-way assignment: truth names owners, scores choose tracks, detections keep all of the truth."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch

from mapfusion.elements import RegionOfInterest
from predmapnet.network.state import FrameOutputs, LayerPredictions
from predmapnet.scenes import FrameTruth
from predmapnet.training.data.targets import Targets, truth_targets
from predmapnet.training.losses.lite import LossWeights, frame_losses
from predmapnet.training.losses.matching import Assignment, MatchingCosts
from predmapnet.training.settings import StreamSettings
from predmapnet.training.track_truth import TrackTruth, choose_tracks, truth_of_tracks

ROI = RegionOfInterest()
SIZE = torch.tensor([60.0, 30.0])
CALM = StreamSettings(track_dropout=0.0, false_tracks=0, refresh=0.0)


def lines_at(*heights: float) -> Targets:
    lines = tuple(np.array([[-20.0, y], [20.0, y]]) for y in heights)
    count = len(heights)
    return truth_targets([FrameTruth(np.ones(count, np.int64), lines, np.arange(count) + 10)], ROI, 20, (10, 20))


def outputs_at(heights: list[float], scores: list[float]) -> FrameOutputs:
    """One frame whose rows are straight dividers with given scores."""
    points = torch.stack([lines_at(y).points[0] for y in heights])[None]
    logits = torch.full((1, len(heights), 3), -9.0)
    logits[0, :, 1] = torch.logit(torch.tensor(scores))
    rows = len(heights)
    return FrameOutputs(
        layers=[LayerPredictions(logits, points, None)],
        queries=torch.zeros(1, rows, 4),
        query_valid=torch.ones(1, rows, dtype=torch.bool),
        query_track_ids=torch.full((1, rows), -1),
        segmentation=torch.zeros(1, 3, 10, 20),
        bev=torch.zeros(1, 0, 10, 20),
        ego_to_global=torch.eye(4, dtype=torch.float64)[None],
    )


def owners_of(*element_ids: int) -> TrackTruth:
    ids = torch.tensor([element_ids])
    return TrackTruth(torch.where(ids >= 0, 1, -1), ids)


def test_a_track_answers_for_its_owner_even_if_another_truth_is_nearer() -> None:
    targets = lines_at(0.0, 5.0)
    outputs = outputs_at([4.9, 0.1], [0.9, 0.9])
    points = outputs.layers[-1].points
    assert points is not None
    pairs = truth_of_tracks(owners_of(10, 77), outputs.query_valid, points, targets, SIZE)
    assert (pairs.row.tolist(), pairs.truth.tolist()) == ([0], [0]), "row 1's element is gone: background"


def test_of_several_pieces_the_nearest_counts() -> None:
    targets = replace(lines_at(0.0, 5.0), element_ids=torch.tensor([10, 10]))
    outputs = outputs_at([4.0], [0.9])
    points = outputs.layers[-1].points
    assert points is not None
    assert truth_of_tracks(owners_of(10), outputs.query_valid, points, targets, SIZE).truth.tolist() == [1]


def test_detections_keep_the_truth_that_tracks_own() -> None:
    targets = lines_at(0.0, 5.0)
    outputs = outputs_at([0.0, 0.2, 5.2], [0.9, 0.5, 0.5])
    tracks = Assignment(torch.tensor([0]), torch.tensor([0]), torch.tensor([0]))
    found = frame_losses(outputs, targets, SIZE, LossWeights(), MatchingCosts(), tracks, track_rows=1)
    assert sorted(zip(found.assignment.row.tolist(), found.assignment.truth.tolist(), strict=True)) == [
        (0, 0), (1, 0), (2, 1),
    ]  # fmt: skip


def test_a_track_without_owner_is_pushed_towards_background() -> None:
    targets = lines_at(5.0)
    outputs = outputs_at([0.0, 5.0], [0.9, 0.9])
    logits = outputs.layers[-1].logits
    assert logits is not None
    logits.requires_grad_(True)
    nobody = Assignment(*torch.zeros((3, 0), dtype=torch.int64))
    found = frame_losses(outputs, targets, SIZE, LossWeights(), MatchingCosts(), nobody, track_rows=1)
    found.total.backward()
    assert logits.grad is not None
    assert logits.grad[0, 0, 1] > 0 > logits.grad[0, 1, 1]


def choose(heights: list[float], scores: list[float], owners: TrackTruth, targets: Targets, settings: StreamSettings):
    outputs = outputs_at(heights, scores)
    rows = owners.kinds.shape[1]
    points = outputs.layers[-1].points
    assert points is not None
    tracks = truth_of_tracks(owners, outputs.query_valid[:, :rows], points[:, :rows], targets, SIZE)
    found = frame_losses(outputs, targets, SIZE, LossWeights(), MatchingCosts(), tracks, rows)
    return choose_tracks(outputs, rows, owners, found.assignment, targets, settings, np.random.default_rng(0))


def test_scores_choose_and_truth_names_the_owner() -> None:
    targets = lines_at(0.0, 5.0, -5.0)
    # Rows: a good track, a weak track, a detection of the first's truth, a newborn, a weak newborn.
    chosen = choose([0, 5, 0.1, 5.1, -5], [0.8, 0.2, 0.9, 0.7, 0.1], owners_of(10, 11), targets, CALM)
    assert chosen.rows.tolist() == [[0, 3]]
    assert chosen.identity.tolist() == [[0, -1]]
    assert chosen.track_truth.element_ids.tolist() == [[10, 11]]


def test_a_better_detection_refreshes_its_track() -> None:
    always = replace(CALM, refresh=1.0)
    chosen = choose([0.0, 0.1], [0.6, 0.9], owners_of(10), lines_at(0.0), always)
    assert chosen.rows.tolist() == [[1]]
    assert chosen.identity.tolist() == [[0]]


def test_false_tracks_belong_to_nobody_and_stay_so() -> None:
    targets = lines_at(0.0)
    born = None
    for seed in range(5):
        outputs = outputs_at([0.0, 9.0], [0.9, 0.8])
        found = frame_losses(outputs, targets, SIZE, LossWeights(), MatchingCosts())
        settings = replace(CALM, false_tracks=1)
        born = choose_tracks(
            outputs, 0, TrackTruth.none(1), found.assignment, targets, settings, np.random.default_rng(seed)
        )
        if born.rows.shape[1] == 2:
            break
    assert born is not None
    assert born.track_truth.element_ids.tolist() == [[10, -1]]
    later = choose([0.0, 5.0], [0.9, 0.9], born.track_truth, lines_at(0.0, 5.0), CALM)
    assert later.track_truth.element_ids.tolist() == [[10, -1]]
