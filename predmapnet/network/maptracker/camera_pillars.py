"""Where the cells of the BEV grid are seen in the images: computed once per camera rig."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from mapfusion.elements import RegionOfInterest
from predmapnet.config import BevFormerConfig
from predmapnet.network.layers import cell_centres

LEVEL_STRIDES = (8, 16, 32)
NEAREST_DEPTH = 1e-5


@dataclass(frozen=True)
class CameraPillars:
    """Pairs of a camera and a BEV cell that it sees, and where it sees it. Belongs to a rig, not to the network.

    A cell is a pillar of ``Z`` points. A camera that sees one of them takes part with all; those outside its image
    find nothing there.

    Attributes:
        camera: ``(P,) int64``; pairs are ordered by camera, then cell.
        cell: ``(P,) int64``, row by row.
        positions: ``(P, Z, 2)``, x and y in the image, 0 to 1 where inside.
        sees: ``(cells, N) float32``, 1 where a camera takes part.
        level_sizes: rows and columns of each feature level.
    """

    camera: Tensor
    cell: Tensor
    positions: Tensor
    sees: Tensor
    level_sizes: tuple[tuple[int, int], ...]

    @property
    def tokens(self) -> int:
        """Pixels of all levels of one camera."""
        return sum(rows * columns for rows, columns in self.level_sizes)

    def to(self, device: torch.device | str) -> CameraPillars:
        """Return a copy on ``device``."""
        moved = {name: getattr(self, name).to(device) for name in ("camera", "cell", "positions", "sees")}
        return replace(self, **moved)


def make_camera_pillars(
    ego_to_image: Tensor, image_size: tuple[int, int], config: BevFormerConfig, roi: RegionOfInterest
) -> CameraPillars:
    """Project the pillars of all cells into all cameras.

    Args:
        ego_to_image: ``(N, 4, 4) float64``; maps metres of the ego frame to (u depth, v depth, depth, 1) in pixels of
            the network's input.
        image_size: rows and columns of the network's input.
        config: grid and pillars.
        roi: the region that the grid covers.
    """
    positions, hits = project_pillars(ego_to_image, image_size, config, roi)
    sees = hits.any(dim=-1)
    camera, cell = sees.nonzero(as_tuple=True)
    height, width = image_size
    return CameraPillars(
        camera=camera,
        cell=cell,
        positions=positions[camera, cell],
        sees=sees.T.float().contiguous(),
        level_sizes=tuple((-(-height // stride), -(-width // stride)) for stride in LEVEL_STRIDES),
    )


def project_pillars(
    ego_to_image: Tensor, image_size: tuple[int, int], config: BevFormerConfig, roi: RegionOfInterest
) -> tuple[Tensor, Tensor]:
    """Project every point of every pillar.

    Returns:
        Positions ``(N, cells, Z, 2) float32`` in the images, 0 to 1 where inside, and which points are inside, as
        ``(N, cells, Z) bool``.
    """
    points = _pillars(config, roi).to(ego_to_image.device)
    projected = torch.einsum("nij,czj->nczi", ego_to_image.float(), points)
    depth = projected[..., 2]
    height, width = image_size
    size = projected.new_tensor([width, height])
    positions = projected[..., :2] / depth.clamp(min=NEAREST_DEPTH)[..., None] / size
    inside = (positions > 0).all(dim=-1) & (positions < 1).all(dim=-1)
    return positions, inside & (depth > NEAREST_DEPTH)


def _pillars(config: BevFormerConfig, roi: RegionOfInterest) -> Tensor:
    """Return the points ``(cells, Z, 4) float32`` in the ego frame, homogeneous."""
    ground = (cell_centres(config.rows, config.columns).double() - 0.5) * torch.tensor(roi.size)
    heights = torch.linspace(config.pillar_low, config.pillar_high, config.pillar_points, dtype=torch.float64)
    ground = ground.view(-1, 1, 2).expand(-1, len(heights), 2)
    heights = heights[None, :, None].expand(len(ground), -1, 1)
    return torch.cat([ground, heights, torch.ones_like(heights)], dim=-1).float()


def pixel_positions(positions: Tensor, level_sizes: Sequence[tuple[int, int]]) -> Tensor:
    """Turn positions ``(..., 2)`` in the image into pixels ``(..., L, 2)`` of each level; 0 is a pixel's centre."""
    x, y = positions.unbind(-1)
    levels = [torch.stack([x * columns, y * rows], dim=-1) for rows, columns in level_sizes]
    return torch.stack(levels, dim=-2) - 0.5
