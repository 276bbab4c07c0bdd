"""Assignment of predictions to truth: Hungarian, over every equivalent order of the points."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from scipy.optimize import linear_sum_assignment
from torch import Tensor
from torch.nn import functional

from mapfusion.elements import ElementKind
from predmapnet.training.data.targets import Targets, equivalent_orders

FOCAL_ALPHA = 0.25
FOCAL_GAMMA = 2.0


@dataclass(frozen=True)
class MatchingCosts:
    """Weights of the assignment's cost.

    Attributes:
        focal: of the focal class cost.
        points: of the mean L1 distance per coordinate, per metre.
        mask: of dice plus cross-entropy of the masks; only used for layers that have masks but no polyline.
    """

    focal: float = 3.0
    points: float = 1.2
    mask: float = 2.0


@dataclass
class Assignment:
    """Pairs of a prediction's row and a piece of truth.

    Attributes:
        frame: ``(n,) int64``, index in the batch.
        row: ``(n,) int64``, row of the layer's predictions.
        truth: ``(n,) int64``, index into the flattened targets.
    """

    frame: Tensor
    row: Tensor
    truth: Tensor

    def __len__(self) -> int:
        return len(self.row)


def joined_pairs(first: Assignment, second: Assignment) -> Assignment:
    """Return all pairs of both."""
    return Assignment(
        torch.cat([first.frame, second.frame]),
        torch.cat([first.row, second.row]),
        torch.cat([first.truth, second.truth]),
    )


def focal_class_cost(logits: Tensor) -> Tensor:
    """Focal loss of a row being each class, less that of being background.

    Args:
        logits: ``(..., classes)``.

    Returns:
        ``(..., classes)``.
    """
    probability = logits.sigmoid()
    positive = -FOCAL_ALPHA * (1 - probability) ** FOCAL_GAMMA * functional.logsigmoid(logits)
    negative = -(1 - FOCAL_ALPHA) * probability**FOCAL_GAMMA * functional.logsigmoid(-logits)
    return positive - negative


def curve_cost(points: Tensor, targets: Tensor, rings: Tensor) -> Tensor:
    """Mean absolute difference per coordinate under the best equivalent order of each target.

    Args:
        points: ``(n, P, 2)``, predictions.
        targets: ``(m, P, 2)``, in the same unit.
        rings: ``(m,) bool``, which targets are closed.

    Returns:
        ``(n, m)``, in the unit of the points.
    """
    orders, count = _padded_orders(targets, rings)
    used = torch.arange(orders.shape[1], device=orders.device) < count[:, None]
    distance = torch.cdist(points.flatten(1), orders[used].flatten(1), p=1) / points.shape[1] / 2
    best = distance.new_full((len(points), len(targets)), torch.inf)
    owner = torch.arange(len(targets), device=orders.device).repeat_interleave(count)
    return best.scatter_reduce_(1, owner.expand_as(distance), distance, "amin")


def best_order(points: Tensor, targets: Tensor, rings: Tensor) -> Tensor:
    """Put each target into the equivalent order that is nearest to its prediction.

    Args:
        points: ``(n, P, 2)``, predictions.
        targets: ``(n, P, 2)``, one for each prediction.
        rings: ``(n,) bool``.

    Returns:
        ``(n, P, 2)``.
    """
    if not len(points):
        return targets
    orders, _ = _padded_orders(targets, rings)
    distance = (points.detach()[:, None] - orders).abs().sum((2, 3))
    return orders[torch.arange(len(orders), device=orders.device), distance.argmin(1)]


def _padded_orders(targets: Tensor, rings: Tensor) -> tuple[Tensor, Tensor]:
    """Return ``(m, R, P, 2)`` equivalent orders, a line's two repeated, and ``(m,)`` how many are distinct."""
    line, ring = (table.to(targets.device) for table in equivalent_orders(targets.shape[1]))
    repeated = line.repeat(len(ring) // 2, 1)
    table = torch.where(rings[:, None, None], ring, repeated)
    orders = targets[torch.arange(len(targets), device=targets.device)[:, None, None], table]
    return orders, torch.where(rings, len(ring), len(line))


def mask_cost(logits: Tensor, masks: Tensor) -> Tensor:
    """Dice loss plus binary cross-entropy of every mask with every target mask.

    Args:
        logits: ``(n, H, W)``.
        masks: ``(m, H, W)`` in [0, 1].

    Returns:
        ``(n, m)``.
    """
    logits, masks = logits.flatten(1), masks.flatten(1)
    positive, negative = functional.softplus(-logits), functional.softplus(logits)
    entropy = (positive @ masks.T + negative @ (1 - masks).T) / logits.shape[1]
    probability = logits.sigmoid()
    overlap = 2 * probability @ masks.T + 1
    dice = 1 - overlap / (probability.sum(1)[:, None] + masks.sum(1) + 1)
    return dice + entropy


@torch.no_grad()
def match(
    logits: Tensor,
    points: Tensor | None,
    masks: Tensor | None,
    query_valid: Tensor,
    first_row: int,
    targets: Targets,
    size: Tensor,
    costs: MatchingCosts,
) -> Assignment:
    """Assign the rows from ``first_row`` on (the detections) of one layer to the truth of their frame.

    Args:
        logits: ``(B, rows, 3)``.
        points: ``(B, rows, P, 2)``, normalised, or None for a layer that has masks only.
        masks: ``(B, rows, H, W)`` logits; needed only without points, then of the size of ``targets.masks``.
        query_valid: ``(B, rows) bool``; invalid rows are never chosen.
        first_row: rows before it stay out.
        targets: the truth of the ``B`` frames.
        size: ``(2,)``, length and width of the ROI, metres.
        costs: weights.
    """
    class_cost = focal_class_cost(logits)
    pairs: list[Tensor] = []
    for frame in range(targets.batch):
        truth = torch.nonzero(targets.frame == frame)[:, 0]
        rows = first_row + torch.nonzero(query_valid[frame, first_row:])[:, 0]
        if not len(truth) or not len(rows):
            continue
        kinds = targets.kinds[truth]
        cost = costs.focal * class_cost[frame, rows][:, kinds]
        if points is not None:
            rings = kinds == ElementKind.PED_CROSSING
            cost += costs.points * curve_cost(points[frame, rows] * size, targets.points[truth] * size, rings)
        elif masks is not None:
            cost += costs.mask * mask_cost(masks[frame, rows], targets.masks[truth])
        chosen, answered = linear_sum_assignment(np.asarray(cost.cpu()))
        row, answer = rows[torch.from_numpy(chosen)], truth[torch.from_numpy(answered)]
        pairs.append(torch.stack([torch.full_like(row, frame), row, answer]))
    found = torch.cat(pairs, 1) if pairs else targets.frame.new_zeros((3, 0))
    return Assignment(found[0], found[1], found[2])
