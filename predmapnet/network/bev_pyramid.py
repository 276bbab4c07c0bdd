"""Coarser BEV levels for the query generator, of an encoder that makes a single one."""

from __future__ import annotations

from torch import Tensor, nn

from predmapnet.network.layers import ConvNorm


class BevPyramid(nn.Module):
    """Strided convolutions: the multi-scale BEV features of Sec. 3.2."""

    def __init__(self, widths: tuple[int, int, int]) -> None:
        super().__init__()
        fine, middle, coarse = widths
        self.to_middle = ConvNorm(fine, middle, 3, stride=2)
        self.to_coarse = ConvNorm(middle, coarse, 3, stride=2)

    def forward(self, fine: Tensor) -> list[Tensor]:
        """Map ``(B, C_0, H, W)`` to itself, ``(B, C_1, H / 2, W / 2)`` and ``(B, C_2, H / 4, W / 4)``, rounded up."""
        middle = self.to_middle(fine)
        return [fine, middle, self.to_coarse(middle)]
