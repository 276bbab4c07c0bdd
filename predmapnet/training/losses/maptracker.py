"""The losses of MapTracker's training: on a decoder layer, on the segmentation, and on the motion of the tracks."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from scipy.optimize import linear_sum_assignment
from torch import Tensor
from torch.nn import functional

from mapfusion.elements import ElementKind, RegionOfInterest
from predmapnet.network.ego_motion import invert_pose, move_points, plane_motion
from predmapnet.network.maptracker.motion_mlp import MotionMlp, pose_vector
from predmapnet.training.data.targets import equivalent_orders
from predmapnet.training.losses.lite import focal_loss
from predmapnet.training.losses.matching import focal_class_cost

CLASS_WEIGHT, LINE_WEIGHT, SEGMENTATION_WEIGHT = 5.0, 50.0, 100.0
"""The official configuration asks for 10 in the segmentation, and the code applies it twice."""
TRANSFORMATION_WEIGHT = 0.1
SMOOTH_L1_BETA = 0.01
FORCED = -1.0
FAR_AWAY = 1e5
"""Coordinates of orders that are no orders of a line, so that none is ever the best."""

ReadOut = Callable[[Tensor], tuple[Tensor, Tensor]]
"""From queries ``(..., C)`` to logits ``(..., classes)`` and normalised polylines ``(..., P, 2)``."""


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


def all_orders(points: Tensor, kinds: Tensor) -> Tensor:
    """Return every order of the points that describes the same element, ``(G, O, 2 P)``.

    Args:
        points: ``(G, P, 2)``, normalised; rings repeat their first point.
        kinds: ``(G) int64``.
    """
    line, ring = (table.to(points.device) for table in equivalent_orders(points.shape[1]))
    lines = functional.pad(points[:, line].flatten(2), (0, 0, 0, len(ring) - len(line)), value=FAR_AWAY)
    is_ring = kinds == ElementKind.PED_CROSSING
    return torch.where(is_ring[:, None, None], points[:, ring].flatten(2), lines)


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
def assign_layer(
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
    cost = CLASS_WEIGHT * focal_class_cost(logits)[:, kinds] + LINE_WEIGHT * distance
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


def stacked(targets: Sequence[LayerTargets], truth: Sequence[int]) -> LayerTargets:
    """Put the targets of several streams, with as many rows each, below each other.

    Args:
        targets: of each stream.
        truth: pieces of truth of each stream.
    """
    rows = [len(stream.labels) for stream in targets]
    return LayerTargets(
        labels=torch.cat([stream.labels for stream in targets]),
        lines=torch.cat([stream.lines for stream in targets]),
        rows=torch.cat([stream.rows + sum(rows[:at]) for at, stream in enumerate(targets)]),
        truth=torch.cat([stream.truth + sum(truth[:at]) for at, stream in enumerate(targets)]),
    )


def layer_losses(logits: Tensor, lines: Tensor, targets: LayerTargets, valid: Tensor) -> tuple[Tensor, Tensor]:
    """Return the weighted losses of class and line of one decoder layer.

    Args:
        logits: ``(R, classes)``.
        lines: ``(R, 2 P)``, normalised.
        targets: of :func:`assign`.
        valid: ``(R) bool``, False for padding.
    """
    answers = max(len(targets.rows), 1)
    focal = (focal_loss(logits, _wanted(targets.labels, logits)) * valid[:, None]).sum() / answers
    found, expected = lines[targets.rows], targets.lines[targets.rows]
    distance = functional.smooth_l1_loss(found, expected, beta=SMOOTH_L1_BETA, reduction="sum")
    return CLASS_WEIGHT * focal, LINE_WEIGHT * distance / answers / (lines.shape[-1] // 2)


def transformation_loss(
    motion: MotionMlp,
    read_out: ReadOut,
    tracks: Tensor,
    labels: Tensor,
    lines: Tensor,
    past_to_current: Tensor,
    roi: RegionOfInterest,
) -> Tensor:
    """Teach the motion of queries: carried to the next frame and back, they must be read out as their element there.

    Args:
        motion: carries queries.
        read_out: of the decoder.
        tracks: ``(N, C)``, queries of the past frame.
        labels: ``(N) int64``, what they stood for in it; the number of classes means background.
        lines: ``(N, 2 P)``, truth in the past ego frame, normalised; anything in background rows.
        past_to_current: ``(N, 4, 4) float64``, as the queries are carried.
        roi: the region of both frames.

    Returns:
        The weighted sum of both directions. Coordinates that leave the region count in neither.
    """
    if not len(tracks):
        return tracks.sum()
    points = lines.unflatten(-1, (-1, 2))
    moved = move_points(points, plane_motion(past_to_current).to(points.dtype), roi)
    carried = motion(tracks, pose_vector(past_to_current).to(tracks.dtype))
    returned = motion(carried, pose_vector(invert_pose(past_to_current)).to(tracks.dtype))
    there, back = read_out(carried), read_out(returned)
    positive = labels < there[0].shape[-1]
    weight = (moved > 0) & (moved < 1) & positive[:, None, None]
    total = tracks.new_zeros(())
    for (logits, found), truth in ((there, moved), (back, points)):
        distance = functional.smooth_l1_loss(found, truth, beta=SMOOTH_L1_BETA, reduction="none")
        line = (distance * weight).sum() / positive.sum().clamp(min=1) / points.shape[1]
        focal = focal_loss(logits, _wanted(labels, logits)).sum() / len(labels)
        total = total + LINE_WEIGHT * line + CLASS_WEIGHT * focal
    return TRANSFORMATION_WEIGHT * total


def _wanted(labels: Tensor, logits: Tensor) -> Tensor:
    """Return labels ``(N)``, background included, as ``(N, classes)`` zeros and ones."""
    return functional.one_hot(labels, logits.shape[-1] + 1)[:, :-1].to(logits.dtype)


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
