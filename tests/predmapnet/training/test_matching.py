"""The assignment against brute force, and what must not change it."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from mapfusion.elements import RegionOfInterest
from predmapnet.network.state import FrameOutputs, LayerPredictions
from predmapnet.scenes import FrameTruth
from predmapnet.training.data.targets import equivalent_orders, truth_targets
from predmapnet.training.losses.matching import Assignment, Truth, best_order, focal_class_cost, line_costs, match
from predmapnet.training.losses.weights import LITE_LOSSES
from predmapnet.training.track_truth import TrackTruth

ROI = RegionOfInterest()
SIZE = torch.tensor([60.0, 30.0])
POINTS = 6
NOTHING = FrameTruth(np.zeros(0, np.int64), (), np.zeros(0, np.int64))


def random_truth(generator: np.random.Generator, count: int) -> FrameTruth:
    kinds = generator.integers(0, 3, count)
    lines = []
    for kind in kinds:
        line = generator.uniform([-25, -12], [25, 12], (5, 2))
        lines.append(np.concatenate([line, line[:1]]) if kind == 0 else line)
    return FrameTruth(kinds, tuple(lines), np.arange(count))


def truth_of(*truths: FrameTruth, points: int = POINTS) -> Truth:
    return Truth(truth_targets(truths, ROI, points, (10, 20)), torch.device("cpu"), SIZE)


def pairs_of(
    logits: torch.Tensor,
    points: torch.Tensor,
    truth: Truth,
    valid: torch.Tensor | None = None,
    owners: TrackTruth | None = None,
    exclusive: bool = False,
) -> Assignment:
    """Pairs of a single layer; rows of owners come first."""
    streams, rows = logits.shape[:2]
    outputs = FrameOutputs(
        layers=[LayerPredictions(logits, points, None)],
        queries=torch.zeros(streams, rows, 4),
        query_valid=torch.ones(streams, rows, dtype=torch.bool) if valid is None else valid,
        query_track_ids=torch.full((streams, rows), -1),
        segmentation=torch.zeros(streams, 3, 10, 20),
        bev=torch.zeros(streams, 0, 10, 20),
        ego_to_global=torch.eye(4, dtype=torch.float64).repeat(streams, 1, 1),
    )
    return match(outputs, truth, owners or TrackTruth.none(streams), LITE_LOSSES, exclusive).layers[0]


def plain_curve_cost(points: np.ndarray, target: np.ndarray, ring: bool) -> float:
    if not ring:
        orders = [target, target[::-1]]
    else:
        corners = target[:-1]
        turns = [np.roll(corners, -shift, axis=0) for shift in range(len(corners))]
        turns += [turn[::-1] for turn in turns]
        orders = [np.concatenate([turn, turn[:1]]) for turn in turns]
    return min(float(np.abs(points - order).mean()) for order in orders)


def test_a_line_has_two_orders_and_a_ring_of_twenty_points_thirty_eight() -> None:
    line, ring = equivalent_orders(20)
    assert line.shape == (2, 20)
    assert ring.shape == (38, 20)
    assert len({tuple(order) for order in ring.tolist()}) == 38
    assert (ring[:, 0] == ring[:, -1]).all()


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 10_000), rows=st.integers(1, 5), truths=st.integers(1, 4))
def test_assignment_is_the_cheapest_of_all(seed: int, rows: int, truths: int) -> None:
    """In both of two streams, the second of which has one more piece; there may be more truth than rows."""
    generator = np.random.default_rng(seed)
    truth = truth_of(random_truth(generator, truths), random_truth(generator, truths + 1))
    logits = torch.from_numpy(generator.normal(size=(2, rows, 3))).float()
    points = torch.from_numpy(generator.uniform(size=(2, rows, POINTS, 2))).float()
    pairs = pairs_of(logits, points, truth)
    class_cost, metres, true_metres = focal_class_cost(logits).numpy(), (points * SIZE).numpy(), truth.points.numpy()
    assert len(pairs) == min(rows, truths) + min(rows, truths + 1)
    assert (truth.targets.frame[pairs.truth] == pairs.frame).all()
    for stream, pieces in enumerate((range(truths), range(truths, 2 * truths + 1))):
        cost = np.array(
            [
                [
                    LITE_LOSSES.cost_focal * class_cost[stream, row, truth.kinds[piece]]
                    + LITE_LOSSES.cost_points
                    * plain_curve_cost(metres[stream, row], true_metres[piece], bool(truth.kinds[piece] == 0))
                    for piece in pieces
                ]
                for row in range(rows)
            ]
        )
        small, large = min(cost.shape), max(cost.shape)
        table = cost if cost.shape[0] <= cost.shape[1] else cost.T
        cheapest = min(
            sum(table[i, chosen[i]] for i in range(small)) for chosen in itertools.permutations(range(large), small)
        )
        own = pairs.frame == stream
        found = cost[pairs.row[own].numpy(), pairs.truth[own].numpy() - pieces[0]].sum()
        assert found == pytest.approx(cheapest, abs=1e-3)


@pytest.mark.parametrize("beta", [0.0, 0.05])
@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 10_000), shift=st.integers(0, 18), turned=st.booleans())
def test_order_of_a_ring_does_not_matter(beta: float, seed: int, shift: int, turned: bool) -> None:
    generator = np.random.default_rng(seed)
    ring = generator.uniform(-10, 10, (19, 2))
    other = np.roll(ring, shift, 0)[:: -1 if turned else 1]
    prediction = torch.from_numpy(generator.uniform(-10, 10, (1, 20, 2))).float()
    costs, targets = [], []
    for corners in (ring, other):
        truth = truth_of(NOTHING, points=20)
        truth.kinds, truth.begin = np.zeros(1, np.int64), np.array([0, 1])
        truth.points = torch.from_numpy(np.concatenate([corners, corners[:1]])[None]).float()
        costs.append(float(line_costs(prediction.flatten(1)[None], *truth.orders(), beta)))
        targets.append(best_order(prediction, truth.points, torch.tensor([True]), beta))
    assert costs[0] == pytest.approx(costs[1], abs=1e-5)
    assert torch.allclose(*targets)


def test_a_reversed_line_costs_the_same_but_a_rolled_one_does_not() -> None:
    ends = np.array([[-10.0, 0.0], [10.0, 0.0]])
    truth = truth_of(FrameTruth(np.array([1]), (ends,), np.array([0])), points=20)
    line = truth.points[0]
    found = torch.stack([line, line.flip(0), line.roll(3, 0)]).flatten(1)[None]
    forwards, backwards, rolled = line_costs(found, *truth.orders(), 0.0)[0, :, 0].tolist()
    assert forwards == pytest.approx(0.0, abs=1e-5) and backwards == pytest.approx(0.0, abs=1e-5)
    assert rolled > 0.5


def test_invalid_rows_and_tracks_stay_out() -> None:
    generator = np.random.default_rng(0)
    truth = truth_of(random_truth(generator, 2), random_truth(generator, 1))
    valid = torch.tensor([[True, True, False, True, True], [True, True, True, True, False]])
    logits, points = torch.zeros(2, 5, 3), torch.rand(2, 5, POINTS, 2)
    pairs = pairs_of(logits, points, truth, valid, owners=TrackTruth(*np.full((2, 2, 2), -1)))
    assert sorted(zip(pairs.frame.tolist(), pairs.row.tolist(), strict=True))[:2] == [(0, 3), (0, 4)]
    assert pairs.frame.tolist().count(1) == 1
    assert pairs.row[pairs.frame == 1].item() in (2, 3)


def test_frames_without_truth_give_no_pairs() -> None:
    assert len(pairs_of(torch.zeros(1, 3, 3), torch.rand(1, 3, POINTS, 2), truth_of(NOTHING))) == 0


@pytest.mark.parametrize("exclusive", [False, True])
def test_more_truth_than_detections_and_losses_that_are_no_numbers_still_give_an_assignment(exclusive: bool) -> None:
    """Two tracks answer for theirs; one of the two other rows is padding, and there are five more pieces."""
    generator = np.random.default_rng(0)
    pieces = random_truth(generator, 7)
    owners = TrackTruth(pieces.kinds[None, :2], pieces.element_ids[None, :2])
    valid = torch.tensor([[True, True, True, False]])
    for logits in (torch.zeros(1, 4, 3), torch.full((1, 4, 3), torch.nan)):
        pairs = pairs_of(logits, torch.rand(1, 4, POINTS, 2), truth_of(pieces), valid, owners, exclusive)
        assert pairs.row.tolist() == [0, 1, 2]
        assert pairs.truth.tolist()[:2] == [0, 1]
        assert not exclusive or pairs.truth[2] >= 2


@pytest.mark.parametrize("exclusive", [False, True])
def test_tracks_answer_for_the_nearest_piece_of_their_own_stream_however_many_pieces_others_have(
    exclusive: bool,
) -> None:
    """An element of the stream with less truth is in two pieces; the track stands on the second one."""
    generator = np.random.default_rng(0)
    near, far = np.array([[5.0, 1.0], [25.0, 1.0]]), np.array([[-25.0, 1.0], [-8.0, 1.0]])
    cut = FrameTruth(np.array([1, 1]), (far, near), np.array([4, 4]))
    truth = truth_of(cut, random_truth(generator, 5))
    points = torch.rand(2, 3, POINTS, 2)
    points[0, 0] = truth.targets.points[1]
    owners = TrackTruth(np.array([[1], [truth.kinds[4]]]), np.array([[4], [2]]))
    pairs = pairs_of(torch.zeros(2, 3, 3), points, truth, owners=owners, exclusive=exclusive)
    by_track = {int(frame): int(piece) for frame, row, piece in zip(*vars(pairs).values(), strict=True) if row == 0}
    assert by_track == {0: 1, 1: 4}
