"""The assignment against brute force, and what must not change it."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from mapfusion.elements import RegionOfInterest
from predmapnet.scenes import FrameTruth
from predmapnet.training.data.targets import equivalent_orders, truth_targets
from predmapnet.training.losses.matching import MatchingCosts, best_order, curve_cost, focal_class_cost, match

ROI = RegionOfInterest()
SIZE = torch.tensor([60.0, 30.0])
POINTS = 6


def random_truth(generator: np.random.Generator, count: int) -> FrameTruth:
    kinds = generator.integers(0, 3, count)
    lines = []
    for kind in kinds:
        line = generator.uniform([-25, -12], [25, 12], (5, 2))
        lines.append(np.concatenate([line, line[:1]]) if kind == 0 else line)
    return FrameTruth(kinds, tuple(lines), np.arange(count))


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
    generator = np.random.default_rng(seed)
    targets = truth_targets([random_truth(generator, truths)], ROI, POINTS, None)
    logits = torch.from_numpy(generator.normal(size=(1, rows, 3))).float()
    points = torch.from_numpy(generator.uniform(size=(1, rows, POINTS, 2))).float()
    costs = MatchingCosts()
    pairs = match(logits, points, None, torch.ones(1, rows, dtype=torch.bool), 0, targets, SIZE, costs)

    class_cost = focal_class_cost(logits)[0].numpy()
    metres, true_metres = (points[0] * SIZE).numpy(), (targets.points * SIZE).numpy()
    cost = np.array(
        [
            [
                costs.focal * class_cost[row, kind]
                + costs.points * plain_curve_cost(metres[row], true_metres[truth], bool(kind == 0))
                for truth, kind in enumerate(targets.kinds.tolist())
            ]
            for row in range(rows)
        ]
    )
    small, large = min(rows, truths), max(rows, truths)
    table = cost if rows <= truths else cost.T
    cheapest = min(
        sum(table[i, chosen[i]] for i in range(small)) for chosen in itertools.permutations(range(large), small)
    )
    found = cost[pairs.row.numpy(), pairs.truth.numpy()].sum()
    assert len(pairs) == small
    assert found == pytest.approx(cheapest, abs=1e-3)


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 10_000), shift=st.integers(0, 18), turned=st.booleans())
def test_order_of_a_ring_does_not_matter(seed: int, shift: int, turned: bool) -> None:
    generator = np.random.default_rng(seed)
    ring = torch.from_numpy(generator.uniform(size=(19, 2))).float()
    ring = torch.cat([ring, ring[:1]])
    other = torch.roll(ring[:-1], shift, 0)
    other = torch.cat([other, other[:1]])
    other = other.flip(0) if turned else other
    prediction = torch.from_numpy(generator.uniform(size=(1, 20, 2))).float()
    rings = torch.tensor([True])
    assert curve_cost(prediction, ring[None], rings) == pytest.approx(
        float(curve_cost(prediction, other[None], rings)), abs=1e-5
    )
    assert torch.allclose(best_order(prediction, ring[None], rings), best_order(prediction, other[None], rings))


def test_a_reversed_line_costs_the_same_but_a_rolled_one_does_not() -> None:
    line = torch.stack([torch.linspace(0, 10, 20), torch.zeros(20)], 1)[None]
    open_line = torch.tensor([False])
    assert float(curve_cost(line, line.flip(1), open_line)) == pytest.approx(0.0, abs=1e-6)
    assert float(curve_cost(line, line.roll(3, 1), open_line)) > 0.5


def test_invalid_rows_and_rows_before_the_detections_stay_out() -> None:
    generator = np.random.default_rng(0)
    targets = truth_targets([random_truth(generator, 2), random_truth(generator, 1)], ROI, POINTS, None)
    valid = torch.tensor([[True, True, False, True, True], [True, True, True, True, False]])
    logits, points = torch.zeros(2, 5, 3), torch.rand(2, 5, POINTS, 2)
    pairs = match(logits, points, None, valid, 2, targets, SIZE, MatchingCosts())
    assert sorted(zip(pairs.frame.tolist(), pairs.row.tolist(), strict=True))[:2] == [(0, 3), (0, 4)]
    assert pairs.frame.tolist().count(1) == 1
    assert pairs.row[pairs.frame == 1].item() in (2, 3)
    assert (targets.frame[pairs.truth] == pairs.frame).all()


def test_frames_without_truth_give_no_pairs() -> None:
    nothing = FrameTruth(np.zeros(0, np.int64), (), np.zeros(0, np.int64))
    targets = truth_targets([nothing], ROI, POINTS, (10, 20))
    pairs = match(
        torch.zeros(1, 3, 3), torch.rand(1, 3, POINTS, 2), None, torch.ones(1, 3, dtype=torch.bool), 0, targets, SIZE,
        MatchingCosts(),
    )  # fmt: skip
    assert len(pairs) == 0
