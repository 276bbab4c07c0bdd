"""One-way assignment: truth names owners, scores choose tracks, detections keep all of the truth."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch

from mapfusion.elements import RegionOfInterest
from predmapnet.network.state import FrameOutputs, LayerPredictions
from predmapnet.scenes import FrameTruth
from predmapnet.training.data.targets import Targets, truth_targets
from predmapnet.training.losses.frame import LossSums, add_layers
from predmapnet.training.losses.matching import Matched, Truth, match
from predmapnet.training.losses.weights import LITE_LOSSES
from predmapnet.training.settings import TrackRules
from predmapnet.training.track_truth import Chosen, TrackTruth, choose_tracks

ROI = RegionOfInterest()
SIZE = torch.tensor([60.0, 30.0])
CALM = TrackRules(score=0.3, false_tracks=0)


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
    ids = np.array([element_ids])
    return TrackTruth(np.where(ids >= 0, 1, -1), ids)


def matched(
    outputs: FrameOutputs, targets: Targets, owners: TrackTruth, exclusive: bool = False
) -> tuple[Matched, Truth]:
    truth = Truth(targets, torch.device("cpu"), SIZE)
    return match(outputs, truth, owners, LITE_LOSSES, exclusive), truth


def pairs(
    outputs: FrameOutputs, targets: Targets, owners: TrackTruth, exclusive: bool = False
) -> list[tuple[int, int]]:
    found = matched(outputs, targets, owners, exclusive)[0].layers[-1]
    return list(zip(found.row.tolist(), found.truth.tolist(), strict=True))


def test_a_track_answers_for_its_owner_even_if_another_truth_is_nearer() -> None:
    found = pairs(outputs_at([4.9, 0.1], [0.9, 0.9]), lines_at(0.0, 5.0), owners_of(10, 77))
    assert found == [(0, 0)], "row 1's element is gone: background"


def test_of_several_pieces_the_nearest_counts() -> None:
    targets = replace(lines_at(0.0, 5.0), element_ids=torch.tensor([10, 10]))
    assert pairs(outputs_at([4.0], [0.9]), targets, owners_of(10)) == [(0, 1)]


def test_detections_keep_the_truth_that_tracks_own_unless_tracks_suppress_them() -> None:
    outputs, targets = outputs_at([0.0, 0.2, 5.2], [0.9, 0.5, 0.5]), lines_at(0.0, 5.0)
    assert pairs(outputs, targets, owners_of(10)) == [(0, 0), (1, 0), (2, 1)]
    assert pairs(outputs, targets, owners_of(10), exclusive=True) == [(0, 0), (2, 1)]


def test_two_tracks_of_one_piece_both_answer_for_it_unless_that_is_exclusive() -> None:
    outputs, targets = outputs_at([0.0, 0.2], [0.9, 0.5]), lines_at(0.0)
    assert pairs(outputs, targets, owners_of(10, 10)) == [(0, 0), (1, 0)]
    assert pairs(outputs, targets, owners_of(10, 10), exclusive=True) == [(0, 0)]


def test_a_track_without_owner_is_pushed_towards_background() -> None:
    targets = lines_at(5.0)
    outputs = outputs_at([0.0, 5.0], [0.9, 0.9])
    logits = outputs.layers[-1].logits
    assert logits is not None
    logits.requires_grad_(True)
    found, truth = matched(outputs, targets, owners_of(77))
    sums = LossSums()
    add_layers(sums, outputs, truth, found, 1, LITE_LOSSES)
    sums.means(lambda counts: counts)["focal"].backward()
    assert logits.grad is not None
    assert logits.grad[0, 0, 1] > 0 > logits.grad[0, 1, 1]


def choose(
    heights: list[float],
    scores: list[float],
    owners: TrackTruth,
    targets: Targets,
    rules: TrackRules = CALM,
    seed: int = 0,
) -> Chosen:
    found, truth = matched(outputs_at(heights, scores), targets, owners)
    draws = [np.random.default_rng(seed)]
    return choose_tracks(found.scores, found.valid, found.truth, owners, truth.kinds, truth.element_ids, rules, draws)


def test_scores_choose_and_truth_names_the_owner() -> None:
    targets = lines_at(0.0, 5.0, -5.0)
    # Rows: a good track, a weak track, a detection of the first's truth, a newborn, a weak newborn.
    chosen = choose([0, 5, 0.1, 5.1, -5], [0.8, 0.2, 0.9, 0.7, 0.1], owners_of(10, 11), targets)
    assert chosen.rows.tolist() == [[0, 3]]
    assert chosen.identity.tolist() == [[0, -1]]
    assert chosen.owners.element_ids.tolist() == [[10, 11]]
    assert chosen.truth.tolist() == [[0, 1]]


def test_a_better_detection_refreshes_its_track() -> None:
    chosen = choose([0.0, 0.1], [0.6, 0.9], owners_of(10), lines_at(0.0), replace(CALM, refresh=1.0))
    assert chosen.rows.tolist() == [[1]]
    assert chosen.identity.tolist() == [[0]]


def test_false_tracks_belong_to_nobody_and_stay_so() -> None:
    targets = lines_at(0.0)
    born = [
        choose([0.0, 9.0], [0.9, 0.8], TrackTruth.none(1), targets, replace(CALM, false_tracks=1), s) for s in (0, 1, 2)
    ]
    assert {chosen.rows.shape[1] for chosen in born} == {1, 2}
    both = next(chosen for chosen in born if chosen.rows.shape[1] == 2)
    assert both.owners.element_ids.tolist() == [[10, -1]]
    later = choose([0.0, 5.0], [0.9, 0.9], both.owners, lines_at(0.0, 5.0))
    assert later.owners.element_ids.tolist() == [[10, -1]]
    everyone = choose([9.0, 0.0, 8.0], [0.8, 0.9, 0.1], TrackTruth.none(1), targets, replace(CALM, false_tracks=None))
    assert everyone.rows.tolist() == [[0, 1]], "all confident ones, in their order"


def test_no_more_tracks_than_there_is_room_for_and_the_best_stay() -> None:
    chosen = choose([0.0, 5.0], [0.6, 0.9], TrackTruth.none(1), lines_at(0.0, 5.0), replace(CALM, capacity=1))
    assert chosen.rows.tolist() == [[1]]
