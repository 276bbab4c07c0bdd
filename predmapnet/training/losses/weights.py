"""Weights of the losses and of the assignment: MapTracker's with those of the paper, and those of ``lite``."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class LossWeights:
    """Weights of the losses and of the costs of the assignment, as in the paper and MapTracker; 0 leaves a loss out.

    Attributes:
        focal: of the classes.
        points: of the smooth L1 distance, mean over a line's coordinates (MapTracker: 50 for the sum of x and y).
        direction: of one minus the cosine between the edges.
        mask_dice, mask_entropy: lambda_dice and lambda_bce of Sec. 3.6.
        segmentation, segmentation_dice: of L_BEV (MapTracker's configuration asks for 10, its code applies it twice).
        forecast: of L_pred, the chamfer distance, per metre; the paper names none.
        forecast_points: of the distance point by point, per metre.
        depth: of L_depth (MapTRv2).
        transformation: of the loss of the motion of queries.
        beta: where the smooth L1 distance becomes linear.
        metres: lines are compared in metres; otherwise in shares of the region.
        focal_segmentation: L_BEV is a focal loss and a squared dice; otherwise a cross-entropy and a plain dice.
        mean_over_frames: frames of a step are averaged; otherwise added up.
        cost_focal, cost_points: of the assignment.
        cost_beta: as ``beta``, of the assignment; 0 is a plain L1 distance.
        cost_mask: of dice and cross-entropy of the masks, in layers that classify but have no line.
    """

    focal: float = 5.0
    points: float = 100.0
    direction: float = 0.0
    mask_dice: float = 2.0
    mask_entropy: float = 1.0
    segmentation: float = 100.0
    segmentation_dice: float = 1.0
    forecast: float = 1.0
    forecast_points: float = 0.0
    depth: float = 3.0
    transformation: float = 0.1
    beta: float = 0.01
    metres: bool = False
    focal_segmentation: bool = True
    mean_over_frames: bool = False
    cost_focal: float = 5.0
    cost_points: float = 100.0
    cost_beta: float = 0.01
    cost_mask: float = 0.0


PAPER_LOSSES = LossWeights()
LITE_LOSSES = LossWeights(
    focal=3.0,
    points=1.5,
    direction=0.3,
    beta=0.05,
    metres=True,
    mask_dice=1.0,
    mask_entropy=5.0,
    segmentation=6.0,
    segmentation_dice=2.0,
    forecast=0.5,
    forecast_points=0.5,
    depth=0.0,
    transformation=0.0,
    cost_focal=3.0,
    cost_points=1.2,
    cost_beta=0.0,
    cost_mask=2.0,
    focal_segmentation=False,
    mean_over_frames=True,
)
"""Weights that trained best on two CPU cores: on thin lines and small grids cross-entropy beats dice."""
