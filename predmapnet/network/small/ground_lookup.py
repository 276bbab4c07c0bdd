"""From image features to the ground plane: a sparse look-up that is computed once per camera rig."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor

from mapfusion.arrays import Float
from predmapnet.config import PredMapNetConfig
from predmapnet.network.image_input import input_size, window_intrinsics
from predmapnet.network.layers import cell_centres
from predmapnet.network.small.backbone import STRIDE
from predmapnet.scenes import Rig

Integer = NDArray[np.int64]


@dataclass(frozen=True)
class SparseRows:
    """A sparse matrix, row by row.

    Attributes:
        columns: ``(nnz,) int64``.
        starts: ``(rows,) int64``, where each row begins in ``columns``.
        weights: ``(nnz,) float32``.
    """

    columns: Tensor
    starts: Tensor
    weights: Tensor

    def transposed(self, columns: int) -> SparseRows:
        """Return the transpose of a matrix with that many columns."""
        counts = torch.diff(self.starts, append=self.starts.new_tensor([len(self.columns)]))
        rows = torch.arange(len(self.starts), device=counts.device).repeat_interleave(counts)
        order = torch.argsort(self.columns, stable=True)
        counts = torch.bincount(self.columns, minlength=columns)
        return SparseRows(rows[order], torch.cumsum(counts, 0) - counts, self.weights[order])

    def multiply(self, table: Tensor) -> Tensor:
        """Multiply with ``(columns, C)``; an embedding bag is several times faster than a CSR product on a CPU."""
        return F.embedding_bag(self.columns, table, self.starts, per_sample_weights=self.weights, mode="sum")

    def to(self, device: torch.device | str) -> SparseRows:
        """Return a copy on ``device``."""
        return SparseRows(self.columns.to(device), self.starts.to(device), self.weights.to(device))


@dataclass(frozen=True)
class RigLookup:
    """Which image features each ground cell sees. Belongs to a rig, not to the network; not trained.

    Attributes:
        gather: ground cells x feature pixels of all cameras: bilinear weights, summed over cameras.
        pixels: of the features of all cameras, as many as ``gather`` has columns.
        visible: ``(cells, N) float32``, 1 where a camera sees the centre of a cell.
        grid: rows and columns of ground cells.
        feature_size: rows and columns of the image features.
    """

    gather: SparseRows
    pixels: int
    visible: Tensor
    grid: tuple[int, int]
    feature_size: tuple[int, int]

    @cached_property
    def scatter(self) -> SparseRows:
        """The transpose of ``gather``, for the backward pass."""
        return self.gather.transposed(self.pixels)

    def to(self, device: torch.device | str) -> RigLookup:
        """Return a copy on ``device``."""
        return replace(self, gather=self.gather.to(device), visible=self.visible.to(device))


def make_rig_lookup(rig: Rig, config: PredMapNetConfig) -> RigLookup:
    """Project the centres of all ground cells (at the height of the road under the car) into all cameras.

    Args:
        rig: cameras at the size of their stored images; scaling and the window are taken care of here.
        config: image and grid sizes.
    """
    grid = (2 * config.bev.rows, 2 * config.bev.columns)
    size = -(-np.array(input_size(config.image)) // STRIDE)
    ground = (cell_centres(*grid).double().numpy().reshape(-1, 2) - 0.5) * config.roi.size
    pixels, seen = _project(ground, rig, config)
    cell, camera = np.nonzero(seen)  # cell after cell, so that the entries of each row follow one another
    corners, shares = _bilinear(pixels[cell, camera] / STRIDE - 0.5, *size)
    corners += camera[:, None] * size.prod()
    entries = 4 * seen.sum(axis=1)
    return RigLookup(
        gather=SparseRows(
            columns=torch.from_numpy(corners.ravel()),
            starts=torch.from_numpy(entries.cumsum() - entries),
            weights=torch.from_numpy(shares.ravel().astype(np.float32)),
        ),
        pixels=len(rig) * int(size.prod()),
        visible=torch.from_numpy(seen.astype(np.float32)),
        grid=grid,
        feature_size=(int(size[0]), int(size[1])),
    )


def _project(ground: Float, rig: Rig, config: PredMapNetConfig) -> tuple[Float, NDArray[np.bool_]]:
    """Return pixels ``(n, N, 2)`` in the network's window of each camera, and whether each point is inside it."""
    # On a plane, a projection is a matrix that multiplies (x, y, 1).
    planes = []
    for camera in rig:
        rotation, position = camera.camera_to_ego[:3, :3], camera.camera_to_ego[:3, 3]
        to_camera = np.column_stack([rotation.T[:, :2], rotation.T @ ([0.0, 0.0, camera.ground_height] - position)])
        planes.append(window_intrinsics(camera, config.image) @ to_camera)
    projected = (np.column_stack([ground, np.ones(len(ground))]) @ np.concatenate(planes).T).reshape(len(ground), -1, 3)
    depth = projected[..., 2]
    pixels = projected[..., :2] / np.maximum(depth, 1e-3)[..., None]
    inside = (pixels >= 0) & (pixels < [config.image.width, config.image.height])
    return pixels, (depth > 0.1) & inside[..., 0] & inside[..., 1]


def _bilinear(pixels: Float, rows: int, columns: int) -> tuple[Integer, Float]:
    """Return the four neighbours ``(n, 4)`` of each position (flat index, clamped at the border) and their weights."""
    base = np.floor(pixels)
    right, down = (pixels - base).T
    left_x, top_y = base.T
    x = np.clip([left_x, left_x, left_x + 1, left_x + 1], 0, columns - 1)
    y = np.clip([top_y, top_y + 1, top_y, top_y + 1], 0, rows - 1)
    weights = [(1 - right) * (1 - down), (1 - right) * down, right * (1 - down), right * down]
    return np.ascontiguousarray((y * columns + x).astype(np.int64).T), np.ascontiguousarray(np.transpose(weights))


class _SparseProduct(torch.autograd.Function):
    """Multiply each stream's features with the sparse matrix; the transpose serves the backward pass."""

    @staticmethod
    def forward(ctx: Any, features: Tensor, lookup: RigLookup) -> Tensor:
        ctx.lookup = lookup
        return torch.stack([lookup.gather.multiply(table) for table in features])

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, None]:
        return torch.stack([ctx.lookup.scatter.multiply(table) for table in gradient.contiguous()]), None


def to_ground(features: Tensor, camera_valid: Tensor, lookup: RigLookup) -> Tensor:
    """Look image features up at every ground cell: the mean over the cameras that see it and are valid.

    Args:
        features: ``(B, N, C, h', w')``.
        camera_valid: ``(B, N) bool``.
        lookup: of the rig that took the images.

    Returns:
        ``(B, C, rows, columns)``, channels-last in memory; zero where no valid camera looks.
    """
    batch = len(features)
    features = features.masked_fill(~camera_valid[:, :, None, None, None], 0.0)
    pixels = features.permute(0, 1, 3, 4, 2).reshape(batch, -1, features.shape[2]).to(lookup.gather.weights.dtype)
    summed = _SparseProduct.apply(pixels, lookup)  # type: ignore[no-untyped-call]
    cameras = camera_valid.to(summed.dtype) @ lookup.visible.to(summed.dtype).T
    ground = summed / cameras.clamp(min=1.0)[..., None]
    return ground.unflatten(1, lookup.grid).permute(0, 3, 1, 2)
