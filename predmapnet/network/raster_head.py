"""Semantic segmentation of the BEV features, at twice their resolution."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor, nn


class RasterHead(nn.Module):
    """Two convolutions with an upsampling between them; an auxiliary task, nothing reads it."""

    def __init__(self, width: int, classes: int) -> None:
        super().__init__()
        self.before = nn.Conv2d(width, width, 3, padding=1, bias=False)
        self.after = nn.Conv2d(width, width, 3, padding=1)
        self.classify = nn.Conv2d(width, classes, 1)

    def forward(self, bev: Tensor) -> Tensor:
        """Map ``(B, C, H, W)`` to logits ``(B, classes, 2 H, 2 W)``."""
        hidden = F.interpolate(F.relu(self.before(bev)), scale_factor=2, mode="nearest")
        return self.classify(F.relu(self.after(hidden)))


def semantic_mask(logits: Tensor, threshold: float = 0.4) -> Tensor:
    """Return the class of each cell plus one where its probability reaches the threshold, 0 elsewhere.

    Args:
        logits: ``(B, classes, h, w)``.
        threshold: of the probability.
    """
    best, kind = logits.sigmoid().max(dim=1)
    return torch.where(best >= threshold, kind + 1, 0).to(torch.uint8)
