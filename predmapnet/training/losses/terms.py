"""The losses of Sec. 3.6 and of MapTracker's training, one function each, summed over what they are counted over."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor
from torch.nn import functional

from mapfusion.elements import RegionOfInterest
from predmapnet.network.ego_motion import invert_pose, move_points, plane_motion
from predmapnet.network.maptracker.motion_mlp import MotionMlp, pose_vector
from predmapnet.training.data.targets import Targets
from predmapnet.training.losses.matching import FOCAL_ALPHA, FOCAL_GAMMA, best_order
from predmapnet.training.losses.weights import LossWeights

SEGMENTATION_POSITIVE_WEIGHT = 3.0

ReadOut = Callable[[Tensor], tuple[Tensor, Tensor]]
"""From queries ``(..., C)`` to logits ``(..., classes)`` and normalised polylines ``(..., P, 2)``."""


def focal_loss(logits: Tensor, target: Tensor) -> Tensor:
    """Sigmoid focal loss of each number.

    Args:
        logits: ``(..., classes)``.
        target: likewise, 0 or 1.
    """
    probability = logits.sigmoid()
    entropy = functional.binary_cross_entropy_with_logits(logits, target, reduction="none")
    wrong = probability * (1 - target) + (1 - probability) * target
    alpha = FOCAL_ALPHA * target + (1 - FOCAL_ALPHA) * (1 - target)
    return alpha * wrong**FOCAL_GAMMA * entropy


def direction_loss(points: Tensor, target: Tensor) -> Tensor:
    """One minus the cosine between the edges, mean over the edges of polylines ``(n, P, 2)``, summed over polylines."""
    cosine = functional.cosine_similarity(points.diff(dim=1), target.diff(dim=1), dim=2, eps=1e-4)
    return (1 - cosine).mean(1).sum()


def dice_loss(logits: Tensor, target: Tensor) -> Tensor:
    """Dice loss of each mask of ``(n, H, W)``."""
    probability = logits.sigmoid()
    overlap = 2 * (probability * target).sum((1, 2)) + 1
    return 1 - overlap / (probability.sum((1, 2)) + target.sum((1, 2)) + 1)


def mask_loss(logits: Tensor, drawn: Tensor, weights: LossWeights) -> Tensor:
    """Weighted dice and cross-entropy, mean over cells (L_seg), of each mask of ``(n, H, W)``."""
    entropy = functional.binary_cross_entropy_with_logits(logits, drawn, reduction="none").mean((1, 2))
    return weights.mask_dice * dice_loss(logits, drawn) + weights.mask_entropy * entropy


def segmentation_losses(logits: Tensor, targets: Targets, weights: LossWeights) -> dict[str, Tensor]:
    """Weighted losses L_BEV of ``(B, classes, h, w)``, means over cells, streams and classes."""
    target = functional.adaptive_max_pool2d(targets.segmentation, logits.shape[-2:])
    if weights.focal_segmentation:
        probability = logits.sigmoid()
        overlap = 2 * (probability * target).sum(dim=(2, 3)) + 1e-5
        size = probability.square().sum(dim=(2, 3)) + target.sum(dim=(2, 3)) + 1e-5
        cells, dice = focal_loss(logits, target).mean(), 1 - (overlap / size).mean()
    else:
        emphasis = logits.new_tensor(SEGMENTATION_POSITIVE_WEIGHT)
        cells = functional.binary_cross_entropy_with_logits(logits, target, pos_weight=emphasis)
        dice = dice_loss(logits.flatten(0, 1), target.flatten(0, 1)).mean()
    return {"segmentation": weights.segmentation * cells, "segmentation_dice": weights.segmentation_dice * dice}


def depth_loss(logits: Tensor, targets: Tensor) -> Tensor:
    """Binary cross-entropy of all bins' probabilities (a softmax), summed over bins and over the known cells.

    Args:
        logits: ``(..., D, h', w')``.
        targets: ``(..., h', w') int64``, bins; negative where nothing is known.
    """
    chances = logits.movedim(-3, -1).log_softmax(dim=-1)
    wanted = functional.one_hot(targets.clamp(min=0), logits.shape[-3]).bool()
    # Written with logarithms: the function that takes probabilities is forbidden under autocast.
    others = torch.log1p(-chances.exp().clamp(max=1 - 1e-7))
    return -(torch.where(wanted, chances, others).sum(dim=-1) * (targets >= 0)).sum()


def forecast_losses(forecasts: Tensor, truth: Tensor, rings: Tensor, weights: LossWeights) -> Tensor:
    """Weighted distance of forecasts from the truth of t + 1 (L_pred): chamfer and, if asked for, point by point.

    The chamfer distance leaves it free where along the line the points lie and, nearly so, where it ends.

    Args:
        forecasts, truth: ``(n, P, 2)``, metres.
        rings: ``(n,) bool``.
        weights: of both.

    Returns:
        ``(n,)``.
    """
    distance = torch.linalg.vector_norm(forecasts[:, :, None] - truth[:, None], dim=3)
    loss = weights.forecast * (distance.amin(1).mean(1) + distance.amin(2).mean(1)) / 2
    if weights.forecast_points:
        apart = forecasts - best_order(forecasts, truth, rings)
        loss = loss + weights.forecast_points * torch.linalg.vector_norm(apart, dim=2).mean(1)
    return loss


def transformation_losses(
    motion: MotionMlp,
    read_out: ReadOut,
    tracks: Tensor,
    labels: Tensor,
    points: Tensor,
    past_to_current: Tensor,
    roi: RegionOfInterest,
    weights: LossWeights,
) -> tuple[Tensor, Tensor]:
    """Teach the motion of queries: carried to the next frame and back, they must be read out as their element there.

    Args:
        motion: carries queries.
        read_out: of the decoder.
        tracks: ``(N, C)``, queries of the past frame.
        labels: ``(N) int64``, what they stood for in it; the number of classes means background.
        points: ``(N, P, 2)``, truth in the past ego frame, normalised; anything in background rows.
        past_to_current: ``(N, 4, 4) float64``, as the queries are carried.
        roi: the region of both frames.
        weights: of classes and lines.

    Returns:
        The weighted sums over lines and over classes. Coordinates that leave the region count in neither direction.
    """
    moved = move_points(points, plane_motion(past_to_current).to(points.dtype), roi)
    carried = motion(tracks, pose_vector(past_to_current).to(tracks.dtype))
    returned = motion(carried, pose_vector(invert_pose(past_to_current)).to(tracks.dtype))
    there, back = read_out(carried), read_out(returned)
    inside = (moved > 0) & (moved < 1) & (labels < there[0].shape[-1])[:, None, None]
    wanted = functional.one_hot(labels, there[0].shape[-1] + 1)[:, :-1].to(tracks.dtype)
    lines, classes = tracks.new_zeros(()), tracks.new_zeros(())
    for (logits, found), truth in ((there, moved), (back, points)):
        apart = functional.smooth_l1_loss(found, truth, reduction="none", beta=weights.beta)
        lines = lines + (apart * inside).sum() / points.shape[1:].numel()
        classes = classes + focal_loss(logits, wanted).sum()
    return weights.transformation * weights.points * lines, weights.transformation * weights.focal * classes
