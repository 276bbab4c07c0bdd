"""The losses of MapTracker's training on one decoder layer, and on the segmentation."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from scipy.optimize import linear_sum_assignment
from torch import Tensor
from torch.nn import functional

ALPHA, GAMMA = 0.25, 2.0
CLASS_WEIGHT, LINE_WEIGHT, SEGMENTATION_WEIGHT = 5.0, 50.0, 100.0
"""The official configuration asks for 10 in the segmentation, and the code applies it twice."""
SMOOTH_L1_BETA = 0.01
FORCED = -1.0


@dataclass
class LayerTargets:
    """What each row of one layer should say.

    Attributes:
        labels: ``(R) int64``; the number of classes means background.
        lines: ``(R, 2 P)``, normalised; zeros in background rows.
        rows: ``(n) int64``, rows that answer for a piece of truth.
        truth: ``(n) int64``, which one.
    """

    labels: Tensor
    lines: Tensor
    rows: Tensor
    truth: Tensor


def class_cost(logits: Tensor, kinds: Tensor) -> Tensor:
    """Focal loss of each row being each piece of truth, less that of not being it: ``(R, G)``.

    Args:
        logits: ``(R, classes)``.
        kinds: ``(G) int64``.
    """
    probability = logits.sigmoid()
    positive = -ALPHA * (1 - probability) ** GAMMA * (probability + 1e-12).log()
    negative = -(1 - ALPHA) * probability**GAMMA * (1 - probability + 1e-12).log()
    return (positive - negative)[:, kinds]


def line_cost(lines: Tensor, orders: Tensor) -> tuple[Tensor, Tensor]:
    """Smooth L1 distance, summed over a line's numbers and divided by its points, under the best order of the truth.

    Args:
        lines: ``(R, 2 P)``.
        orders: ``(G, O, 2 P)``, equivalent orders of each piece of truth; unused ones are far away.

    Returns:
        The cost ``(R, G)`` and the best order ``(R, G) int64``.
    """
    difference = (lines[:, None, None] - orders[None]).abs()
    near = difference**2 / (2 * SMOOTH_L1_BETA)
    distance = torch.where(difference < SMOOTH_L1_BETA, near, difference - SMOOTH_L1_BETA / 2)
    best = (distance.sum(dim=-1) / (lines.shape[-1] // 2)).min(dim=-1)
    return best.values, best.indices


@torch.no_grad()
def assign(
    logits: Tensor, lines: Tensor, orders: Tensor, kinds: Tensor, detection: Tensor, continued: Tensor
) -> LayerTargets:
    """Decide which row answers for which piece of truth.

    A track answers for the truth that it stands for already; the rest goes to detections by the cheapest assignment.

    Args:
        logits: ``(R, classes)``.
        lines: ``(R, 2 P)``, normalised.
        orders: ``(G, O, 2 P)``.
        kinds: ``(G) int64``.
        detection: ``(R) bool``, rows that are free to take any truth; False for tracks and padding.
        continued: ``(R) int64``, the truth that a track goes on with; -1 for all other rows.
    """
    distance, order = line_cost(lines, orders)
    cost = CLASS_WEIGHT * class_cost(logits, kinds) + LINE_WEIGHT * distance
    cost = cost.masked_fill(~detection[:, None], torch.inf)
    tracks = torch.nonzero(continued >= 0)[:, 0]
    cost[:, continued[tracks]] = torch.inf
    cost[tracks, continued[tracks]] = FORCED
    chosen, answered = linear_sum_assignment(cost.cpu().numpy())
    rows, truth = (torch.from_numpy(index).to(logits.device) for index in (chosen, answered))
    labels = torch.full_like(continued, logits.shape[-1])
    labels[rows] = kinds[truth]
    targets = torch.zeros_like(lines)
    targets[rows] = orders[truth, order[rows, truth]].to(lines.dtype)
    return LayerTargets(labels, targets, rows, truth)


def layer_losses(logits: Tensor, lines: Tensor, targets: LayerTargets, valid: Tensor) -> tuple[Tensor, Tensor]:
    """Return the weighted losses of class and line of one decoder layer.

    Args:
        logits: ``(R, classes)``.
        lines: ``(R, 2 P)``, normalised.
        targets: of :func:`assign`.
        valid: ``(R) bool``, False for padding.
    """
    answers = max(len(targets.rows), 1)
    wanted = functional.one_hot(targets.labels, logits.shape[-1] + 1)[:, :-1].to(logits.dtype)
    focal = (focal_loss(logits, wanted) * valid[:, None]).sum() / answers
    found, expected = lines[targets.rows], targets.lines[targets.rows]
    distance = functional.smooth_l1_loss(found, expected, beta=SMOOTH_L1_BETA, reduction="sum")
    return CLASS_WEIGHT * focal, LINE_WEIGHT * distance / answers / (lines.shape[-1] // 2)


def segmentation_losses(logits: Tensor, target: Tensor) -> tuple[Tensor, Tensor]:
    """Return the weighted focal and dice losses.

    Args:
        logits: ``(B, classes, h, w)``.
        target: likewise, 0 or 1.
    """
    target = target.to(logits.dtype)
    probability = logits.sigmoid()
    overlap = 2 * (probability * target).sum(dim=(2, 3)) + 1e-5
    size = probability.square().sum(dim=(2, 3)) + target.sum(dim=(2, 3)) + 1e-5
    return SEGMENTATION_WEIGHT * focal_loss(logits, target).mean(), 1 - (overlap / size).mean()


def focal_loss(logits: Tensor, target: Tensor) -> Tensor:
    """Sigmoid focal loss of each number."""
    probability = logits.sigmoid()
    entropy = functional.binary_cross_entropy_with_logits(logits, target, reduction="none")
    wrong = probability * (1 - target) + (1 - probability) * target
    share = ALPHA * target + (1 - ALPHA) * (1 - target)
    return share * wrong**GAMMA * entropy
