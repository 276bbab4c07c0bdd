"""Fusion of warped past BEV maps into the current one."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from predmapnet.network.kernels.normalised_convolution import NormalisedConvolution


class TemporalFusion(nn.Module):
    """A convolution over the past maps and the current one, and a residual block; its output is a residual, >= 0."""

    def __init__(self, width: int, slots: int) -> None:
        super().__init__()
        self.slots = slots
        self.mix = NormalisedConvolution((slots + 1) * width, width, 3)
        self.first = NormalisedConvolution(width, width, 3)
        self.second = NormalisedConvolution(width, width, 3)

    def forward(self, history: Tensor, current: Tensor) -> Tensor:
        """Fuse.

        Args:
            history: ``(B, S, C, H, W)``, from far to near; fewer maps than slots count as zero maps in front.
            current: ``(B, C, H, W)``.

        Returns:
            ``(B, C, H, W)``, to be added to ``current``.
        """
        batch, maps, width = history.shape[:3]
        missing = current.new_zeros(batch, self.slots - maps, width, *current.shape[2:])
        together = torch.cat([missing, history, current[:, None]], dim=1).flatten(1, 2)
        hidden = F.relu(self.mix(together.contiguous(memory_format=torch.channels_last)))
        return F.relu(self.second(F.relu(self.first(hidden))) + hidden)
