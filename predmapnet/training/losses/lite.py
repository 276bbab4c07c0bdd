"""The training losses of Sec. 3.6, one function each, and their weighted sum over all supervised layers."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional

from mapfusion.elements import ElementKind
from predmapnet.network.state import FrameOutputs, LayerPredictions
from predmapnet.training.data.targets import Targets
from predmapnet.training.losses.matching import (
    FOCAL_ALPHA,
    FOCAL_GAMMA,
    Assignment,
    MatchingCosts,
    best_order,
    joined_pairs,
    match,
)


@dataclass(frozen=True)
class LossWeights:
    """Weight of each loss; the defaults are what trained best on two CPU cores.

    The paper weighs a mask's dice by 2 and its cross-entropy by 1 (Sec. 3.6); on thin lines and small grids
    the opposite emphasis converges faster.
    """

    focal: float = 3.0
    points: float = 1.5
    direction: float = 0.3
    mask_dice: float = 1.0
    mask_entropy: float = 5.0
    segmentation_dice: float = 2.0
    segmentation_entropy: float = 6.0
    forecast: float = 0.5


SMOOTH_L1_BETA_M = 0.05
SEGMENTATION_POSITIVE_WEIGHT = 3.0


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


def point_loss(points_m: Tensor, target_m: Tensor) -> Tensor:
    """Smooth L1 in metres, mean over a polyline's coordinates, summed over polylines.

    Args:
        points_m, target_m: ``(n, P, 2)``, metres.
    """
    loss = functional.smooth_l1_loss(points_m, target_m, beta=SMOOTH_L1_BETA_M, reduction="none")
    return loss.mean((1, 2)).sum()


def direction_loss(points_m: Tensor, target_m: Tensor) -> Tensor:
    """One minus the cosine between the edges, mean over a polyline's edges, summed over polylines.

    Args:
        points_m, target_m: ``(n, P, 2)``, metres.
    """
    cosine = functional.cosine_similarity(points_m.diff(dim=1), target_m.diff(dim=1), dim=2, eps=1e-4)
    return (1 - cosine).mean(1).sum()


def dice_loss(logits: Tensor, target: Tensor) -> Tensor:
    """Dice loss of each mask, summed.

    Args:
        logits: ``(n, H, W)``.
        target: ``(n, H, W)`` in [0, 1].
    """
    probability = logits.sigmoid()
    overlap = 2 * (probability * target).sum((1, 2)) + 1
    return (1 - overlap / (probability.sum((1, 2)) + target.sum((1, 2)) + 1)).sum()


def mask_entropy(logits: Tensor, target: Tensor) -> Tensor:
    """Binary cross-entropy, mean over a mask's cells, summed over masks.

    Args:
        logits, target: ``(n, H, W)``.
    """
    return functional.binary_cross_entropy_with_logits(logits, target, reduction="none").mean((1, 2)).sum()


def mask_loss(logits: Tensor, masks: Tensor, pairs: Assignment, dice: float, entropy: float) -> Tensor:
    """Weighted dice loss and cross-entropy (L_seg of Sec. 3.6), mean over pairs.

    Args:
        logits: ``(B, R, H, W)``.
        masks: ``(M, H, W)`` in [0, 1].
        pairs: rows and truth.
        dice, entropy: weights.
    """
    found, drawn = logits[pairs.frame, pairs.row], masks[pairs.truth]
    return (dice * dice_loss(found, drawn) + entropy * mask_entropy(found, drawn)) / max(len(pairs), 1)


def segmentation_entropy(logits: Tensor, target: Tensor) -> Tensor:
    """Binary cross-entropy that counts painted cells more, mean over all cells.

    Args:
        logits, target: ``(B, 3, H, W)``.
    """
    weight = logits.new_tensor(SEGMENTATION_POSITIVE_WEIGHT)
    return functional.binary_cross_entropy_with_logits(logits, target, pos_weight=weight)


def forecast_loss(forecasts: Tensor, truth: Tensor, size: Tensor) -> Tensor:
    """Chamfer distance between forecast and true polylines (the prediction loss of Sec. 3.6), metres, summed.

    Args:
        forecasts: ``(n, P, 2)``, normalised, where each track is expected in the ego frame of t + 1.
        truth: ``(n, P, 2)``, normalised, the same elements in that frame.
        size: ``(2,)``, metres.
    """
    distance = torch.linalg.vector_norm((forecasts * size)[:, :, None] - (truth * size)[:, None], dim=3)
    return ((distance.amin(1).mean(1) + distance.amin(2).mean(1)) / 2).sum()


def forecast_point_loss(forecasts: Tensor, truth: Tensor, rings: Tensor, size: Tensor) -> Tensor:
    """Distance of corresponding points of forecast and true polylines, metres, mean over points, summed.

    The chamfer distance leaves it free where along the line the points lie and, nearly so, where it ends.

    Args:
        forecasts, truth, size: as for :func:`forecast_loss`.
        rings: ``(n,) bool``, closed polylines.
    """
    found, wanted = forecasts * size, best_order(forecasts * size, truth * size, rings)
    return torch.linalg.vector_norm(found - wanted, dim=2).mean(1).sum()


@dataclass
class FrameLosses:
    """Losses of one instant of a batch.

    Attributes:
        terms: weighted losses by name; their sum is what is minimised.
        assignment: pairs of the last layer, tracks included.
    """

    terms: dict[str, Tensor]
    assignment: Assignment

    @property
    def total(self) -> Tensor:
        """Sum of all terms."""
        return torch.stack(list(self.terms.values())).sum()


def frame_losses(
    outputs: FrameOutputs,
    targets: Targets,
    size: Tensor,
    weights: LossWeights,
    costs: MatchingCosts,
    tracks: Assignment | None = None,
    track_rows: int = 0,
) -> FrameLosses:
    """All losses of one instant.

    Detections are matched to all of the truth at every layer. A track answers for its owner's truth only; a track
    that is not in ``tracks`` has lost its owner and is trained towards background (one-way assignment).

    Args:
        outputs: of the network for ``B`` frames.
        targets: truth of these frames.
        size: ``(2,)``, length and width of the ROI, metres.
        weights: of the losses.
        costs: of the assignment.
        tracks: pairs of track rows and truth; None where there are no tracks.
        track_rows: number of rows before the first detection, padding included.
    """
    terms: dict[str, Tensor] = {}
    assignment = tracks or Assignment(*targets.frame.new_zeros((3, 0)))
    for layer in outputs.layers:
        masks = None if layer.masks is None else masks_of_size(targets.masks, layer.masks)
        if layer.logits is not None:
            resized = targets if masks is None else Targets(**{**vars(targets), "masks": masks})
            assignment = match(
                layer.logits, layer.points, layer.masks, outputs.query_valid, track_rows, resized, size, costs
            )
            if tracks is not None:
                assignment = joined_pairs(tracks, assignment)
        for name, term in _layer_terms(layer, outputs.query_valid, targets, masks, assignment, size, weights).items():
            terms[name] = terms[name] + term if name in terms else term
    segmentation = functional.adaptive_max_pool2d(targets.segmentation, outputs.segmentation.shape[-2:])
    cells = outputs.segmentation
    terms["segmentation"] = weights.segmentation_entropy * segmentation_entropy(cells, segmentation)
    dice = dice_loss(cells.flatten(0, 1), segmentation.flatten(0, 1)) / cells.shape[:2].numel()
    terms["segmentation"] = terms["segmentation"] + weights.segmentation_dice * dice
    return FrameLosses(terms, assignment)


def masks_of_size(masks: Tensor, like: Tensor) -> Tensor:
    """Bring drawn masks ``(M, H, W)`` to a coarser grid; a cell is set if any of its cells was."""
    if masks.shape[-2:] == like.shape[-2:] or not len(masks):
        return masks.reshape(len(masks), *like.shape[-2:])
    return functional.adaptive_max_pool2d(masks[None], like.shape[-2:])[0]


def _layer_terms(
    layer: LayerPredictions,
    query_valid: Tensor,
    targets: Targets,
    masks: Tensor | None,
    pairs: Assignment,
    size: Tensor,
    weights: LossWeights,
) -> dict[str, Tensor]:
    """Weighted losses of one layer, over the number of assigned rows."""
    positives = max(len(pairs), 1)
    kinds = targets.kinds[pairs.truth]
    terms: dict[str, Tensor] = {}
    if layer.logits is not None:
        wanted = torch.zeros_like(layer.logits)
        wanted[pairs.frame, pairs.row, kinds] = 1.0
        terms["focal"] = weights.focal / positives * focal_loss(layer.logits[query_valid], wanted[query_valid]).sum()
    if layer.points is not None:
        points = layer.points[pairs.frame, pairs.row] * size
        rings = kinds == ElementKind.PED_CROSSING
        target = best_order(points, targets.points[pairs.truth] * size, rings)
        terms["points"] = weights.points / positives * point_loss(points, target)
        terms["direction"] = weights.direction / positives * direction_loss(points, target)
    if layer.masks is not None and masks is not None:
        terms["mask"] = mask_loss(layer.masks, masks, pairs, weights.mask_dice, weights.mask_entropy)
    return terms
