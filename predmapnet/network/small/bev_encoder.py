"""BEV encoder of the small network: ground look-up of image features, a position map and a U-Net over three levels."""

from __future__ import annotations

from collections.abc import Sequence

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from predmapnet.config import LookupBevConfig, PredMapNetConfig
from predmapnet.network.calibration import Calibration
from predmapnet.network.kernels.matrix_product import Linear, linear
from predmapnet.network.layers import ConvNorm, Convolution, ResidualBlock, zero_init
from predmapnet.network.small.backbone import STRIDE
from predmapnet.network.small.ground_lookup import GroundLookup, find_on_ground, ground_points, to_ground
from predmapnet.network.state import FrameInputs, StreamState, ViewGeometry


class BevEncoder(nn.Module):
    """Ground features at 0.3 m to three levels at 0.6, 1.2 and 2.4 m.

    At further heights each cell looks into the images once; what it finds enters through a product that starts as zero.
    """

    def __init__(self, config: PredMapNetConfig) -> None:
        super().__init__()
        bev = config.bev
        assert isinstance(bev, LookupBevConfig)
        channels_in = bev.backbone.channels
        fine, middle, coarse = bev.widths
        self.grid = grid = (bev.rows, bev.columns)
        road = ground_points((2 * bev.rows, 2 * bev.columns), 0.0, config.roi).unflatten(0, (bev.rows, 2, -1, 2))
        raised = [ground_points(grid, height, config.roi).unflatten(0, grid) for height in bev.further_heights]
        # All that a cell sees lies side by side: four points of the road, and one at each further height.
        of_cells = torch.cat([road.transpose(1, 2).flatten(2, 3), *(each[:, :, None] for each in raised)], dim=2)
        self.register_buffer("points", of_cells.flatten(0, 2), persistent=False)
        self.points: Tensor
        self.reduce = Convolution(channels_in, fine, 2, stride=2, bias=False)
        self.heights: Linear | None = None
        if bev.further_heights:
            self.heights = Linear(len(bev.further_heights) * channels_in, fine, bias=False)
            zero_init(self.heights)
        self.position = nn.Parameter(torch.randn(fine, *grid) * 0.02)
        self.norm: nn.Module = nn.BatchNorm2d(fine)
        self.fine_in = ResidualBlock(fine, fine)
        self.middle_in = ResidualBlock(fine, middle, stride=2)
        self.coarse = ResidualBlock(middle, coarse, stride=2)
        self.coarse_to_middle = ConvNorm(coarse, middle, 1, relu=False)
        self.middle_out = ResidualBlock(middle, middle)
        self.middle_to_fine = ConvNorm(middle, fine, 1, relu=False)
        self.fine_out = ResidualBlock(fine, fine)

    def geometry(self, calibration: Calibration, size: tuple[int, int]) -> GroundLookup:
        """Find where the cameras of some frames, whose input has ``size`` (rows, columns), see the ground."""
        features = -(-size[0] // STRIDE), -(-size[1] // STRIDE)
        return find_on_ground(self.points, calibration, features, STRIDE)

    def forward(
        self, levels: Sequence[Tensor], inputs: FrameInputs, geometry: ViewGeometry, state: StreamState | None
    ) -> list[Tensor]:
        """Turn image features of a single level, ``(B, N, C_in, h', w')``, into BEV features.

        ``state`` is not used: past maps enter afterwards (:mod:`predmapnet.network.small.residual_bev_memory`).

        Returns:
            ``(B, C_0, H, W)``, ``(B, C_1, H / 2, W / 2)`` and ``(B, C_2, H / 4, W / 4)``, sizes rounded up.
        """
        assert isinstance(geometry, GroundLookup), "the geometry comes from this encoder"
        found = to_ground(levels[0], inputs.camera_valid, geometry)
        fine = self.fine_in(F.relu(self.norm(self._combined(found) + self.position), inplace=True))
        middle = self.middle_in(fine)
        coarse = self.coarse(middle)
        middle = self.middle_out(middle + _resize(self.coarse_to_middle(coarse), middle))
        fine = self.fine_out(fine + _resize(self.middle_to_fine(middle), fine))
        return [fine, middle, coarse]

    def _combined(self, found: Tensor) -> Tensor:
        """Turn the features of all points ``(B, K, C_in)`` into those of the cells ``(B, C_0, H, W)``."""
        weight = self.reduce.weight.permute(0, 2, 3, 1).flatten(1)
        if self.heights is not None:
            weight = torch.cat([weight, self.heights.weight], dim=1)
        return linear(found.reshape(len(found), *self.grid, -1), weight).permute(0, 3, 1, 2)


def _resize(features: Tensor, like: Tensor) -> Tensor:
    return F.interpolate(features, size=like.shape[-2:], mode="bilinear", align_corners=False)
