"""Reference points of BEVFormer: where the pillars of the BEV cells are seen in the images of each frame."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from mapfusion.elements import RegionOfInterest
from predmapnet.config import BevFormerConfig
from predmapnet.network.layers import cell_centres

LEVEL_STRIDES = (8, 16, 32)
NEAREST_DEPTH = 1e-5


@dataclass(frozen=True)
class ReferencePoints:
    """Pairs of a camera and a BEV cell that it sees, in ``B`` frames of ``N`` cameras, and where it sees it.

    A cell is a pillar of ``Z`` points. A camera that sees one of them takes part with all; those outside its image
    find nothing there.

    Attributes:
        camera: ``(P,) int64``, among all ``B * N``; pairs are ordered by camera, then cell.
        cell: ``(P,) int64``, among all ``B * H * W`` of the frames, row by row.
        positions: ``(P, Z, 2)``, x and y in the image, 0 to 1 where inside.
        visible: ``(B, N, H * W) bool``, whether a camera takes part.
        level_sizes: rows and columns of each feature level.
    """

    camera: Tensor
    cell: Tensor
    positions: Tensor
    visible: Tensor
    level_sizes: tuple[tuple[int, int], ...]

    @property
    def tokens(self) -> int:
        """Pixels of all levels of one camera."""
        return sum(rows * columns for rows, columns in self.level_sizes)


def find_references(ego_to_image: Tensor, image_size: tuple[int, int], pillars: Tensor) -> ReferencePoints:
    """Project the pillars of all cells into all cameras of all frames.

    Args:
        ego_to_image: ``(B, N, 3, 4) float64`` of :class:`~predmapnet.network.calibration.Calibration`.
        image_size: rows and columns of the network's input.
        pillars: of :func:`pillar_points`.
    """
    batch, cameras = ego_to_image.shape[:2]
    positions, hits = project_pillars(ego_to_image.flatten(0, 1), image_size, pillars)
    visible = hits.any(dim=-1)
    camera, cell = visible.nonzero(as_tuple=True)
    height, width = image_size
    return ReferencePoints(
        camera=camera,
        cell=camera // max(cameras, 1) * len(pillars) + cell,
        positions=positions[camera, cell],
        visible=visible.unflatten(0, (batch, cameras)),
        level_sizes=tuple((-(-height // stride), -(-width // stride)) for stride in LEVEL_STRIDES),
    )


def project_pillars(ego_to_image: Tensor, image_size: tuple[int, int], pillars: Tensor) -> tuple[Tensor, Tensor]:
    """Project every point of pillars ``(cells, Z, 4) float32`` by ``(M, 3, 4) float64``, of ``M`` cameras.

    Returns:
        Positions ``(M, cells, Z, 2) float32`` in the images, 0 to 1 where inside, and which points are inside, as
        ``(M, cells, Z) bool``.
    """
    projected = torch.einsum("nij,czj->nczi", ego_to_image.float(), pillars)
    depth = projected[..., 2]
    height, width = image_size
    size = projected.new_tensor([width, height])
    positions = projected[..., :2] / depth.clamp(min=NEAREST_DEPTH)[..., None] / size
    inside = (positions > 0).all(dim=-1) & (positions < 1).all(dim=-1)
    return positions, inside & (depth > NEAREST_DEPTH)


def pillar_points(config: BevFormerConfig, roi: RegionOfInterest) -> Tensor:
    """Return the points ``(cells, Z, 4) float32`` of all pillars in the ego frame, metres, homogeneous."""
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
