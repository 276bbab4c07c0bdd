"""Weights of the losses and of the assignment: MapTracker's with those of the paper, and those of ``lite``."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class LossWeights:
    """How much each loss and each cost of the assignment counts. Zero leaves a loss out.

    Attributes:
        focal: of the classes.
        points: of the smooth L1 distance, mean over a line's coordinates.
        direction: of one minus the cosine between the edges.
        mask_dice, mask_entropy: lambda_dice and lambda_bce of Sec. 3.6.
        segmentation, segmentation_dice: of L_BEV.
        forecast: of L_pred, the chamfer distance, per metre.
        forecast_points: of the distance point by point, per metre.
        depth: of L_depth.
        transformation: of the loss of the motion of queries.
        beta: where the smooth L1 distance becomes linear.
        metres: lines are compared in metres; otherwise in shares of the region.
        focal_segmentation: L_BEV is a focal loss and a squared dice; otherwise a cross-entropy and a plain dice.
        mean_over_frames: frames of a step are averaged; otherwise added up.
        cost_focal, cost_points: of the assignment.
        cost_beta: as ``beta``, of the assignment; 0 is a plain L1 distance.
        cost_mask: of dice and cross-entropy of the masks, in layers that classify but have no line.
    """

    focal: float
    points: float
    mask_dice: float
    mask_entropy: float
    segmentation: float
    segmentation_dice: float
    forecast: float
    beta: float
    cost_focal: float
    cost_points: float
    cost_beta: float = 0.0
    cost_mask: float = 0.0
    direction: float = 0.0
    forecast_points: float = 0.0
    depth: float = 0.0
    transformation: float = 0.0
    metres: bool = False
    focal_segmentation: bool = True
    mean_over_frames: bool = False


PAPER_LOSSES = LossWeights(
    focal=5.0,
    points=100.0,  # 50 for the sum of x and y.
    mask_dice=2.0,
    mask_entropy=1.0,
    segmentation=100.0,  # The official configuration asks for 10, and the code applies it twice.
    segmentation_dice=1.0,
    forecast=1.0,  # The paper names none.
    depth=3.0,  # MapTRv2's.
    transformation=0.1,
    beta=0.01,
    cost_focal=5.0,
    cost_points=100.0,
    cost_beta=0.01,
)
"""MapTracker's, with the paper's masks and forecasts: L_total is the plain sum, frames added up."""

LITE_LOSSES = LossWeights(
    focal=3.0,
    points=1.5,
    direction=0.3,
    mask_dice=1.0,
    mask_entropy=5.0,
    segmentation=6.0,
    segmentation_dice=2.0,
    forecast=0.5,
    forecast_points=0.5,
    beta=0.05,
    metres=True,
    focal_segmentation=False,
    mean_over_frames=True,
    cost_focal=3.0,
    cost_points=1.2,
    cost_mask=2.0,
)
"""What trained best on two CPU cores: on thin lines and small grids cross-entropy converges faster than dice."""
