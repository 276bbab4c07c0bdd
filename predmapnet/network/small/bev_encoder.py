"""BEV encoder of the small network: ground look-up of image features, a position map and a U-Net over three levels."""

from __future__ import annotations

from collections.abc import Sequence

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from predmapnet.config import LookupBevConfig
from predmapnet.network.layers import ConvNorm, Convolution, ResidualBlock
from predmapnet.network.small.ground_lookup import RigLookup, to_ground
from predmapnet.network.state import FrameInputs, RigGeometry, StreamState


class BevEncoder(nn.Module):
    """Ground features at 0.3 m to three levels at 0.6, 1.2 and 2.4 m."""

    def __init__(self, channels_in: int, config: LookupBevConfig) -> None:
        super().__init__()
        fine, middle, coarse = config.widths
        self.reduce = Convolution(channels_in, fine, 2, stride=2, bias=False)
        self.position = nn.Parameter(torch.randn(fine, config.rows, config.columns) * 0.02)
        self.norm = nn.BatchNorm2d(fine)
        self.fine_in = ResidualBlock(fine, fine)
        self.middle_in = ResidualBlock(fine, middle, stride=2)
        self.coarse = ResidualBlock(middle, coarse, stride=2)
        self.coarse_to_middle = ConvNorm(coarse, middle, 1, relu=False)
        self.middle_out = ResidualBlock(middle, middle)
        self.middle_to_fine = ConvNorm(middle, fine, 1, relu=False)
        self.fine_out = ResidualBlock(fine, fine)

    def forward(
        self, levels: Sequence[Tensor], inputs: FrameInputs, geometry: RigGeometry, state: StreamState | None
    ) -> list[Tensor]:
        """Encode.

        Args:
            levels: image features of a single level, ``(B, N, C_in, h', w')``.
            inputs: which cameras count.
            geometry: look-up of the rig.
            state: not used; past maps enter afterwards (:mod:`predmapnet.network.small.residual_bev_memory`).

        Returns:
            ``(B, C_0, H, W)``, ``(B, C_1, H / 2, W / 2)`` and ``(B, C_2, H / 4, W / 4)``, sizes rounded up.
        """
        assert isinstance(geometry, RigLookup), "a rig's look-up comes from make_rig_lookup"
        ground = to_ground(levels[0], inputs.camera_valid, geometry)
        fine = self.fine_in(F.relu(self.norm(self.reduce(ground) + self.position)))
        middle = self.middle_in(fine)
        coarse = self.coarse(middle)
        middle = self.middle_out(middle + _resize(self.coarse_to_middle(coarse), middle))
        fine = self.fine_out(fine + _resize(self.middle_to_fine(middle), fine))
        return [fine, middle, coarse]


def _resize(features: Tensor, like: Tensor) -> Tensor:
    return F.interpolate(features, size=like.shape[-2:], mode="bilinear", align_corners=False)
